"""Calibrations, described."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.files.rigs import read_rig
from geomocap.inspection.description import Description, count
from geomocap.model.rig import Rig
from geomocap.model.rig_doubts import hfov_deg, meeting_point, rig_doubts


def describe_calibration(path: Path) -> Description:
    """Describe a calibration folder (a COLMAP model)."""
    told = Description(path, "calibration")
    try:
        describe_rig(read_rig(path), told)
    except GeomocapError as error:
        told.problem(error)
    return told


def describe_rig(rig: Rig, told: Description) -> None:
    """Add the cameras of a rig, and what is suspicious about them."""
    meeting = meeting_point(rig)
    told.fact("calibration", f"{count(len(rig), 'camera')}, looking at about {_point(meeting)} m")
    for c, (name, camera, centre) in enumerate(zip(rig.names, rig.cameras, rig.centers, strict=True)):
        told.fact(
            name,
            f"{camera.model.name} {camera.width}×{camera.height}, focal length {camera.mean_focal_length():.1f} px "
            f"({hfov_deg(rig, c):.0f}° across), at {_point(centre)} m, {np.linalg.norm(centre - meeting):.2f} m away",
        )
    for doubt in rig_doubts(rig):
        told.problem(doubt)


def _point(p: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in p) + ")"
