"""What a run knows of its stages: each stage's key, whether it is done, and the files that it wrote.

A stage's record is `RUN/.stages/<stage>.json`. While it works, the files that are finished are added line by line to
`<stage>.journal` beside it, so that a killed stage knows them too. A file counts only while it is as it was written:
of the same size, and of the same content where its time has changed.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from geomocap.errors import RunError
from geomocap.files.atomic import write_text
from geomocap.reading import open_plain, read_bytes

FOLDER = ".stages"
_CHUNK = 1 << 20  # bytes


@dataclass(frozen=True)
class FileMark:
    """What tells a file from another: bytes, time of the last change in ns, CRC-32 of its content."""

    size: int
    time: int
    crc: int

    @classmethod
    def of(cls, path: Path) -> FileMark:
        """Mark a file that is there."""
        stat = path.stat()
        return cls(stat.st_size, stat.st_mtime_ns, _crc(path))

    def fault(self, path: Path) -> str:
        """Say what is wrong with the file that was marked; nothing if it is as it was."""
        try:
            stat = path.stat()
        except (OSError, ValueError):  # the latter where no file can have such a name
            return "missing"
        if not path.is_file():
            return "no file any more"
        if stat.st_size < self.size:
            return f"cut ({stat.st_size} of {self.size} bytes)"
        if stat.st_size > self.size:
            return "replaced by another"
        if stat.st_mtime_ns == self.time:
            return ""
        try:
            return "" if _crc(path) == self.crc else "replaced by another"
        except OSError as error:
            return f"unreadable ({error.strerror})"


@dataclass(frozen=True)
class StageRecord:
    """A stage as the run knows it.

    Attributes
    ----------
    key : str
        Digest of all that the results depend on; "" if the stage was never begun.
    done : bool
    outputs : tuple of str
        Files and folders that the stage always writes.
    files : mapping of str to FileMark
        All files that it wrote, by their paths in the run.
    """

    key: str = ""
    done: bool = False
    outputs: tuple[str, ...] = ()
    files: Mapping[str, FileMark] = field(default_factory=dict)

    def faults(self, run: Path) -> dict[str, str]:
        """Say what is wrong with which file; nothing of those that are as they were written."""
        found = {name: mark.fault(run / name) for name, mark in self.files.items()}
        if self.done:
            told = {part.as_posix() for name, fault in found.items() if fault for part in Path(name).parents}
            found |= {n: "missing" for n in self.outputs if n not in told and not (run / n).exists()}
        return {name: fault for name, fault in found.items() if fault}

    def sound(self, run: Path) -> StageRecord:
        """Return the record without the files that are no longer as they were written."""
        faults = self.faults(run)
        return replace(self, files={n: mark for n, mark in self.files.items() if n not in faults})


def listed_faults(faults: Mapping[str, str], most: int = 3) -> str:
    """Say in words which files are not as they were written: up to `most` by name, of more the first one."""
    said = [f"{name} is {fault}" for name, fault in faults.items()]
    if len(said) <= most:
        return ", ".join(said)
    return f"{said[0]}, and {len(said) - 1} other files are not as they were written"


def stages(run: Path) -> list[str]:
    """Names of the stages that a run has records of."""
    return sorted(f.stem for f in (run / FOLDER).glob("*.json"))


def read_record(run: Path, stage: str) -> StageRecord:
    """Read the record of a stage with what its journal adds; an empty one if there is none that can be read."""
    try:
        said = json.loads(read_bytes(run / FOLDER / f"{stage}.json"))
        files = {str(name): FileMark(*map(int, mark)) for name, mark in said.get("files", {}).items()}
        record = StageRecord(str(said["key"]), bool(said["done"]), tuple(map(str, said["outputs"])), files)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return StageRecord()
    added = dict(files)
    for line in _lines(run / FOLDER / f"{stage}.journal"):
        try:
            name, *mark = json.loads(line)
            added[str(name)] = FileMark(*map(int, mark))
        except (ValueError, TypeError, OverflowError):  # a line that was not finished
            continue
    return replace(record, files={name: mark for name, mark in added.items() if _stays_inside(name)})


def write_record(run: Path, stage: str, record: StageRecord) -> None:
    """Write the record of a stage, which then needs no journal."""
    content: dict[str, Any] = {"key": record.key, "done": record.done, "outputs": list(record.outputs)}
    content["files"] = {name: [m.size, m.time, m.crc] for name, m in sorted(record.files.items())}
    write_text(run / FOLDER / f"{stage}.json", json.dumps(content))
    (run / FOLDER / f"{stage}.journal").unlink(missing_ok=True)


def forget_record(run: Path, stage: str) -> None:
    """Remove the record of a stage."""
    for ending in ("journal", "json"):
        (run / FOLDER / f"{stage}.{ending}").unlink(missing_ok=True)


def add_to_journal(run: Path, stage: str, files: Iterable[Path]) -> None:
    """Note files that a stage has finished.

    Raises
    ------
    RunError
        If the disk is full.
    """
    journal, lines = run / FOLDER / f"{stage}.journal", []
    try:
        for file in files:
            mark = FileMark.of(file)
            lines.append(json.dumps([file.relative_to(run).as_posix(), mark.size, mark.time, mark.crc]))
        with journal.open("a", encoding="utf-8") as stream:
            # a line begins with its break, so that one which was cut off spoils none that follows
            stream.write("".join(f"\n{line}" for line in lines))
    except OSError as error:
        with suppress(OSError):
            if not journal.stat().st_size:
                journal.unlink()
        where = error.filename or journal
        raise RunError(f"{where}: can't be written ({error.strerror}); free space and start again") from None


def _stays_inside(name: str) -> bool:
    """Whether a name of a record, which anybody may have written, is one of the run's own files."""
    path = Path(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts


def _lines(path: Path) -> list[str]:
    try:
        return read_bytes(path).decode("utf-8", "replace").splitlines()
    except OSError:
        return []


def _crc(path: Path) -> int:
    crc = 0
    with open_plain(path) as file:
        while chunk := file.read(_CHUNK):
            crc = zlib.crc32(chunk, crc)
    return crc
