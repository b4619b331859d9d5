"""What every stage of the pipeline is given, and how a stage knows that it has nothing to do."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from geomocap.config import Config
from geomocap.files.capture import Capture
from geomocap.files.preview import PreviewCapture
from geomocap.files.run import Run
from geomocap.files.run_records import source_path, source_places
from geomocap.files.run_window import RunWindow
from geomocap.files.scans import Scans
from geomocap.files.stage_records import listed_faults
from geomocap.model.windows import windows_of
from geomocap.progress import Progress, silent
from geomocap.silhouettes.background import BackgroundModel
from geomocap.version import __version__


def _say_nothing(_: str) -> None:
    """Tell nobody."""


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
        `model.npz` of the subject, from another sequence.
    tell : callable
        Told in a line what the user should know.
    backgrounds : dict of (str, int) to BackgroundModel
        By camera and the factor by which images were reduced: those that the correction of the cameras learnt, for the
        silhouettes, which take them out again.
    """

    run: Run
    config: Config
    executor: Executor
    progress: Progress = silent
    capture: Capture | None = None
    scans: Scans | None = None
    fps: float = 30.0
    model: Path | None = None
    tell: Callable[[str], object] = _say_nothing
    backgrounds: dict[tuple[str, int], BackgroundModel] = field(default_factory=dict, repr=False, compare=False)

    def stage(
        self,
        name: str,
        key: str,
        outputs: Sequence[str],
        work: Callable[[], int],
        optional: Sequence[str] = (),
        derived: Sequence[str] = (),
    ) -> str:
        """Do a stage's work, unless it has been done with the same key; return the key.

        What the run holds of another source is removed first.

        Parameters
        ----------
        name, key : str
        outputs : sequence of str
            Files and folders that the stage always writes.
        work : callable
            Does the work and returns the number of items worked on.
        optional : sequence of str
            Files that it may write.
        derived : sequence of str
            Files and folders that others make from its outputs, deleted as well when the key has changed.
        """
        self._leave_other_source()
        if not self.run.is_done(name, key):
            faults = self.run.begin(name, key, outputs, optional, derived)
            if faults:
                self.tell(f"{listed_faults(faults)}; made again by the stage {name}")
            with self.run.timed(name) as count:
                count["items"] = work()
            self.run.finish(name, optional)
        return key

    @property
    def windows(self) -> list[range]:
        """Windows that a capture's frames are worked on in, a single one where it is short; of scans none."""
        return [] if self.capture is None else windows_of(self.capture.n_frames, self.config.windows)

    def part(self, frames: range) -> Job:
        """Return the job of some of a capture's frames, in a folder of the run's own for them."""
        capture = None if self.capture is None else self.capture.part(frames)
        return replace(self, run=RunWindow.of(self.run, frames), capture=capture)

    def write_record(self, *tables: str) -> None:
        """Write `run.toml`: source, settings and versions, enough to repeat the run.

        What the run holds of another source is removed first.

        Parameters
        ----------
        *tables : str
            Tables of the settings to write: the other ones, and the model, stay as recorded before if the source is
            the same. By default all is written anew.
        """
        path = self.source
        source: dict[str, Any] = {
            "kind": self._kind,
            **({} if path is None else source_places(self.run.path, path)),
            "fps": self.fps,
            "up": self.up,
        }
        if isinstance(self.capture, PreviewCapture):
            source["preview"] = self.capture.record
        self.run.claim()
        self._leave_other_source()
        before = self._recorded() if tables else {}
        before = before if self._is_source(before) else {}
        model = before.get("source", {}).get("model") if self.model is None else os.path.abspath(self.model)
        kept = before.get("config", {})
        settings = self.config.model_dump(mode="json", exclude_none=True)
        packages = ("numpy", "scipy", "numba", "open3d", "opencv-python-headless", "pycolmap", "trimesh")
        self.run.write_record(
            {
                "geomocap": {"version": __version__},
                "source": source if model is None else {**source, "model": model},
                "config": {k: table if k in tables else kept.get(k, table) for k, table in settings.items()},
                # last: a text that is cut is no TOML, a number could be
                "versions": {"python": platform.python_version(), **{p: version(p) for p in packages}},
            }
        )

    @property
    def _kind(self) -> str:
        return "capture" if self.capture is not None else "scans"

    @property
    def source(self) -> Path | None:
        """Folder of the capture, or file or folder of the scans; None of neither."""
        if self.capture is not None:
            return self.capture.path
        return None if self.scans is None else self.scans.source

    def _recorded(self) -> dict[str, Any]:
        """Read the run's record; empty if there is none."""
        return self.run.read_record() if (self.run.path / "run.toml").is_file() else {}

    def _is_source(self, record: dict[str, Any]) -> bool:
        """Whether a record of the run is of this job's source."""
        before, path = record.get("source", {}), self.source
        if path is None or "path" not in before or before.get("kind") != self._kind:
            return False
        if before["path"] == source_places(self.run.path, path)["path"]:
            return True
        return source_path(self.run.path, before).resolve() == path.resolve()

    def _leave_other_source(self) -> None:
        """Remove what the run holds of a source that is not this job's, as its results say nothing of this one."""
        read = [path.resolve() for path in (self.source, self.model) if path is not None]
        if self.source is None or any(path.is_relative_to(self.run.path.resolve()) for path in read):
            return  # what is read is not removed
        record = self._recorded()
        if "path" not in record.get("source", {}) or self._is_source(record):
            return
        before = record["source"]
        names = "; names.toml stays, see that its names fit" if self.run.has("names.toml") else ""
        self.tell(
            f"{self.run.path}: held results of {before.get('kind', '?')} {source_path(self.run.path, before)}, which "
            f"are removed{names}"
        )
        self.run.clear()

    @property
    def up(self) -> str:
        """The world axis that points up."""
        return self.capture.info.up if self.capture is not None else self.config.scans.up

    @property
    def up_axis(self) -> int:
        """Number of that axis, 0 to 2."""
        return "xyz".index(self.up)
