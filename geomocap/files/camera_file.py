"""The one reader and writer of `cameras.json`: what is doubtful about a run's cameras, and which were left out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from geomocap.errors import RunError
from geomocap.files.atomic import write_text
from geomocap.files.run import Run
from geomocap.reading import read_json

CAMERAS = "cameras.json"


@dataclass(frozen=True)
class CameraDoubts:
    """What was found about the cameras of a run before it began.

    Attributes
    ----------
    contradicting : tuple of str
        Cameras that contradict the others.
    left_out : tuple of str
        Those of them that the run goes without.
    warnings : tuple of str
        One line each.
    """

    contradicting: Sequence[str] = ()
    left_out: Sequence[str] = ()
    warnings: Sequence[str] = ()


def write_camera_doubts(run: Run, doubts: CameraDoubts) -> None:
    """Write `cameras.json`."""
    write_text(run.path / CAMERAS, json.dumps(asdict(doubts), indent=1))


def read_camera_doubts(run: Run) -> CameraDoubts:
    """Read `cameras.json`; no doubts if there is none.

    Raises
    ------
    RunError
        If the file is damaged.
    """
    file = run.path / CAMERAS
    if not file.is_file():
        return CameraDoubts()
    found = read_json(file, RunError)
    try:
        names = ("contradicting", "left_out", "warnings")
        return CameraDoubts(*(tuple(str(line) for line in found[name]) for name in names))
    except (KeyError, TypeError) as error:
        raise RunError(f"{file}: damaged ({error}); delete it and run again") from None
