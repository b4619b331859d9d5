"""Calibrations, described."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.files.rigs import read_rig
from geomocap.inspection.description import Description, count
from geomocap.model.rig import Rig

LEAST_BASELINE = 0.01  # m; cameras nearer than this to each other see no depth
FARTHEST = 1000.0  # m
HFOV_DEG = (5.0, 150.0)


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
    centres, looking = rig.centers, rig.viewing_directions
    meeting = _meeting_point(centres, looking)
    told.fact("calibration", f"{count(len(rig), 'camera')}, looking at about {_point(meeting)} m")
    for c, (name, camera) in enumerate(zip(rig.names, rig.cameras, strict=True)):
        focal = float(camera.mean_focal_length())
        hfov = float(np.rad2deg(2 * np.arctan(camera.width / (2 * focal))))
        distance = float(np.linalg.norm(centres[c] - meeting))
        told.fact(
            name,
            f"{camera.model.name} {camera.width}×{camera.height}, focal length {focal:.1f} px ({hfov:.0f}° across), "
            f"at {_point(centres[c])} m, {distance:.2f} m away",
        )
        if not HFOV_DEG[0] <= hfov <= HFOV_DEG[1]:
            told.problem(f"camera {name}: sees {hfov:.1f}° across; check its focal length and image size")
        if np.dot(meeting - centres[c], looking[c]) <= 0:
            told.problem(f"camera {name}: looks away from where the others look; its pose may be inverted")
        far = float(np.linalg.norm(centres[c]))
        if far > FARTHEST:
            told.problem(f"camera {name}: stands {far:.0f} m from the origin; lengths must be metres")
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + np.eye(len(rig)) * 1e9
    if len(rig) > 1 and apart.min() < LEAST_BASELINE:
        a, b = np.unravel_index(np.argmin(apart), apart.shape)
        told.problem(f"cameras {rig.names[a]} and {rig.names[b]} stand in one place; no depth can come from them")
    if len(rig) < 2:
        told.problem("one camera can't measure depth; at least two are needed")


def _meeting_point(centres: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Point nearest to all optical axes, (3,), in the least squares sense."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("cij,cj->i", across, centres), rcond=None)[0]


def _point(p: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in p) + ")"
