"""A window of a run: some of its frames, with a folder of their own, and silhouettes and geometry of the whole."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geomocap.errors import GeometryError, RunError
from geomocap.files.array_schema import Expected, check_arrays
from geomocap.files.npz import read_npz, write_npz
from geomocap.files.run import Run

WINDOWS, POSES = "windows", "poses.npz"
_POSES = {
    "rotations": Expected("T B 3 3", "rotation"),
    "translations": Expected("T B 3"),
    "distance": Expected("T", low=0),
}


@dataclass(frozen=True)
class RunWindow(Run):
    """A run of some frames of another run; frames are numbered from the window's first.

    Attributes
    ----------
    path : Path
        Folder of what is found from these frames alone.
    whole : Path
        Folder of the run, with the silhouettes and geometry of all frames.
    first : int
        Number of the first frame there.
    """

    whole: Path = field(default_factory=Path)
    first: int = 0

    @classmethod
    def of(cls, run: Run, frames: range) -> RunWindow:
        """Return the window of a run that holds some of its frames: `RUN/windows/000000`."""
        return cls(run.path / WINDOWS / f"{frames.start:06d}", whole=run.path, first=frames.start)

    def __getstate__(self) -> dict:
        return {"path": self.path, "whole": self.whole, "first": self.first}

    def silhouette_file(self, camera: str, frame: int) -> Path:
        """Path of a silhouette, in the whole run."""
        return Run(self.whole).silhouette_file(camera, self.first + frame)

    def frame_file(self, kind: str, frame: int) -> Path:
        """Path of a frame's geometry: bodies in the window's own folder, voxels and clouds in the whole run."""
        if kind == "bodies":
            return super().frame_file(kind, frame)
        return Run(self.whole).frame_file(kind, self.first + frame)

    def note(self, stage: str, files: Iterable[Path]) -> None:
        """Note files that a stage under way has finished, in the whole run's record."""
        Run(self.whole).note(stage, files)

    @contextmanager
    def timed(self, stage: str) -> Iterator[dict[str, int]]:
        """Measure a stage into the whole run's `timings.json`."""
        with Run(self.whole).timed(stage) as count:
            yield count


def write_poses(run: Run, rotations: np.ndarray, translations: np.ndarray, distance: np.ndarray) -> Path:
    """Write how a model's bodies move through a window; return the file.

    Parameters
    ----------
    run : Run
    rotations : (T, B, 3, 3) float
    translations : (T, B, 3) float, metres
    distance : (T,) float, metres
        Between the model's surface and each frame's.
    """
    file = run.path / POSES
    write_npz(file, {"rotations": rotations, "translations": translations, "distance": distance})
    return file


def read_poses(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read what `write_poses` wrote.

    Raises
    ------
    RunError
        If the file is missing or damaged.
    """
    file = run.path / POSES
    found = read_npz(file, tuple(_POSES), tuple(_POSES))
    try:
        check_arrays(found, _POSES)
    except GeometryError as error:
        raise RunError(f"{file}: damaged ({error}); delete it and run again") from None
    return found["rotations"], found["translations"], found["distance"]
