"""Progress bars for the library's callback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from geomocap.progress import Progress


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Show a bar for each stage on standard error while the block runs."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description:<14}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    # Elsewhere than in a terminal they are shown once, at the end: nothing has to be drawn before
    with Bars(*columns, console=console, auto_refresh=console.is_terminal, refresh_per_second=4) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report
