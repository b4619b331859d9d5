"""The points of a C3D file, read with its length in mind: nothing is believed that the bytes don't hold.

Format: "The C3D File Format User Guide" (C3D.ORG): a header of one block of 512 bytes, a section of parameters in
groups, and frames of points and analog values. ezc3d, which writes our files, aborts the process at one that was cut
off.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomocap.export.export_errors import MotionError
from geomocap.files.array_schema import quiet_nan
from geomocap.reading import read_bytes, reason

_BLOCK = 512
_KEY = 0x50
_INTEL, _DEC, _MIPS = 84, 85, 86
_MOST_FRAMES = 10_000_000
_ROTATION_FLOATS = 17  # a 4×4 matrix and its reliability

Value = list[str] | list[float]


@dataclass(frozen=True)
class C3DFile:
    """What a C3D file holds of points.

    Attributes
    ----------
    parameters : mapping of "GROUP:NAME" to list
        Texts or numbers.
    points : (T, K, 3) float
        In the file's unit; what stands there of invalid points, too.
    residuals : (T, K) float
        In the file's unit, negative where a point is invalid.
    rate : float
        Frames per second.
    """

    parameters: Mapping[str, Value]
    points: np.ndarray
    residuals: np.ndarray
    rate: float

    def texts(self, name: str) -> list[str]:
        """Return a parameter's texts with those that go on in NAME2, NAME3 …"""
        found = [str(v) for v in self.parameters.get(name, [])]
        number = 2
        while f"{name}{number}" in self.parameters:
            found += [str(v) for v in self.parameters[f"{name}{number}"]]
            number += 1
        return found


def read_c3d_file(path: Path) -> C3DFile:
    """Read a C3D file of any of the three processors.

    Raises
    ------
    MotionError
        If it can't be read, is none, or ends before what it claims.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise MotionError(f"{path}: can't be read ({error.strerror or error})") from None
    if data[1:2] != bytes([_KEY]):
        raise MotionError(f"{path}: no C3D file, its second byte isn't 0x50")
    try:
        return _parsed(data)
    except (ValueError, struct.error, IndexError, OverflowError, TypeError) as error:
        raise MotionError(f"{path}: no readable C3D file ({reason(error)}); export it again") from None


def _parsed(data: bytes) -> C3DFile:
    at = (data[0] - 1) * _BLOCK
    if at < _BLOCK or at + 4 > len(data):
        raise ValueError("its parameters are beyond its end")
    processor = data[at + 3]
    if processor not in (_INTEL, _DEC, _MIPS):
        raise ValueError(f"processor number {processor} isn't known")
    order = ">" if processor == _MIPS else "<"
    parameters = _parameters(data, at + 4, order, processor == _DEC)
    count, analogs, first, last = struct.unpack_from(f"{order}4H", data, 2)
    start = struct.unpack_from(f"{order}H", data, 16)[0]
    scale, header_rate = (float(_floats(data[k : k + 4], order, processor == _DEC)[0]) for k in (12, 20))
    count = _whole(parameters, "POINT:USED", count)
    start = _whole(parameters, "POINT:DATA_START", start)
    scale = _number(parameters, "POINT:SCALE", scale)
    if start < 2 or not math.isfinite(scale) or scale == 0:
        raise ValueError(f"data begin in block {start} with the scale {scale}")
    frames = _frame_count(parameters, last - first + 1)
    width = 4 if scale < 0 else 2
    row = (4 * count + analogs) * width
    begin = (start - 1) * _BLOCK
    _check_length(begin + frames * row, len(data), f"{frames} frames of {count} points")
    rotations = _whole(parameters, "ROTATION:USED", 0) * frames * max(1, _whole(parameters, "ROTATION:RATIO", 1))
    if rotations:
        place = (_whole(parameters, "ROTATION:DATA_START", 0) - 1) * _BLOCK
        _check_length(place + rotations * _ROTATION_FLOATS * 4, len(data), "its rotations")
    rows = np.frombuffer(data, np.uint8, frames * row, begin).reshape(frames, row)
    body = np.ascontiguousarray(rows[:, : 4 * count * width]).tobytes()
    if scale < 0:
        values = _floats(body, order, processor == _DEC)
    else:
        values = np.frombuffer(body, f"{order}i2").astype(np.float64)
    values = values.reshape(frames, count, 4)
    with np.errstate(invalid="ignore"):
        code = np.nan_to_num(values[..., 3], nan=-1, posinf=-1, neginf=-1).clip(-32768, 65535).astype(np.int64)
    residuals = np.where(code < 0, -1.0, (code >> 8) * abs(scale))  # below it stands which cameras saw the point
    points = values[..., :3] * (1.0 if scale < 0 else scale)
    return C3DFile(parameters, points, residuals, _number(parameters, "POINT:RATE", header_rate))


def _check_length(needed: int, there: int, what: str) -> None:
    if needed > there:
        raise ValueError(f"{what} take {needed:,} bytes, it has {there:,}: it was cut off")


def _frame_count(parameters: Mapping[str, Value], header: int) -> int:
    """Count the frames; numbers beyond 65535 stand in parameters of two words or of a float."""
    frames = header
    fields = [parameters.get(f"TRIAL:ACTUAL_{end}_FIELD", []) for end in ("START", "END")]
    if all(len(f) == 2 and not isinstance(f[0], str) for f in fields):
        begin, end = (int(f[0]) % 65536 + 65536 * (int(f[1]) % 65536) for f in fields)
        frames = end - begin + 1
    elif "POINT:LONG_FRAMES" in parameters:
        frames = _whole(parameters, "POINT:LONG_FRAMES", header)
    elif header in (0, 65536) or header < 0:
        frames = _whole(parameters, "POINT:FRAMES", header) % 65536
    if not 0 <= frames <= _MOST_FRAMES:
        raise ValueError(f"it claims {frames} frames")
    return frames


def _parameters(data: bytes, at: int, order: str, dec: bool) -> dict[str, Value]:
    groups: dict[int, str] = {}
    found: list[tuple[int, str, Value]] = []
    while at + 2 <= len(data):
        length, group = struct.unpack_from("2b", data, at)
        if length == 0:
            break
        name = data[at + 2 : at + 2 + abs(length)].decode("latin-1").strip().upper()
        here = at + 2 + abs(length)
        step = struct.unpack_from(f"{order}H", data, here)[0]
        if group < 0:
            groups[-group] = name
        elif group > 0:
            found.append((group, name, _value(data, here + 2, order, dec)))
        if step == 0:
            break
        at = here + step
    return {f"{groups.get(group, group)}:{name}": value for group, name, value in found}


def _value(data: bytes, at: int, order: str, dec: bool) -> Value:
    kind, dimensions = struct.unpack_from("bB", data, at)
    shape = list(data[at + 2 : at + 2 + dimensions])
    at += 2 + dimensions
    size, total = abs(kind), math.prod(shape)
    if kind not in (-1, 1, 2, 4) or dimensions > 7 or len(shape) != dimensions or at + size * total > len(data):
        raise ValueError("a parameter ends beyond it")
    raw = data[at : at + size * total]
    if kind == -1:
        width = shape[0] if shape else 1
        texts = [raw[k : k + width] for k in range(0, len(raw), width)] if width else []
        return [t.decode("utf-8", "replace").strip("\0 ") for t in texts]
    if kind == 4:
        return _floats(raw, order, dec).tolist()
    return np.frombuffer(raw, "i1" if kind == 1 else f"{order}i2").astype(float).tolist()


def _floats(raw: bytes, order: str, dec: bool) -> np.ndarray:
    """Read numbers of 4 bytes; DEC's have their halves exchanged and an exponent that is two larger."""
    if not dec:
        return quiet_nan(np.frombuffer(raw, f"{order}f4")).astype(np.float64)
    words = np.frombuffer(raw, "<u2").reshape(-1, 2)[:, ::-1]
    return quiet_nan(np.ascontiguousarray(words).view("<f4").ravel()).astype(np.float64) / 4


def _number(parameters: Mapping[str, Value], name: str, otherwise: float) -> float:
    found = parameters.get(name, [])
    return float(found[0]) if found and not isinstance(found[0], str) else otherwise


def _whole(parameters: Mapping[str, Value], name: str, otherwise: int) -> int:
    value = _number(parameters, name, otherwise)
    if not math.isfinite(value):
        raise ValueError(f"{name} is {value}")
    return int(value) % 65536 if -32768 <= value < 0 else int(value)
