"""Finds out what a path is and describes it."""

from __future__ import annotations

from pathlib import Path

from geomocap.errors import GeomocapError
from geomocap.files.scan_geometry import SCAN_ENDINGS
from geomocap.inspection.calibrations import describe_calibration
from geomocap.inspection.capture_description import describe_capture
from geomocap.inspection.description import Description
from geomocap.inspection.motion_files import ENDINGS, describe_motion_file
from geomocap.inspection.runs import describe_run
from geomocap.inspection.scan_description import describe_scans
from geomocap.inspection.truths import describe_truth


class InspectionError(GeomocapError):
    """A path that is nothing that geomocap knows."""


def describe(path: Path, metres_per_unit: float = 1.0) -> Description:
    """Describe a capture, run, calibration, truth, motion file or scans; what is wrong is part of the description.

    Parameters
    ----------
    path : Path
    metres_per_unit : float
        Of scans.

    Raises
    ------
    InspectionError
        If there is nothing, or nothing known, at the path.
    """
    if not path.exists():
        raise InspectionError(f"{path}: no such file or folder")
    if path.is_dir():
        if (path / "run.toml").is_file() or (path / "skeleton.npz").is_file():
            return describe_run(path)
        if (path / "capture.toml").is_file():
            return describe_capture(path)
        if (path / "truth.npz").is_file():
            return describe_truth(path)
        for folder in (path, path / "sparse"):
            if any((folder / f"cameras{ending}").is_file() for ending in (".txt", ".bin")):
                return describe_calibration(folder)
        if any(file.suffix.lower() in SCAN_ENDINGS for file in path.iterdir()):
            return describe_scans(path, metres_per_unit)
        raise InspectionError(
            f"{path}: neither a capture (capture.toml), a run (run.toml), a truth (truth.npz), a calibration "
            f"(cameras.txt or cameras.bin) nor scans ({', '.join(e[1:] for e in SCAN_ENDINGS)})"
        )
    if path.name == "truth.npz":
        return describe_truth(path)
    if path.suffix.lower() in ENDINGS:
        return describe_motion_file(path)
    if path.suffix.lower() in SCAN_ENDINGS:
        return describe_scans(path, metres_per_unit)
    raise InspectionError(
        f"{path}: no known kind of file; motion files are {', '.join(ENDINGS)}, scans {', '.join(SCAN_ENDINGS)}"
    )
