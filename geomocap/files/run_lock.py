"""One process at a time writes into a run."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from geomocap.errors import RunError
from geomocap.files.atomic import remove_remains, write_text
from geomocap.files.run import Run
from geomocap.files.stage_records import FOLDER
from geomocap.reading import MOST_TEXT, read_bytes

LOCK, WHO = "run.lock", "run.who"


@contextmanager
def working_in(
    run: Run, doing: str = "", *, wait: bool = False, tell: Callable[[str], object] = lambda _: None
) -> Iterator[None]:
    """Keep others out of a run folder while the block writes into it; what killed processes left there is removed.

    The lock goes with the process, however that ends.

    Parameters
    ----------
    run : Run
    doing : str
        The work, as others are told.
    wait : bool
        Wait until the others have ended, instead of an error.
    tell : callable
        Told whom is waited for.

    Raises
    ------
    RunError
        If somebody else works there, or the folder can't be written.
    """
    folder = run.path / FOLDER
    new = [path for path in (folder, run.path) if not os.path.lexists(path)]
    try:
        Path(os.path.realpath(folder)).mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if not wait:
                raise RunError(
                    f"{run.path}: in use by {_who(run)}; wait until that has ended (--wait) or choose another folder"
                ) from None
            tell(f"waiting for {_who(run)}, which works in {run.path}")
            lock.acquire(poll_interval=0.2)
    except OSError as error:
        raise RunError(_reason(run, error)) from None
    try:
        remove_remains(run.folders(), alone=True)
        me = {"process": os.getpid(), "machine": platform.node(), "doing": doing, "since": _now()}
        write_text(folder / WHO, json.dumps(me), lasting=False)
        yield
    finally:
        with suppress(OSError):
            (folder / WHO).unlink(missing_ok=True)
            if new and [p.name for p in folder.iterdir()] == [LOCK]:  # nothing was written
                (folder / LOCK).unlink()
                for path in new:
                    path.rmdir()
        lock.release()


def _who(run: Run) -> str:
    """Say who works in a run, as far as is known."""
    try:
        said = json.loads(read_bytes(run.path / FOLDER / WHO, MOST_TEXT))
        doing = f"`geomocap {said['doing']}`, " if said["doing"] else ""
        return f"another process ({doing}process {said['process']} of {said['machine']}, since {said['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


def _now() -> str:
    return datetime.now().strftime("%Y-%m-%d %H:%M:%S")


def _reason(run: Run, error: OSError) -> str:
    with suppress(OSError):
        in_the_way = next((p for p in (run.path, *run.path.parents) if p.is_file()), None)
        if in_the_way is not None:
            return f"{run.path}: can't be written ({in_the_way} is a file, a folder is expected); choose another folder"
    return f"{run.path}: can't be written ({error.strerror or error}); free space or choose another folder"
