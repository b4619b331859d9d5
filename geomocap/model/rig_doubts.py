"""What is suspicious about the cameras of a rig, whatever they see: focal lengths, directions, distances, unit."""

from __future__ import annotations

import numpy as np

from geomocap.model.rig import Rig

LEAST_BASELINE = 0.01  # m; cameras nearer than this to each other see no depth
NEAREST, FARTHEST = 0.02, 1000.0  # m; no lens focuses nearer
HFOV_DEG = (5.0, 150.0)


def rig_doubts(rig: Rig) -> list[str]:
    """Return what is suspicious about a rig, one line each."""
    doubts = []
    centres, looking = rig.centers, rig.viewing_directions
    meeting = meeting_point(rig)
    for c, name in enumerate(rig.names):
        hfov = hfov_deg(rig, c)
        if not HFOV_DEG[0] <= hfov <= HFOV_DEG[1]:
            doubts.append(f"camera {name}: sees {hfov:.1f}° across; check its focal length and image size")
        if np.dot(meeting - centres[c], looking[c]) <= 0:
            doubts.append(f"camera {name}: looks away from where the others look; its pose may be inverted")
        far, near = float(np.linalg.norm(centres[c])), float(np.linalg.norm(centres[c] - meeting))
        if far > FARTHEST:
            doubts.append(f"camera {name}: stands {far:.0f} m from the origin; lengths must be metres")
        if len(rig) > 1 and near < NEAREST:
            doubts.append(f"camera {name}: stands {near:.2g} m from what the cameras look at; lengths must be metres")
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + np.eye(len(rig)) * 1e9
    if len(rig) > 1 and apart.min() < LEAST_BASELINE:
        a, b = np.unravel_index(np.argmin(apart), apart.shape)
        doubts.append(f"cameras {rig.names[a]} and {rig.names[b]} stand in one place; no depth can come from them")
    if len(rig) < 2:
        doubts.append("one camera can't measure depth; at least two are needed")
    return doubts


def hfov_deg(rig: Rig, camera: int) -> float:
    """Return what a camera sees across, degrees."""
    one = rig.cameras[camera]
    return float(np.rad2deg(2 * np.arctan2(one.width, 2 * one.mean_focal_length())))


def meeting_point(rig: Rig) -> np.ndarray:
    """Point nearest to all optical axes, (3,) float, metres, in the least squares sense."""
    across = np.eye(3) - rig.viewing_directions[:, :, None] * rig.viewing_directions[:, None]
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("cij,cj->i", across, rig.centers), rcond=None)[0]
