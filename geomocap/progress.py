"""Progress reports of long work: the library calls back, whoever shows it decides how."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called as `progress(stage, done, total)`, from the thread that started the work."""


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""
