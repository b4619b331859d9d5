"""Being asked to stop, by Ctrl+C or by a queue of jobs."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt when asked to stop, whatever libraries make of it on its way out.

    Typer ends without a word then; modules that are just being imported fail with errors of their own. What ends well
    all the same, such as a server that is stopped, may.
    """
    asked = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    with suppress(ValueError):  # not the main thread
        for wish in (signal.SIGINT, signal.SIGTERM):
            signal.signal(wish, stop)
    try:
        yield
    except BaseException as end:
        if asked and not (isinstance(end, SystemExit) and not end.code):
            raise KeyboardInterrupt from None
        raise
