"""What interior and exterior orientations of cameras can be: the one check of what calibrations say."""

from __future__ import annotations

import numpy as np

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap

EXACT = 1e-9  # a rotation that is orthonormal to this is taken as it is
NOTED = 1e-5  # beyond, it is said that the nearest one was taken
WRITTEN = 1e-3  # beyond, it is no rotation; published ones have six digits, a few have three
LONGEST_SIDE = 65535  # pixels of an image; no format of pictures holds more
SHORTEST, LONGEST = 0.02, 1e4  # focal lengths as fractions of an image's longer side: 175° and 0.006° across
_GRID = 17  # points along each side of the image at which that is tried
UNDONE = 0.5  # fraction of the image in which a lens' distortion must be removable


def nearest_rotation(values: np.ndarray, where: str) -> tuple[np.ndarray, float]:
    """Find the rotation nearest to a matrix (3, 3), and how far off the matrix is (largest difference).

    Raises
    ------
    CalibrationError
        If it is far from any rotation, or mirrors the world.
    """
    R = np.asarray(values, dtype=np.float64)
    if R.shape != (3, 3) or not np.isfinite(R).all():
        raise CalibrationError(f"{where}: the rotation must be 3×3 finite numbers, got shape {R.shape}")
    if np.abs(R).max() > 2:
        raise CalibrationError(f"{where}: its rotation is not orthonormal (it holds {np.abs(R).max():.3g})")
    U, _, Vt = np.linalg.svd(R)
    nearest = U @ Vt
    off = float(np.abs(nearest - R).max())
    if off > WRITTEN:
        raise CalibrationError(
            f"{where}: its rotation is not orthonormal (off by {off:.2g}); are rows and translation mixed up?"
        )
    if np.linalg.det(nearest) < 0:
        raise CalibrationError(
            f"{where}: its rotation mirrors the world (determinant −1); "
            "an axis was flipped when it was written, flip it back"
        )
    return nearest, off


def check_camera(camera: pycolmap.Camera, where: str) -> None:
    """Refuse an interior orientation that no camera has.

    Raises
    ------
    CalibrationError
        Naming what can't be: size, focal lengths, principal point, or a distortion that can't be removed.
    """
    width, height = camera.width, camera.height
    if not (0 < width <= LONGEST_SIDE and 0 < height <= LONGEST_SIDE):
        raise CalibrationError(f"{where}: an image of {width}×{height} pixels can't be")
    if not np.isfinite(camera.params).all():
        raise CalibrationError(f"{where}: its interior orientation holds numbers that are not finite")
    if camera.is_spherical():
        raise CalibrationError(f"{where}: spherical images can't be used; cut them into perspective ones")
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    side = max(width, height)
    if focal.min() <= 0:
        raise CalibrationError(f"{where}: focal lengths {focal[0]:g}, {focal[1]:g} must be positive pixels")
    if not (SHORTEST * side <= focal.min() and focal.max() <= LONGEST * side):
        raise CalibrationError(
            f"{where}: focal lengths {focal[0]:g}, {focal[1]:g} pixels can't be for an image of {width}×{height}"
        )
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    if (np.abs(center / [width, height] - 0.5) > 1.5).any():
        raise CalibrationError(
            f"{where}: principal point ({center[0]:.5g}, {center[1]:.5g}) is far outside an image of {width}×{height}"
        )
    if not camera.is_undistorted() and _undone(camera) < UNDONE:
        raise CalibrationError(
            f"{where}: its distortion can't be removed; are the coefficients right, and their order?"
        )


def _undone(camera: pycolmap.Camera) -> float:
    """Fraction of the image in which the distortion is removed, put back to the same pixel, and neighbours stay so."""
    u, v = np.meshgrid(np.linspace(0, camera.width, _GRID), np.linspace(0, camera.height, _GRID))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    with np.errstate(all="ignore"):
        seen = np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(len(pixels), -1)[:, :2]
        good = np.isfinite(seen).all(axis=1) & (np.abs(seen) < 1e6).all(axis=1)
        seen[~good] = np.nan
        again = np.asarray(camera.img_from_cam(np.column_stack([seen, np.ones(len(seen))])), dtype=np.float64)
        good &= np.abs(again - pixels).max(axis=1) < 1
        seen[~good] = np.nan
        grid = seen.reshape(_GRID, _GRID, 2)
        across, down = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
        upright = (across[..., 0] > 0) & (down[..., 1] > 0)
        return float((upright & (across[..., 0] * down[..., 1] > across[..., 1] * down[..., 0])).mean())
