"""Signs that a calibration was read or written in the wrong convention, each named with its remedy."""

from __future__ import annotations

import numpy as np

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap
from geomocap.model.orientations import nearest_rotation
from geomocap.model.rig import Rig

FARTHEST = 60.0
"""Cameras farther apart are hardly metres."""

NEAREST = 0.02
"""Cameras nearer together are hardly metres."""


def rotation_matrix(values: object, where: str) -> np.ndarray:
    """Check a rotation matrix from a file; a `Rig` makes it exactly orthonormal.

    Parameters
    ----------
    values : (3, 3) floats
    where : str
        File and camera, for the error message.

    Raises
    ------
    CalibrationError
        If it is no rotation, or mirrors the world.
    """
    R = np.asarray(values, dtype=np.float64)
    nearest_rotation(R, where)
    return R


def check_size(camera: pycolmap.Camera, where: str) -> None:
    """Check that image size and principal point belong together.

    Raises
    ------
    CalibrationError
        If the principal point is far from the image's middle; it says whether width and height are swapped.
    """
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    size = np.array([camera.width, camera.height], dtype=float)
    off = np.abs(center / size - 0.5)
    if off.max() <= 0.35:
        return
    hint = "the calibration is for another image size"
    if np.abs(center / size[::-1] - 0.5).max() < 0.25:
        hint = "width and height are swapped"
    else:
        ratio = 2 * center / size
        if abs(ratio[0] - ratio[1]) < 0.15 * ratio.max():
            hint = f"it seems to be for images {ratio.mean():.2g} times as large"
    raise CalibrationError(
        f"{where}: principal point ({center[0]:.0f}, {center[1]:.0f}) is far from the middle of an image of "
        f"{camera.width}×{camera.height}; {hint}"
    )


def check_rig(rig: Rig, where: str) -> None:
    """Check that the cameras look at something together, at a distance that can be metres.

    A transposed rotation or a pose of the wrong direction (world from camera) makes cameras look apart; cameras with
    millimetres or centimetres are too far apart.

    Raises
    ------
    CalibrationError
        If they don't, and another convention would mend it, or the unit can't be the metre.
    """
    if len(rig) < 2:
        return
    centers = rig.centers
    spread = float(np.linalg.norm(centers[:, None] - centers[None], axis=2).max())
    if spread > FARTHEST:
        unit = "millimetres (metres_per_unit 0.001)" if spread > 1500 else "centimetres (metres_per_unit 0.01)"
        raise CalibrationError(f"{where}: cameras are {spread:.0f} m apart; the file seems to be in {unit}")
    if spread < NEAREST:
        raise CalibrationError(
            f"{where}: cameras are only {spread:.2g} m apart; the file's unit is not the metre, give metres_per_unit"
        )
    R, t = rig.cam_from_world[:, :, :3], rig.cam_from_world[:, :, 3]
    Rt = np.swapaxes(R, 1, 2)
    inverse = np.concatenate([Rt, -np.einsum("cij,cj->ci", Rt, t)[:, :, None]], axis=2)
    together = looking_together(rig.cam_from_world, rig)[0]
    # Upright cameras around a place look all the same way when their poses are inverted
    fraction, angle = looking_together(inverse, rig)
    parallel = _widest_angle(R) < 0.7 and _widest_angle(Rt) > 1.0 and fraction > 0.99 and angle < 0.35
    if together > 0.5 and not parallel:
        return
    others = {
        "its rotations are transposed": np.concatenate([Rt, t[:, :, None]], axis=2),
        "its poses are world-from-camera instead of camera-from-world": inverse,
        "its translations are camera centres": np.concatenate([R, -np.einsum("cij,cj->ci", R, t)[:, :, None]], axis=2),
        "its cameras look backwards (an OpenGL convention: y up, z back)": rig.cam_from_world
        * np.array([1.0, -1.0, -1.0])[None, :, None],
        "its translations have the wrong sign (a mirrored world)": np.concatenate([R, -t[:, :, None]], axis=2),
    }
    fits = {what: looking_together(poses, rig) for what, poses in others.items()}
    good = sorted((angle, what) for what, (fraction, angle) in fits.items() if fraction > 0.99)
    if good:
        what = good[0][1]
        raise CalibrationError(f"{where}: the cameras look at no common place as it stands, but would if {what}")


def looking_together(poses: np.ndarray, rig: Rig) -> tuple[float, float]:
    """Whether cameras (poses (C, 3, 4)) look at something together: the point nearest to all optical axes.

    Returns
    -------
    fraction : float
        Of the cameras that have it in their image.
    angle : float
        Mean angle between it and their optical axes, radians.
    """
    R, t = poses[:, :, :3], poses[:, :, 3]
    axes = R[:, 2]
    centers = -np.einsum("cji,cj->ci", R, t)
    P = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    A = P.sum(axis=0)
    if np.linalg.cond(A) > 1e6:
        return 1.0, 0.0  # parallel axes: nothing can be said
    point = np.linalg.solve(A, np.einsum("cij,cj->i", P, centers))
    spread = np.linalg.norm(centers[:, None] - centers[None], axis=2).max()
    inside, angles = 0, []
    for camera, Rc, tc in zip(rig.cameras, R, t, strict=True):
        x = Rc @ point + tc
        angles.append(np.arctan2(np.hypot(x[0], x[1]), x[2]))
        if x[2] > 0.2 * spread:
            center = np.array([camera.principal_point_x, camera.principal_point_y])
            u = center + x[:2] / x[2] * np.array([camera.focal_length_x, camera.focal_length_y])
            margin = 0.25 * np.array([camera.width, camera.height])
            inside += bool((u > -margin).all() and (u < margin * 5).all())
    return inside / len(poses), float(np.mean(angles))


def _widest_angle(R: np.ndarray) -> float:
    """Largest angle between two optical axes, radians."""
    axes = R[:, 2]
    return float(np.arccos(np.clip(axes @ axes.T, -1, 1)).max())


def in_metres(translation: np.ndarray, metres_per_unit: float, where: str) -> np.ndarray:
    """Scale translations to metres.

    Raises
    ------
    CalibrationError
        If the unit is no positive length.
    """
    if not (metres_per_unit > 0 and np.isfinite(metres_per_unit)):
        raise CalibrationError(f"{where}: metres_per_unit is {metres_per_unit}; it must be a positive length in metres")
    return np.asarray(translation, dtype=np.float64) * metres_per_unit
