"""Geometry files read by Open3D, which fills what is missing of a broken file with anything and says so on the screen.

Here a PLY that isn't whole is refused beforehand, and Open3D is silent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import open3d as o3d

from geomocap.errors import GeometryError
from geomocap.files.atomic import make_room
from geomocap.reading import open_plain

T = TypeVar("T")

_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_NUMERIC = b"0123456789+-.eE \t\r\n\v\fnaNA"  # all that text of finite numbers and NaN is made of
_HEADER_LIMIT = 1 << 16  # bytes
_PLY_HEADER = 512  # bytes, about
_alone = threading.Lock()  # the verbosity is one for all threads


def read_by_open3d(read: Callable[[Path], T], path: Path) -> T:
    """Read a geometry file by one of Open3D's functions, which believe whatever it claims.

    Raises
    ------
    GeometryError
        If it is a PLY that isn't whole, or nothing that Open3D makes sense of.
    """
    if path.suffix.lower() == ".ply":
        check_ply(path)
    with _alone, o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            return read(path)
        except RuntimeError:  # its words tell of its own sources
            raise GeometryError(f"{path}: holds no points with x, y and z that can be read; make it again") from None


def write_by_open3d(write: Callable[[Path, Any], bool], geometry: Any, size: int) -> Callable[[Path], bool]:
    """Return what writes a geometry by one of Open3D's functions, which is silent then.

    Where there is no room for `size` bytes it isn't called: it would go on, and its PLY library talk.
    """

    def silently(path: Path) -> bool:
        make_room(path, size + _PLY_HEADER)
        with _alone, o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            return write(path, geometry)

    return silently


@dataclass
class _Element:
    """An element of a PLY: its number, and for each property its bytes, or those of a list's length and items."""

    name: str
    count: int
    properties: list[tuple[int, ...]] = field(default_factory=list)


def check_ply(path: Path) -> None:
    """Refuse a PLY whose header can't be read or whose data end too early.

    Raises
    ------
    GeometryError
    """
    try:
        with open_plain(path) as file:
            head, end, body = file.read(_HEADER_LIMIT).partition(b"end_header")
            file.seek(len(head) + len(end))
            kind, elements = _header(head if body[:1] in (b"\n", b"\r") else b"")
            if kind == "ascii":
                body = file.read()
                if strange := body.translate(None, _NUMERIC):
                    what = f"{chr(strange[0])!r} where finite numbers are expected"
                    raise GeometryError(f"{path}: PLY has {what}; make it again")
                lines = sum(1 for line in body.splitlines() if line.strip())
                missing = sum(e.count for e in elements if e.properties) - lines
            else:
                file.readline()
                missing = _missing(file.read(), elements, "little" if "little" in kind else "big")
    except OSError as error:
        raise GeometryError(f"{path}: can't be read ({error.strerror})") from None
    except (ValueError, KeyError, IndexError, OverflowError):
        raise GeometryError(f"{path}: no PLY file, its header can't be read; make it again") from None
    if missing > 0:
        what = "lines" if kind == "ascii" else "bytes"
        raise GeometryError(f"{path}: PLY ends too early, at least {missing} {what} are missing; make it again")


def _header(head: bytes) -> tuple[str, list[_Element]]:
    """Read what stands before `end_header`; ValueError for whatever PLY libraries stumble over."""
    first, *lines = head.decode("ascii", "replace").splitlines()
    kind, elements = "", list[_Element]()
    for word, *rest in (line.split() for line in lines if line.strip()):
        match word, rest:
            case (("comment" | "obj_info"), _):
                pass
            case "format", [name, "1.0"] if not kind:
                kind = name
            case "element", [name, count]:
                elements.append(_Element(name, int(count)))
            case "property", ["list", length, item, _]:
                elements[-1].properties.append((_BYTES[length], _BYTES[item]))
            case "property", [value, _]:
                elements[-1].properties.append((_BYTES[value],))
            case _:
                raise ValueError
    if any(e.count < 0 or (e.count and not e.properties) for e in elements):
        raise ValueError
    if first.rstrip() != "ply" or not head.endswith((b"\n", b"\r")) or any(c < 9 for c in head):
        raise ValueError
    if kind not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ValueError
    return kind, elements


def _missing(body: bytes, elements: list[_Element], order: Literal["little", "big"]) -> int:
    """Count the bytes that binary elements need beyond those that are there."""
    at = 0
    for element in elements:
        if all(len(p) == 1 for p in element.properties):
            at += element.count * sum(p[0] for p in element.properties)
            continue
        end = _end_of_alike(body, at, element, order)
        if end is not None:
            at = end
            continue
        for _ in range(element.count):
            for size, *item in element.properties:
                length = int.from_bytes(body[at : at + size], order) if item else 0
                at += size + length * sum(item)
            if at > len(body):
                break
    return at - len(body)


def _end_of_alike(body: bytes, at: int, element: _Element, order: Literal["little", "big"]) -> int | None:
    """Where elements end that begin at a byte, if their lists are all as long as the first's, as those of triangles."""
    stride, lengths = 0, []
    for size, *item in element.properties:
        start = at + stride
        length = int.from_bytes(body[start : start + size], order) if item else 0
        lengths += [slice(stride, stride + size)] if item else []
        stride += size + length * sum(item)
    if at + element.count * stride > len(body):
        return None
    rows = np.frombuffer(body, np.uint8, element.count * stride, at).reshape(-1, stride)
    alike = all((rows[:, part] == rows[:1, part]).all() for part in lengths)
    return at + element.count * stride if alike else None
