"""A run: the output folder, written whole file by whole file, that knows which of its stages are up to date.

Every stage has a key, the digest of all its inputs, its settings and the code that it uses. The keys are kept in
`RUN/.stages/`. A stage whose key has changed is cleared before it writes; one whose key is the same goes on from the
files that are there.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
import time
import tomllib
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from geomocap.errors import RunError
from geomocap.files.atomic import write_text
from geomocap.files.npz import read_npz, write_npz
from geomocap.source_digest import module_digest
from geomocap.version import __version__


def stage_key(module: str, *parts: Any) -> str:
    """Digest of all that a stage's results depend on: its code, its inputs and its settings.

    Parameters
    ----------
    module : str
        The stage's module, `__name__` there: what this module and those that it imports do is part of the key, comments
        and docstrings are not.
    *parts
        Strings, numbers, settings dumped to dicts.
    """
    text = json.dumps([__version__, module_digest(module), *parts], sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes
    ----------
    path : Path
        The folder; made when something is written.
    """

    path: Path
    _timings_lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    def __getstate__(self) -> dict:
        return {"path": self.path}

    def __setstate__(self, state: dict) -> None:
        object.__setattr__(self, "path", state["path"])
        object.__setattr__(self, "_timings_lock", threading.Lock())

    # --- files ---

    def silhouette_file(self, camera: str, frame: int) -> Path:
        """Path of a silhouette."""
        return self.path / "silhouettes" / camera / f"{frame:06d}.png"

    def frame_file(self, kind: str, frame: int) -> Path:
        """Path of a frame's geometry; `kind` is voxels, cloud or bodies."""
        return self.path / kind / f"{frame:06d}.ply"

    def frames(self, kind: str) -> list[int]:
        """Frame numbers of a kind of geometry that are there."""
        return sorted(int(p.stem) for p in (self.path / kind).glob("[0-9]*.ply"))

    def has(self, name: str) -> bool:
        """Whether a file is there."""
        return (self.path / name).is_file()

    def write_npz(self, name: str, **arrays: Any) -> None:
        """Write an NPZ file of plain arrays, whole or not at all."""
        write_npz(self.path / name, arrays)

    def read_npz(self, name: str, only: Collection[str] = ()) -> dict[str, np.ndarray]:
        """Read an NPZ file of the run; of its arrays those named in `only`, if any are."""
        return read_npz(self.path / name, only)

    # --- stages ---

    def begin(self, stage: str, key: str, outputs: Sequence[str], optional: Sequence[str] = ()) -> None:
        """Open a stage for writing: if its key has changed, delete what it wrote before and what was made from that.

        Parameters
        ----------
        stage : str
        key : str
            From `stage_key`.
        outputs : sequence of str
            Files and folders of the run that the stage always writes.
        optional : sequence of str
            Those that it may write, or that others make from its outputs.
        """
        if self._state(stage).get("key") == key:
            return
        try:
            for name in (*outputs, *optional):
                target = self.path / name
                if target.is_dir():
                    shutil.rmtree(target)
                else:
                    target.unlink(missing_ok=True)
        except OSError as error:
            raise RunError(f"{self.path}: old results of {stage} can't be deleted ({error.strerror})") from None
        self._write_state(stage, {"key": key, "done": False, "outputs": list(outputs)})

    def finish(self, stage: str) -> None:
        """Mark a stage as complete."""
        self._write_state(stage, {**self._state(stage), "done": True})

    def is_done(self, stage: str, key: str) -> bool:
        """Whether the stage is complete with this key and all its outputs are still there."""
        state = self._state(stage)
        if state.get("key") != key or not state.get("done"):
            return False
        return all((self.path / name).exists() for name in state["outputs"])

    def unfinished(self) -> list[str]:
        """Stages that were begun and aren't complete."""
        return [f.stem for f in sorted((self.path / ".stages").glob("*.json")) if not self._state(f.stem).get("done")]

    def _state(self, stage: str) -> dict[str, Any]:
        try:
            return json.loads((self.path / ".stages" / f"{stage}.json").read_text())
        except (OSError, ValueError):
            return {}

    def _write_state(self, stage: str, state: dict[str, Any]) -> None:
        write_text(self.path / ".stages" / f"{stage}.json", json.dumps(state))

    # --- records ---

    def write_record(self, record: dict[str, Any]) -> None:
        """Write `run.toml`: the configuration, the versions and the source."""
        write_text(self.path / "run.toml", tomli_w.dumps(record))

    def read_record(self) -> dict[str, Any]:
        """Read `run.toml`.

        Raises
        ------
        RunError
            If the folder is no run.
        """
        file = self.path / "run.toml"
        try:
            return tomllib.loads(file.read_text(encoding="utf-8"))
        except OSError:
            raise RunError(f"{self.path}: no run folder, it has no run.toml") from None
        except tomllib.TOMLDecodeError as error:
            raise RunError(f"{file}: not valid TOML ({error})") from None

    @contextmanager
    def timed(self, stage: str) -> Iterator[dict[str, int]]:
        """Measure a stage into `timings.json`; set `items` of the yielded dict to what was worked on."""
        count = {"items": 0}
        start = time.perf_counter()
        yield count
        seconds = time.perf_counter() - start
        if count["items"] == 0:
            return
        with self._timings_lock:
            timings = self.read_timings()
            rate = count["items"] / seconds if seconds > 0 else 0.0
            timings[stage] = {
                "seconds": round(seconds, 4),
                "items": count["items"],
                "items_per_second": round(rate, 3),
            }
            write_text(self.path / "timings.json", json.dumps(timings, indent=1))

    def read_timings(self) -> dict[str, dict[str, float]]:
        """Read `timings.json`; empty if there is none."""
        try:
            return json.loads((self.path / "timings.json").read_text())
        except (OSError, ValueError):
            return {}
