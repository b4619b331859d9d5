"""Writing files whole or not at all, and saying what a folder's files are without reading them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from geomocap.errors import RunError


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make a temporary file beside `path`, with the same ending, then rename it.

    A killed process leaves at most a hidden temporary file, which the next call for the same path replaces.

    Raises
    ------
    RunError
        If the disk is full, read-only or the folder can't be made, such as where a file is in the way; nothing is left
        behind then.
    """
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if write(temporary) is False or not temporary.exists():  # Open3D and OpenCV say no by a return value
            raise OSError("nothing was written; is the disk full?")
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        in_the_way = next((p for p in path.parents if p.is_file()), None)
        if in_the_way is not None:
            raise RunError(
                f"{path}: can't be written ({in_the_way} is a file, a folder is expected); choose another folder"
            ) from None
        raise RunError(
            f"{path}: can't be written ({error.strerror or error}); free space or choose another folder"
        ) from None
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text whole or not at all."""
    write_atomic(path, lambda p: p.write_text(text, encoding="utf-8"))


def fingerprint(paths: Iterable[Path]) -> str:
    """Digest of names, sizes and modification times of files, folders included recursively."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(paths):
        for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
            if file.exists():
                stat = file.stat()
                digest.update(f"{file.as_posix()}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
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
