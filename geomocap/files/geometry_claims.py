"""What geometry files claim to hold, compared with their length before a library is let at them.

The libraries believe the numbers of points and triangles in a header: a file of a few bytes makes them take all memory.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from geomocap.errors import GeometryError
from geomocap.files.open3d_geometry import check_ply
from geomocap.reading import open_plain, read_bytes, reason

_LINE = 4096  # bytes in which a header's first line must end
_LZF = 150  # times; more than LZF can pack
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MOST = 1 << 26  # elements of an accessor without data
_PCD_ENTRIES = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_DEEPEST = 200  # nodes of a scene below each other


def check_geometry(path: Path) -> None:
    """Refuse a geometry file that claims more than it holds, of the formats that claim anything.

    Raises
    ------
    GeometryError
    """
    suffix = path.suffix.lower()
    if suffix == ".ply":
        check_ply(path)
        return
    check = _CHECKS.get(suffix)
    try:
        if check is None:
            open_plain(path).close()
        elif (missing := check(path, read_bytes(path))) > 0:
            raise GeometryError(
                f"{path}: claims more than it holds, at least {missing:,} bytes are missing; make it again"
            )
    except OSError as error:
        raise GeometryError(f"{path}: can't be read ({error.strerror or error})") from None
    except (LookupError, ValueError, TypeError, AttributeError, struct.error, RecursionError, OverflowError) as error:
        raise GeometryError(f"{path}: its header can't be read ({reason(error)}); make it again") from None


def check_faces(faces: np.ndarray, count: int, path: Path) -> None:
    """Refuse triangles (F, 3) of vertices that aren't among `count`.

    Raises
    ------
    GeometryError
    """
    if len(faces) and not (0 <= faces.min() and faces.max() < count):
        wrong = int(faces.min() if faces.min() < 0 else faces.max())
        raise GeometryError(f"{path}: a triangle names vertex {wrong}, but there are {count}; make it again")


def _count(word: bytes | str) -> int:
    number = int(word)
    if number < 0:
        raise ValueError(f"a number of {number}")
    return number


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Entries of a PCD's header, and where its data begin; its entries have to be in the order of its specification."""
    at, said, left = 0, dict[str, list[str]](), list(_PCD_ENTRIES)
    while "DATA" not in said:
        end = data.index(b"\n", at)
        line = data[at:end].decode("utf-8", "replace").removesuffix("\r").replace("\t", " ")
        at = end + 1
        if not line.strip() or line.startswith("#"):
            continue
        name, *words = line.split()
        if name not in left or not (line.isascii() and line.isprintable()):
            raise ValueError("its entries aren't VERSION, FIELDS, SIZE, TYPE, COUNT, WIDTH … in this order")
        said[name], left = words, left[left.index(name) + 1 :]
    return said, at


def _pcd(path: Path, data: bytes) -> int:
    said, at = _pcd_header(data)
    sizes = [_count(s) for s in said["SIZE"]]
    counts = [_count(c) for c in said.get("COUNT", ["1"] * len(sizes))]
    points = _count(said["POINTS"][0]) if "POINTS" in said else _count(said["WIDTH"][0]) * _count(said["HEIGHT"][0])
    if points > _count(said["WIDTH"][0]) * _count(said.get("HEIGHT", ["1"])[0]):
        raise ValueError("its WIDTH, HEIGHT and POINTS contradict each other")
    if not len(said["FIELDS"]) == len(sizes) == len(counts) > 0 or not all(counts):
        raise ValueError("its FIELDS, SIZE and COUNT contradict each other")
    if not all(0 < s <= 8 for s in sizes):
        raise ValueError("its SIZE has more than 8 bytes, or none")
    stride = sum(s * c for s, c in zip(sizes, counts, strict=True))
    rest = len(data) - at
    match said["DATA"][0]:
        case "ascii":
            return points * 2 * sum(counts) - 1 - rest
        case "binary":
            return points * stride - rest
        case "binary_compressed":
            packed, unpacked = struct.unpack_from("<II", data, at)
            if unpacked != points * stride or unpacked > _LZF * packed:
                raise ValueError("the length of its compressed data contradicts its points")
            return packed + 8 - rest
        case other:
            raise ValueError(f"data of an unknown kind, {other!r}")


def _pts(path: Path, data: bytes) -> int:
    first, _, rest = data.partition(b"\n")
    return _count(first.split()[0]) * len("0 0 0\n") - 1 - len(rest) if first.strip() else 0


def _off(path: Path, data: bytes) -> int:
    words = re.sub(rb"#[^\n]*", b"", data[: 1 << 16]).split()
    if not words[0].endswith(b"OFF"):
        raise ValueError("it doesn't begin with OFF")
    vertices, faces = _count(words[1]), _count(words[2])
    return vertices * len("0 0 0\n") + faces * len("3 0 1 2\n") - len(data)


def _stl(path: Path, data: bytes) -> int:
    if data[:5] == b"solid" and b"facet" in data[:_LINE]:
        return 0
    return 84 + 50 * struct.unpack_from("<I", data, 80)[0] - len(data)


def _glb(path: Path, data: bytes) -> int:
    magic, _, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if magic != b"glTF" or kind != b"JSON":
        raise ValueError("it doesn't begin as a GLB")
    if length > len(data) or 20 + size > length:
        return max(length, 20 + size) - len(data)
    return _gltf_claims(path, json.loads(data[20 : 20 + size].decode("utf-8")), max(0, length - 28 - size))


def _gltf(path: Path, data: bytes) -> int:
    return _gltf_claims(path, json.loads(data.decode("utf-8-sig")), 0)


def _gltf_claims(path: Path, document: dict[str, Any], embedded: int) -> int:
    """Compare accessors with their views, views with their buffers, and these with what there is."""
    lengths = []
    for k, buffer in enumerate(document.get("buffers", [])):
        uri, length = buffer.get("uri"), _count(buffer["byteLength"])
        if uri is None:
            there = embedded if k == 0 else 0
        elif uri.startswith("data:"):
            there = len(uri) * 3 // 4
        else:
            there = _beside(path, uri)
        if length > there:
            return length - there
        lengths.append(length)
    views = document.get("bufferViews", [])
    for view in views:
        if _count(view.get("byteOffset", 0)) + _count(view["byteLength"]) > lengths[_count(view["buffer"])]:
            raise ValueError("a part of a buffer ends behind it")
    for accessor in document.get("accessors", []):
        count = _count(accessor["count"])
        size = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        if "bufferView" not in accessor:
            if count > _MOST:
                raise ValueError(f"an accessor of {count:,} elements without data")
            continue
        view = views[_count(accessor["bufferView"])]
        stride = max(_count(view.get("byteStride", 0)), size)
        if count and _count(accessor.get("byteOffset", 0)) + (count - 1) * stride + size > view["byteLength"]:
            raise ValueError(f"an accessor of {count:,} elements, of which its part of the buffer has fewer")
    _check_scene(document.get("nodes", []))
    return 0


def _beside(path: Path, uri: str) -> int:
    """Length of a file that another refers to, which must be in its folder."""
    from urllib.parse import unquote

    folder = path.parent.resolve()
    file = (folder / unquote(uri)).resolve()
    if not file.is_relative_to(folder):
        raise ValueError("it refers to a file outside its own folder")
    with open_plain(file) as stream:
        return stream.seek(0, 2)


def _check_scene(nodes: list[dict[str, Any]]) -> None:
    """A scene is a tree: every node is at most one's child, and none its own ancestor."""
    parents = np.full(len(nodes), -1)
    for k, node in enumerate(nodes):
        for child in node.get("children", []):
            if parents[_count(child)] >= 0 or child == k:
                raise ValueError(f"node {child} is below two others, or below itself")
            parents[child] = k
    for k in range(len(nodes)):
        at = k
        for _ in range(_DEEPEST):
            at = int(parents[at])
            if at < 0:
                break
        else:
            raise ValueError("its nodes make a loop, or are nested too deeply")


_CHECKS: dict[str, Callable[[Path, bytes], int]] = {
    ".pcd": _pcd,
    ".pts": _pts,
    ".off": _off,
    ".stl": _stl,
    ".glb": _glb,
    ".gltf": _gltf,
}
