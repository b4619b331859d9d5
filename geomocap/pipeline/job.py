"""What every stage of the pipeline is given, and how a stage knows that it has nothing to do."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import geomocap
from geomocap.capture import Capture
from geomocap.config import Config
from geomocap.progress import Progress, silent
from geomocap.run import Run
from geomocap.scans import Scans


@dataclass(frozen=True)
class Job:
    """A run under way.

    Attributes
    ----------
    run : Run
    config : Config
    executor : Executor
        Frames are mapped with it.
    progress : Progress
    capture : Capture, optional
    scans : Scans, optional
        Geometry that takes the place of a capture.
    fps : float
        Frames per second.
    model : Path, optional
        `model.npz` of the subject, from another take.
    """

    run: Run
    config: Config
    executor: Executor
    progress: Progress = silent
    capture: Capture | None = None
    scans: Scans | None = None
    fps: float = 30.0
    model: Path | None = None

    def stage(
        self, name: str, key: str, outputs: Sequence[str], work: Callable[[], int], optional: Sequence[str] = ()
    ) -> str:
        """Do a stage's work, unless it has been done with the same key; return the key.

        Parameters
        ----------
        name, key : str
        outputs : sequence of str
            Files and folders that the stage always writes.
        work : callable
            Does the work and returns the number of items worked on.
        optional : sequence of str
            Files that it may write; old ones are deleted as well when the key has changed.
        """
        if not self.run.is_done(name, key):
            self.run.begin(name, key, outputs, optional)
            with self.run.timed(name) as count:
                count["items"] = work()
            self.run.finish(name)
        return key

    def write_record(self) -> None:
        """Write `run.toml`: source, settings and versions, enough to repeat the run."""
        source = (
            self.capture.path if self.capture is not None else self.scans.source if self.scans is not None else None
        )
        model = {} if self.model is None else {"model": str(self.model)}
        kind = "capture" if self.capture is not None else "scans"
        packages = ("numpy", "scipy", "numba", "open3d", "opencv-python-headless", "pycolmap", "trimesh")
        self.run.write_record(
            {
                "geomocap": {"version": geomocap.__version__},
                "source": {"kind": kind, "path": str(source), "fps": self.fps, "up": self.up, **model},
                "versions": {"python": platform.python_version(), **{p: version(p) for p in packages}},
                "config": self.config.model_dump(mode="json", exclude_none=True),
            }
        )

    @property
    def up(self) -> str:
        """The world axis that points up."""
        return self.capture.info.up if self.capture is not None else self.config.scans.up
