"""The one door for writing: files and folders appear under their names whole, or not at all.

What is written is made beside its place under a name of its own, checked, and renamed. A killed process leaves at most
such a hidden name, which `remove_remains` knows. Libraries that don't say when a disk is full (Open3D, OpenCV, ezc3d,
pycolmap) are given a check of what they wrote. Also here: what a folder's files are, without reading them.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import tempfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from geomocap.errors import GeomocapError, RunError

Check = Callable[[Path], bool]

_UNABLE = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)  # of file systems that can't do what is asked
_NOT_WHOLE = "it could not be written whole"
_PROBE = 1 << 20  # bytes: more than any library holds back
_TEMPORARY = re.compile(r"\.geomocap-([0-9a-f]{8})-(\d+)-[0-9a-f]{8}\.tmp(\..*)?")


def write_atomic(
    path: Path, write: Callable[[Path], object], whole: Check | None = None, *, lasting: bool = True
) -> None:
    """Let `write` make a file beside `path`, with the same ending, check it, then rename it.

    Parameters
    ----------
    path : Path
    write : callable
        Makes the file it is given the name of; it may return False to say that it couldn't.
    whole : callable, optional
        Whether the file made is whole, for libraries that don't say so.
    lasting : bool
        Wait until the file is on the disk. Not worth it for the many files of a stage, whose sizes are recorded.

    Raises
    ------
    RunError
        If the disk is full, read-only or the folder can't be made, such as where a file is in the way; nothing is left
        behind then.
    """
    temporary = temporary_beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        said = write(temporary)
        if said is False or not temporary.exists() or not (whole or _has_something)(temporary):
            raise OSError(_NOT_WHOLE)
        if lasting:
            _to_disk(temporary)
        os.replace(temporary, path)
    except BaseException as error:
        reason = _reason(error, temporary)
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if reason is None:
            raise
        raise _unwritable(path, reason) from None


def write_bytes(path: Path, data: bytes | memoryview, *, lasting: bool = True) -> None:
    """Write bytes whole or not at all."""
    write_atomic(path, lambda p: p.write_bytes(data), lambda p: p.stat().st_size == len(data), lasting=lasting)


def write_text(path: Path, text: str, *, lasting: bool = True) -> None:
    """Write UTF-8 text whole or not at all."""
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError as error:
        what = error.object[error.start : error.end].encode("utf-8", "backslashreplace").decode()
        raise RunError(f"{path}: can't name a path with {what}, which isn't UTF-8; rename that folder") from None
    write_bytes(path, data, lasting=lasting)


def by_library(write: Callable[[Path], object]) -> Callable[[Path], object]:
    """Return what writes by a library that can only name UTF-8: elsewhere, where a folder is called otherwise."""

    def named(path: Path) -> object:
        try:
            str(path).encode()
        except UnicodeEncodeError:
            with tempfile.TemporaryDirectory() as folder:
                written = write(Path(folder) / path.name)
                shutil.copyfile(Path(folder) / path.name, path)
                return written
        return write(path)

    return named


def copy_whole(source: Path, target: Path) -> None:
    """Copy a file whole or not at all."""
    size = source.stat().st_size
    write_atomic(target, lambda p: shutil.copyfile(source, p), lambda p: p.stat().st_size == size, lasting=False)


def write_folder(
    folder: Path, write: Callable[[Path], object], whole: Check | None = None, own: Collection[str] = ()
) -> None:
    """Let `write` fill a folder beside `folder`, check it, then put it in its place as a whole.

    Parameters
    ----------
    folder : Path
    write : callable
        Fills the empty folder it is given the name of.
    whole : callable, optional
        Whether the folder is whole.
    own : collection of str
        Names of files that are replaced or go; all others in the folder are kept.

    Raises
    ------
    RunError
        As `write_atomic`.
    """
    folder = folder.resolve()  # what a link leads to is replaced, not the link
    temporary, before = temporary_beside(folder), folder.with_name(f".{folder.name}.before")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        if before.exists() and not folder.exists():  # killed between the two renames below
            before.rename(folder)
        remove_remains([folder.parent])
        temporary.mkdir()
        said, files = write(temporary), [p for p in temporary.rglob("*") if p.is_file()]
        if said is False or not all(map(_has_something, files)) or not (whole is None or whole(temporary)):
            raise OSError(_NOT_WHOLE)
        for file in files:
            _to_disk(file)
        if folder.exists():
            made = {f.name for f in temporary.iterdir()}
            for other in folder.iterdir():
                if other.name not in made and other.name not in own:
                    _take_along(other, temporary / other.name)
            shutil.rmtree(before, ignore_errors=True)
            folder.rename(before)
        temporary.rename(folder)
        shutil.rmtree(before, ignore_errors=True)
    except BaseException as error:
        reason = _reason(error, temporary / "probe")
        if before.exists() and not folder.exists():
            before.rename(folder)
        shutil.rmtree(temporary, ignore_errors=True)
        if reason is None:
            raise
        raise _unwritable(folder, reason) from None


# --- names under which files are made ---


def temporary_beside(path: Path) -> Path:
    """Return a name beside a path, with its ending, that no other process or thread has."""
    return path.with_name(f".geomocap-{_machine()}-{os.getpid()}-{secrets.token_hex(4)}.tmp{path.suffix}")


def remains(folders: Iterable[Path]) -> Iterator[Path]:
    """Find what killed processes left in folders, not in those below."""
    for folder in folders:
        if folder.is_dir():
            with os.scandir(folder) as entries:
                yield from (Path(e.path) for e in entries if _TEMPORARY.fullmatch(e.name))


def remove_remains(folders: Iterable[Path], *, alone: bool = False) -> None:
    """Remove what killed processes left in folders; those of other machines only if nobody else works there."""
    for path in list(remains(folders)):
        if alone or _is_left(path.name):
            with suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _is_left(name: str) -> bool:
    """Whether the process that a temporary name is of has ended, as far as can be told."""
    found = _TEMPORARY.fullmatch(name)
    if found is None or found[1] != _machine() or os.name != "posix":
        return False
    try:
        os.kill(int(found[2]), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False


def _machine() -> str:
    return f"{zlib.crc32(platform.node().encode('utf-8', 'replace')):08x}"


def make_room(path: Path, size: int) -> None:
    """Make sure that a file of so many bytes has room, where the file system can tell.

    Raises
    ------
    OSError
        If there is none.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    with path.open("wb") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            if error.errno not in _UNABLE:
                raise


# --- what went wrong ---


def _reason(error: BaseException, temporary: Path) -> OSError | None:
    """Return what keeps a file from being written; None if that isn't what went wrong.

    Libraries swallow the reason, or say it in words of their own: the disk is asked once more.
    """
    if isinstance(error, OSError) and error.errno is not None and error.errno in errno.errorcode:
        return OSError(error.errno, os.strerror(error.errno))
    if isinstance(error, GeomocapError) or not isinstance(error, Exception):
        return None
    try:
        with temporary.open("ab") as file:
            file.write(bytes(_PROBE))
            file.flush()
            os.fsync(file.fileno())
    except OSError as asked:
        return asked
    return error if isinstance(error, OSError) else None


def _unwritable(path: Path, reason: OSError) -> RunError:
    with suppress(OSError):
        in_the_way = next((p for p in path.parents if p.is_file()), None)
        if in_the_way is not None:
            what = f"{in_the_way} is a file, a folder is expected"
            return RunError(f"{path}: can't be written ({what}); move it or choose another folder")
    return RunError(f"{path}: can't be written ({reason.strerror or reason}); free space or choose another folder")


# --- files ---


def _has_something(path: Path) -> bool:
    return path.stat().st_size > 0


def _to_disk(path: Path) -> None:
    with path.open("rb+") as file:
        try:
            os.fsync(file.fileno())
        except OSError as error:
            if error.errno not in _UNABLE:
                raise


def _take_along(source: Path, target: Path) -> None:
    """Give a file or folder a second name, or copy it where that can't be."""
    if source.is_dir() and not source.is_symlink():
        shutil.copytree(source, target, symlinks=True, copy_function=_link)
    else:
        _link(source, target)


def _link(source: str | Path, target: str | Path) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except (OSError, NotImplementedError):
        shutil.copy2(source, target, follow_symlinks=False)


def fingerprint(paths: Iterable[Path]) -> str:
    """Digest of names, sizes and modification times of files, folders included recursively."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(paths):
        for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
            if file.exists():
                stat = file.stat()
                digest.update(os.fsencode(f"{file.as_posix()}\0{stat.st_size}\0{stat.st_mtime_ns}\n"))
    return digest.hexdigest()


def links(path: Path, depth: int) -> Iterator[Path]:
    """Find the symbolic links at a path and in the folders below it, `depth` levels deep."""
    if path.is_symlink():
        yield path
    if depth and path.is_dir():
        with os.scandir(path) as entries:
            for entry in entries:
                if depth > 1 or entry.is_symlink():
                    yield from links(Path(entry.path), depth - 1)
