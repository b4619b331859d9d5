"""Motion files that are text, read: with or without byte order mark, and never without end."""

from __future__ import annotations

from pathlib import Path

from geomocap.export.export_errors import MotionError
from geomocap.reading import read_bytes

MOST_BYTES = 1 << 31  # an hour of a hundred markers at 200 per second is a fifth of that
LARGEST = 1e9  # of a coordinate, in whatever unit


def read_motion_text(path: Path) -> str:
    """Read a motion file as text.

    Raises
    ------
    MotionError
        If it can't be read, or holds what no text does.
    """
    try:
        data = read_bytes(path, MOST_BYTES)
    except OSError as error:
        raise MotionError(f"{path}: can't be read ({error.strerror or error})") from None
    if b"\0" in data:
        raise MotionError(f"{path}: no text, it holds zeros; copy it again")
    return data.decode("utf-8-sig", "replace")


def ends_early(text: str) -> bool:
    """Whether a text of numbers ends within its last one: no line end, and fewer decimals than all others have."""
    last = text[-(1 << 16) :]
    if not last or last[-1].isspace():
        return False
    decimals = [len(word.partition(".")[2]) for word in last.splitlines()[-1].split() if "." in word]
    final = len(last.split()[-1].partition(".")[2])
    others = set(decimals[:-1] if "." in last.split()[-1] else decimals)
    return len(others) == 1 and final < others.pop()
