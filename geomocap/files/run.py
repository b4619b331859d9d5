"""A run: the output folder, written whole file by whole file, that knows which of its stages are up to date.

Every stage has a key, the digest of all its inputs, its settings and the code that it uses. The keys are kept in
`RUN/.stages/` with the files that each stage wrote (`stage_records`). A stage whose key has changed is cleared before
it writes; one whose key is the same goes on from its files that are as it wrote them. What is cleared is what stages
wrote, and numbered frames in their folders; files of anybody else stay.
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from geomocap.errors import RunError
from geomocap.files.atomic import links, write_text
from geomocap.files.npz import read_npz, write_npz
from geomocap.files.run_records import RECORD, TIMINGS, read_run_record, read_timings
from geomocap.files.stage_records import (
    FOLDER,
    FileMark,
    StageRecord,
    add_to_journal,
    forget_record,
    read_record,
    stages,
    write_record,
)
from geomocap.reading import count_values
from geomocap.source_digest import module_digest
from geomocap.version import __version__

_OWN = {  # folders of stages, and what is theirs there though no record says so
    "silhouettes": "*/[0-9][0-9][0-9][0-9][0-9][0-9].png",
    "voxels": "[0-9][0-9][0-9][0-9][0-9][0-9].ply",
    "cloud": "[0-9][0-9][0-9][0-9][0-9][0-9].*",
    "bodies": "[0-9][0-9][0-9][0-9][0-9][0-9].ply",
    "windows": "[0-9][0-9][0-9][0-9][0-9][0-9]/*.*",
    "review": "report.html",
}
_RESULTS = (  # as stages call them
    *(f"{name}.npz" for name in ("diagnostics", "ellipsoids", "keypoints", "model", "skeleton", "tracks")),
    *(f"{name}.json" for name in ("cameras", "check", "correction", "diagnostics")),
    *("motion.*", "angles.*", "sparse/cameras.txt"),
)
_SAID = "record"  # the stage that run.toml counts for
_NAMED = tuple(name for name in _RESULTS if "*" not in name)  # those that no one else would call so


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
        for name, value in state.items():
            object.__setattr__(self, name, value)
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

    def begin(
        self,
        stage: str,
        key: str,
        outputs: Sequence[str],
        optional: Sequence[str] = (),
        derived: Sequence[str] = (),
    ) -> dict[str, str]:
        """Open a stage for writing: if its key has changed, delete what it wrote before and what was made from that.

        Parameters
        ----------
        stage : str
        key : str
            From `stage_key`.
        outputs : sequence of str
            Files and folders of the run that the stage always writes.
        optional : sequence of str
            Those that it may write.
        derived : sequence of str
            Those that others make from its outputs.

        Returns
        -------
        dict of str to str
            Files that the stage wrote before and that are no longer as it wrote them, with what is wrong with each.
        """
        for link in (link for name in (*outputs, *optional) for link in links(self.path / name, 2)):
            raise RunError(f"{link}: is a link, a run writes into its own folder; remove it or choose another folder")
        record = read_record(self.path, stage)
        if record.key == key:
            faults = record.faults(self.path)
            if faults or record.done:
                write_record(self.path, stage, replace(record.sound(self.path), done=False))
            return faults
        try:
            (self.path / FOLDER / f"{stage}.journal").unlink(missing_ok=True)
            self._clear(stage, (*outputs, *optional), derived)
        except OSError as error:
            raise RunError(f"{self.path}: old results of {stage} can't be deleted ({error.strerror})") from None
        write_record(self.path, stage, StageRecord(key, False, tuple(outputs)))
        return {}

    def note(self, stage: str, files: Iterable[Path]) -> None:
        """Note files that a stage under way has finished: when it is begun again, it goes on from them."""
        add_to_journal(self.path, stage, files)

    def sound(self, stage: str) -> set[Path]:
        """Files of a stage that are as it wrote them."""
        return {self.path / name for name in read_record(self.path, stage).sound(self.path).files}

    def finish(self, stage: str, optional: Sequence[str] = ()) -> None:
        """Mark a stage as complete, with its files: those noted, its outputs, and what is there of `optional`."""
        record = read_record(self.path, stage).sound(self.path)
        files = [self.path / name for name in (*record.outputs, *optional)]
        self._write_files(stage, replace(record, done=True), files)

    def renew(self, stage: str, files: Iterable[Path]) -> None:
        """Take files of the run as those of a stage from now on: a command has written them, or removed those gone."""
        record, own = read_record(self.path, stage), [f for f in files if f.is_relative_to(self.path)]
        if not record.key:  # the stage itself will make them anew
            record = StageRecord("made by a command", True)
        gone = {f.relative_to(self.path).as_posix() for f in own if not f.exists()}
        kept = {name: mark for name, mark in record.files.items() if name not in gone}
        self._write_files(stage, replace(record, files=kept), own)

    def clear(self) -> None:
        """Delete all that stages and commands wrote, and know nothing of it any more; files of others stay.

        Raises
        ------
        RunError
            If something can't be deleted.
        """
        try:
            for stage in sorted(stages(self.path), key=lambda name: name == _SAID):  # what it was made from goes last
                outputs = read_record(self.path, stage).outputs
                self._clear(stage, (*_OWN, *_NAMED, TIMINGS, *outputs), ())
                forget_record(self.path, stage)
            (self.path / RECORD).unlink(missing_ok=True)
        except OSError as error:
            raise RunError(f"{self.path}: its results can't be deleted ({error.strerror})") from None

    def forget(self, stage: str) -> None:
        """Know nothing of a stage any more; its files stay."""
        forget_record(self.path, stage)

    def is_done(self, stage: str, key: str) -> bool:
        """Whether the stage is complete with this key and all its files are as it wrote them."""
        record = read_record(self.path, stage)
        return record.key == key and record.done and not record.faults(self.path)

    def unfinished(self) -> list[str]:
        """Stages that were begun and aren't complete."""
        return [stage for stage in stages(self.path) if not read_record(self.path, stage).done]

    def faults(self) -> dict[str, str]:
        """Say which files are no longer as the run's stages wrote them, and what is wrong with each."""
        found: dict[str, str] = {}
        for stage in stages(self.path):
            found |= read_record(self.path, stage).faults(self.path)
        return dict(sorted(found.items()))

    def folders(self) -> list[Path]:
        """Folders of the run that stages write into and that are there."""
        found = [self.path, *(self.path / name for name in (FOLDER, *_OWN))]
        found += [p for name in ("silhouettes", "windows") for p in (self.path / name).glob("*") if p.is_dir()]
        return [p for p in found if p.is_dir() and not p.is_symlink()]

    def _write_files(self, stage: str, record: StageRecord, files: Iterable[Path]) -> None:
        marks = {f.relative_to(self.path).as_posix(): FileMark.of(f) for f in files if f.is_file()}
        write_record(self.path, stage, replace(record, files={**record.files, **marks}))

    def _clear(self, stage: str, own: Sequence[str], derived: Sequence[str]) -> None:
        """Delete what a stage wrote and what others made from it, and nothing else."""
        records = {name: read_record(self.path, name) for name in stages(self.path)}
        written = {name for record in records.values() for name in record.files}
        gone = set(records[stage].files) if stage in records else set()
        for name in (*own, *derived):
            gone |= {n for n in written if n.startswith(f"{name}/")}
            pattern = _OWN.get(name)
            if pattern is not None:
                gone |= {p.relative_to(self.path).as_posix() for p in (self.path / name).glob(pattern)}
            elif (self.path / name).is_file():
                gone.add(name)
        folders = {self.path / name for name in (*own, *derived) if name in _OWN}
        for name in gone:
            file = self.path / name
            if file.parent.resolve().is_relative_to(self.path.resolve()):  # not through a link
                file.unlink(missing_ok=True)
                folders |= {p for p in file.parents if p != self.path and p.is_relative_to(self.path)}
        for folder in sorted(folders, key=lambda p: -len(p.parts)):
            with suppress(OSError):  # holds files of others
                folder.rmdir()
        for name, record in records.items():
            if name != stage and record.files and not record.files.keys() - gone:
                forget_record(self.path, name)

    # --- records ---

    def claim(self) -> None:
        """Make sure that what stages will write over is the run's own.

        Raises
        ------
        RunError
            If the folder is no run yet and holds results already, which then are somebody else's.
        """
        if self.has(RECORD) or stages(self.path):
            return
        patterns = (*(f"{name}/{own}" for name, own in _OWN.items()), *_RESULTS)
        theirs = next((p for pattern in patterns for p in self.path.glob(pattern)), None)
        if theirs is not None:
            raise RunError(f"{theirs}: is there, but not of a run in this folder; move it or choose another folder")

    def write_record(self, record: dict[str, Any]) -> None:
        """Write `run.toml`: the configuration, the versions and the source; how many values tells it from a cut one."""
        whole = {"geomocap": {**record.get("geomocap", {}), "entries": 0}}
        whole |= {name: table for name, table in record.items() if name != "geomocap"}
        whole["geomocap"]["entries"] = count_values(whole)
        write_text(self.path / RECORD, tomli_w.dumps(whole))
        self.renew(_SAID, [self.path / RECORD])

    def read_record(self) -> dict[str, Any]:
        """Read `run.toml`.

        Raises
        ------
        RunError
            If the folder is no run.
        """
        return read_run_record(self.path)

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
            write_text(self.path / TIMINGS, json.dumps(timings, indent=1))

    def read_timings(self) -> dict[str, dict[str, float]]:
        """Read `timings.json`; empty if there is none."""
        return read_timings(self.path)
