"""Recognising the format of a calibration."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from data_tools.calibration_files.aniposelib import read_aniposelib
from data_tools.calibration_files.colmap import read_colmap
from data_tools.calibration_files.opencv_yaml import MATRIX_KEYS, read_easymocap, read_opencv
from data_tools.calibration_files.pose2sim import read_pose2sim
from data_tools.calibration_files.qualisys import read_qualisys
from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig
from geomocap.reading import open_plain, parse_toml, read_text

OPENCV_ENDINGS = (".yml", ".yaml", ".xml", ".json")
Kind = Literal["colmap", "easymocap", "opencv", "qualisys", "pose2sim", "aniposelib"]

_MATRIX = re.compile(rf"\b({'|'.join(MATRIX_KEYS)})\b\"?\s*[:> ]")


def detect_format(path: Path) -> Kind:
    """Recognise the format of a calibration file or folder by its content; OpenCV's files stand for their folder.

    Pose2Sim's and aniposelib's TOML differ in `fisheye`, which Pose2Sim always writes, and in 3×3 rotations and nested
    tables, which only caliscope has; otherwise they are the same and both readers agree.

    Raises
    ------
    CalibrationError
        If it is none that is known.
    """
    path = Path(path)
    if path.is_dir():
        if any(path.glob("cameras.bin")) or any(path.glob("cameras.txt")) or (path / "sparse").is_dir():
            return "colmap"
        if (path / "intri.yml").is_file():
            return "easymocap"
        for file in sorted(path.glob("*")):
            if file.suffix.lower() in OPENCV_ENDINGS:
                head = _beginning(file)
                if any(key in head for key in MATRIX_KEYS):
                    return "opencv"
        raise CalibrationError(
            f"{path}: no calibration recognised; expected a COLMAP model, intri.yml and extri.yml, or <camera>.yml"
        )
    if path.name in ("intri.yml", "extri.yml"):
        return "easymocap"
    text = read_text(path, CalibrationError, "give a calibration file")
    if "<calibration" in text and "focalLengthU" in text:
        return "qualisys"
    if path.suffix.lower() in OPENCV_ENDINGS and _MATRIX.search(text[:4000]):
        return "opencv"
    if path.suffix.lower() == ".toml":
        tables = [t for t in parse_toml(text, path, CalibrationError).values() if isinstance(t, dict)]
        if any("matrix" in t and "fisheye" in t and _is_vector(t.get("rotation")) for t in tables):
            rows = [t["rotation"] for t in tables if "matrix" in t and "rotation" in t]
            if all(map(_is_vector, rows)):
                return "pose2sim"
        if any("matrix" in t for t in tables) or any(
            isinstance(v, dict) and "matrix" in v for t in tables for v in t.values()
        ):
            return "aniposelib"
    raise CalibrationError(
        f"{path}: no calibration recognised; known are COLMAP, aniposelib, caliscope and Pose2Sim TOML, Qualisys XML, "
        "EasyMocap and OpenCV YAML"
    )


def _beginning(file: Path) -> str:
    try:
        with open_plain(file) as stream:
            return stream.read(4000).decode("utf-8", "replace")
    except OSError as error:
        raise CalibrationError(f"{file}: can't be read ({error.strerror})") from None


def _is_vector(value: object) -> bool:
    return isinstance(value, list) and len(value) == 3 and isinstance(value[0], int | float)


def read_calibration(
    path: Path, metres_per_unit: float = 1.0, sizes: Mapping[str, tuple[int, int]] | None = None
) -> Rig:
    """Read a calibration of any known format.

    Parameters
    ----------
    path : Path
    metres_per_unit : float
        Length of the file's unit, metres, where the format does not fix it (Qualisys and Pose2Sim do).
    sizes : mapping of camera name to (width, height), optional
        Image sizes for formats that may lack them (EasyMocap).

    Raises
    ------
    CalibrationError
        If it is none, or can't be read.
    """
    path = Path(path)
    kind = detect_format(path)
    if kind == "colmap":
        return read_colmap(path, metres_per_unit)
    if kind == "easymocap":
        return read_easymocap(path if path.is_dir() else path.parent, sizes, metres_per_unit)
    if kind == "opencv":
        return read_opencv(path if path.is_dir() else path.parent, metres_per_unit)
    if kind == "qualisys":
        return read_qualisys(path)
    if kind == "pose2sim":
        return read_pose2sim(path)
    return read_aniposelib(path, metres_per_unit)
