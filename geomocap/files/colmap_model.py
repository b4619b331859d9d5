"""Cameras and posed images of a COLMAP model, text or binary; its points aren't looked at.

Read here and not by COLMAP's own reader, which trusts the numbers of items that a file claims: a binary model that is
cut off makes it wait for ever or take all memory. The formats are those of COLMAP's documentation ("Output Format").
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap
from geomocap.reading import harmless, read_bytes, read_text, shortened

MOST_MODEL = 1 << 30  # bytes of a file; images of big models list all their points
NOT_UNIT = 1e-3  # as far may the length of a quaternion be from one: four digits


@dataclass(frozen=True)
class PosedImage:
    """An image of a model.

    Attributes
    ----------
    name : str
    camera : int
        Number of its camera.
    pose : (3, 4) float
        Camera from world.
    off : float
        By how much its quaternion's length differs from one, as written; it is made one.
    """

    name: str
    camera: int
    pose: np.ndarray
    off: float = 0.0


@dataclass(frozen=True)
class ColmapModel:
    """Cameras by their numbers, and the images with poses."""

    cameras: dict[int, pycolmap.Camera]
    images: tuple[PosedImage, ...]


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read a model; the binary files are taken where both kinds are there.

    Raises
    ------
    CalibrationError
        If a file is missing, ends early, or holds something that is no camera or pose.
    """
    cameras, images = folder / "cameras.bin", folder / "images.bin"
    if cameras.exists() and images.exists():
        return ColmapModel(_binary_cameras(cameras), tuple(_binary_images(images)))
    cameras, images = folder / "cameras.txt", folder / "images.txt"
    for file in (cameras, images):
        if not file.exists():
            raise CalibrationError(f"{folder}: no readable COLMAP model (no {file.stem}.bin and no {file.name})")
    return ColmapModel(_text_cameras(cameras), tuple(_text_images(images)))


# --- text ---


def _text_cameras(file: Path) -> dict[int, pycolmap.Camera]:
    found: dict[int, pycolmap.Camera] = {}
    for number, line in enumerate(read_text(file, CalibrationError, most=MOST_MODEL).splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{file}: line {number}"
        if len(words) < 5:
            raise CalibrationError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS…, got {_quoted(line)}")
        key = _integer(words[0], where)
        if key in found:
            raise CalibrationError(f"{where}: camera {key} is there twice")
        model = getattr(pycolmap.CameraModelId, words[1], None) if words[1].isupper() else None
        if model is None or int(model) < 0:
            raise CalibrationError(f"{where}: camera {key} has a lens model that isn't known, {_quoted(words[1])}")
        size = _integer(words[2], where), _integer(words[3], where)
        found[key] = _camera(model, *size, [_number(w, where) for w in words[4:]], f"{where}: camera {key}")
    if not found:
        raise CalibrationError(f"{file}: holds no camera; is it whole?")
    return found


def _text_images(file: Path) -> Iterator[PosedImage]:
    lines = enumerate(read_text(file, CalibrationError, most=MOST_MODEL).splitlines(), start=1)
    for number, line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        where = f"{file}: line {number}"
        if len(words) < 10:
            raise CalibrationError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {_quoted(line)}"
            )
        values = [_number(w, where) for w in words[1:8]]
        yield _image(words[9].strip(), _integer(words[8], where), values, where)
        next(lines, None)  # its points


# --- binary ---


@dataclass
class _Bytes:
    """The bytes of a file, read one after the other."""

    file: Path
    data: bytes
    at: int = 0

    def take(self, form: str) -> tuple:
        size = struct.calcsize(form)
        if self.at + size > len(self.data):
            raise self.early()
        values = struct.unpack_from(form, self.data, self.at)
        self.at += size
        return values

    def count(self, least: int, what: str) -> int:
        """Read a number of items of at least so many bytes, for which there must be room."""
        (number,) = self.take("<Q")
        if number * least > len(self.data) - self.at:
            raise CalibrationError(f"{self.file}: claims {number:,} {what}, its length has not the room; copy it again")
        return int(number)

    def skip(self, size: int) -> None:
        if self.at + size > len(self.data):
            raise self.early()
        self.at += size

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.early()
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise CalibrationError(f"{self.file}: an image's name is no text; copy the file again") from None

    def early(self) -> CalibrationError:
        return CalibrationError(f"{self.file}: ends too early, after {len(self.data):,} bytes; copy it again")


def _bytes_of(file: Path) -> _Bytes:
    try:
        return _Bytes(file, read_bytes(file, MOST_MODEL))
    except OSError as error:
        raise CalibrationError(f"{file}: can't be read ({error.strerror or error})") from None


def _binary_cameras(file: Path) -> dict[int, pycolmap.Camera]:
    stream, found = _bytes_of(file), dict[int, pycolmap.Camera]()
    models = {int(m): m for m in pycolmap.CameraModelId.__members__.values() if int(m) >= 0}
    for _ in range(stream.count(24, "cameras")):
        key, kind, width, height = stream.take("<IiQQ")
        where = f"{file}: camera {key}"
        if kind not in models:
            raise CalibrationError(f"{where}: has lens model number {kind}, which isn't known; copy the file again")
        params = stream.take(f"<{_parameter_count(models[kind])}d")
        if key in found:
            raise CalibrationError(f"{where}: is there twice; copy the file again")
        found[key] = _camera(models[kind], width, height, list(params), where)
    if not found:
        raise CalibrationError(f"{file}: holds no camera; is it whole?")
    return found


def _binary_images(file: Path) -> Iterator[PosedImage]:
    stream = _bytes_of(file)
    for _ in range(stream.count(73, "images")):
        key, *values, camera = stream.take("<I7dI")
        name = stream.text()
        stream.skip(24 * stream.count(24, "points of an image"))
        yield _image(name, camera, values, f"{file}: image {key}")


# --- what both hold ---


def _parameter_count(model: pycolmap.CameraModelId) -> int:
    return len([p for p in pycolmap.Camera(model=model).params_info.split(",") if p.strip()])


def _camera(model: pycolmap.CameraModelId, width: int, height: int, params: list[float], where: str) -> pycolmap.Camera:
    if not (0 < width < 1 << 31 and 0 < height < 1 << 31):
        raise CalibrationError(f"{where}: an image of {width}×{height} pixels can't be")
    expected = _parameter_count(model)
    if len(params) != expected:
        raise CalibrationError(f"{where}: {len(params)} numbers for the lens model {model.name}, expected {expected}")
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def _image(name: str, camera: int, values: list[float], where: str) -> PosedImage:
    quaternion, translation = np.array(values[:4]), np.array(values[4:])
    place = f"{where} ({harmless(shortened(name))})"
    if not np.isfinite(values).all():
        raise CalibrationError(f"{place}: its pose holds numbers that are not finite")
    length = math.hypot(*values[:4])
    if abs(length - 1) > NOT_UNIT:
        raise CalibrationError(f"{place}: its rotation is no unit quaternion (length {length:.4g}); write it again")
    rotation = Rotation.from_quat(quaternion / length, scalar_first=True).as_matrix()
    return PosedImage(name, camera, np.column_stack([rotation, translation]), abs(length - 1))


def _integer(word: str, where: str) -> int:
    if not word.lstrip("+-").isdecimal() or len(word) > 20:
        raise CalibrationError(f"{where}: expected a whole number, got {_quoted(word)}")
    return int(word)


def _number(word: str, where: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise CalibrationError(f"{where}: expected a number, got {_quoted(word)}") from None


def _quoted(text: str) -> str:
    return f"'{harmless(shortened(text.strip()))}'"
