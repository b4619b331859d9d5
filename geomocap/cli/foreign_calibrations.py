"""Calibrations of other tools where a command takes anything that can be looked at."""

from __future__ import annotations

from pathlib import Path

from geomocap.files.scan_geometry import SCAN_ENDINGS
from geomocap.model.rig import Rig

_OWN = ("run.toml", "skeleton.npz", "capture.toml", "truth.npz", "cameras.txt", "cameras.bin", "sparse")
_ENDINGS = (".toml", ".yml", ".yaml", ".xml", ".json", ".txt")


def foreign_calibration(path: Path, metres_per_unit: float) -> Rig | None:
    """Read the cameras of a file or folder that only can be a calibration of another tool; None if it is not.

    Raises
    ------
    CalibrationError
        If no such calibration is recognised, or can't be read.
    """
    if path.is_dir():
        if any((path / own).exists() for own in _OWN):
            return None
        endings = {file.suffix.lower() for file in path.iterdir()}
        if endings & set(SCAN_ENDINGS) or not endings & set(_ENDINGS):
            return None
    elif not path.is_file() or path.suffix.lower() not in _ENDINGS:
        return None
    from data_tools.calibration_files import read_calibration

    return read_calibration(path, metres_per_unit)
