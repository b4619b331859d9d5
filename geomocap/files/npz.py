"""NPZ files of plain arrays: nothing in them is ever executed, and they are written whole or not at all.

What one claims to hold is compared with what is there before any of it is read.
"""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from geomocap.errors import RunError
from geomocap.files.array_schema import quiet_nan
from geomocap.files.atomic import write_atomic
from geomocap.reading import open_plain, reason

UNPACKED_FREELY = 1 << 28  # bytes; arrays that unpack to no more are never looked at for their packing
MOST_PACKED = 200  # times; what was measured is packed to a half, truth values to a hundredth


def write_npz(path: Path, arrays: dict[str, Any]) -> None:
    """Write plain arrays, whole or not at all.

    Raises
    ------
    RunError
        If an array holds objects, or the file can't be written.
    """
    for key, value in arrays.items():
        if np.asarray(value).dtype == object:
            raise RunError(f"{path.name}: {key} is no plain array")

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_atomic(path, write)


def write_npz_parts(path: Path, arrays: dict[str, tuple[np.dtype, int | None, Iterable[np.ndarray]]]) -> None:
    """Write arrays that come in parts, one after the other along their first axis, and are never held as a whole.

    Parameters
    ----------
    path : Path
    arrays : dict of str to (dtype, rows, parts)
        Type, number of rows of all parts together, and the parts in their order, at least one; None: a single part,
        as it is.

    Raises
    ------
    RunError
        If the file can't be written.
    """

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
            for name, (kind, rows, parts) in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    for k, part in enumerate(parts):
                        if k == 0:
                            shape = part.shape if rows is None else (rows, *part.shape[1:])
                            header = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False}
                            np.lib.format.write_array_header_1_0(member, {**header, "shape": shape})
                        member.write(np.ascontiguousarray(part, kind).data.cast("B") if part.size else b"")

    write_atomic(path, write)


def read_npz(path: Path, only: Collection[str] = (), needed: Collection[str] = ()) -> dict[str, np.ndarray]:
    """Read the arrays of a file, or those named in `only`.

    Raises
    ------
    RunError
        If the file is missing or damaged, or has no array of one of the names `needed`.
    """
    try:
        arrays = read_arrays(path, only)
    except FileNotFoundError:
        raise RunError(f"{path}: missing; run the stage that writes it") from None
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: damaged ({reason(error)}); delete it and run again") from None
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise RunError(f"{path}: has no array {', '.join(missing)}; delete it and run again")
    return arrays


def array_names(path: Path) -> list[str]:
    """Names of the arrays in an NPZ file; raises OSError or ValueError if it is none."""
    with open_plain(path) as stream, _archive(stream) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read_arrays(path: Path, only: Collection[str] = ()) -> dict[str, np.ndarray]:
    """Read the arrays of an NPZ file, or those named in `only`; of an NPY file its one array, called "".

    Every array is numbers, truth values or text. Its header must agree with the length of its data, and these mustn't
    be a thousand times what they take in the file: such a file holds nothing that was measured.

    Raises
    ------
    OSError
        If it can't be read.
    ValueError
        If it is none, isn't whole, claims what it doesn't hold, or holds objects.
    """
    try:
        with open_plain(path) as stream:
            if stream.read(6) == b"\x93NUMPY":
                length = stream.seek(0, 2)
                stream.seek(0)
                return {"": _array(stream, length)}
            stream.seek(0)
            with _archive(stream) as archive:
                members = [m for m in archive.infolist() if not only or m.filename.removesuffix(".npy") in only]
                total = sum(m.file_size for m in members)
                if total > UNPACKED_FREELY and total > MOST_PACKED * sum(m.compress_size for m in members):
                    raise ValueError(f"it would unpack to {total / 1e9:.1f} GB of nothing")
                return {m.filename.removesuffix(".npy"): _member(archive, m) for m in members}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, struct.error) as error:
        raise ValueError(f"no whole NPZ file: {reason(error)}") from None
    except (OverflowError, MemoryError, SyntaxError, TypeError, RecursionError) as error:
        raise ValueError(reason(error)) from None


def _archive(stream: BinaryIO) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(stream)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, struct.error, OverflowError) as error:
        raise ValueError(f"no whole NPZ file: {reason(error)}") from None


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        return _array(stream, member.file_size)


def _array(stream: BinaryIO | IO[bytes], length: int) -> np.ndarray:
    """Read an array whose file has `length` bytes, if its header asks for just so many."""
    version = np.lib.format.read_magic(stream)
    read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}.get(version[0])
    if read_header is None:
        raise ValueError(f"array format {version[0]}.{version[1]} isn't known")
    try:
        shape, by_column, kind = read_header(stream)
    except Exception:  # it is a piece of Python's syntax, which many parsers of NumPy's stumble over
        raise ValueError("an array's header can't be read") from None
    if kind.hasobject or kind.kind not in "biufcSU":
        raise ValueError("an array holds no plain numbers or text")
    if any(n < 0 for n in shape):
        raise ValueError(f"an array has the shape {shape}")
    count = math.prod(shape)
    if stream.tell() + count * kind.itemsize != length:
        raise ValueError(
            f"an array of shape {shape} takes {count * kind.itemsize:,} bytes, {length - stream.tell():,} are there"
        )
    values = np.frombuffer(stream.read(), kind) if count and kind.itemsize else np.zeros(count, kind)
    return quiet_nan(values.reshape(shape, order="F" if by_column else "C").copy())
