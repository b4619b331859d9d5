"""OpenCV's description of a camera and ours: they differ by half a pixel.

In OpenCV the centre of the top-left pixel is (0, 0), in COLMAP, and so here, it is (0.5, 0.5). Principal points are
shifted by half a pixel on the way in and back on the way out; nothing else changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap
from geomocap.model.orientations import LONGEST_SIDE

HALF_PIXEL = 0.5


def camera_from_opencv(
    matrix: np.ndarray, distortions: Sequence[float], width: int, height: int, *, fisheye: bool = False, where: str
) -> pycolmap.Camera:
    """Make a camera from OpenCV's matrix and distortion coefficients.

    Parameters
    ----------
    matrix : (3, 3) float
        Pixels, top-left pixel centre at (0, 0).
    distortions : 0, 4, 5 or 8 floats
        k1 k2 p1 p2 [k3 [k4 k5 k6]]; with `fisheye` k1 k2 k3 k4 of OpenCV's fisheye model.
    where : str
        File and camera, for the error message.

    Raises
    ------
    CalibrationError
        If the matrix has skew, is transposed or has no focal length, or the number of coefficients is not one of
        these.
    """
    if not (0 < width <= LONGEST_SIDE and 0 < height <= LONGEST_SIDE):
        raise CalibrationError(f"{where}: an image of {width}×{height} pixels can't be; correct its size")
    K = np.asarray(matrix, dtype=float)
    if K.shape != (3, 3) or not np.isfinite(K).all():
        raise CalibrationError(f"{where}: the camera matrix must be 3×3 finite numbers, got shape {K.shape}")
    if abs(K[2, 0]) + abs(K[2, 1]) > 1e-9 and abs(K[0, 2]) + abs(K[1, 2]) < 1e-9:
        raise CalibrationError(f"{where}: the camera matrix is transposed (principal point in the last row)")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[2, 2] - 1) > 1e-9:
        raise CalibrationError(f"{where}: focal lengths {K[0, 0]:g}, {K[1, 1]:g} must be positive pixels")
    if abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise CalibrationError(f"{where}: a skew of {K[0, 1]:g} can't be represented; calibrate without skew")
    d = [float(v) for v in np.ravel(distortions)]
    pinhole = [K[0, 0], K[1, 1], K[0, 2] + HALF_PIXEL, K[1, 2] + HALF_PIXEL]
    if len(d) > 8 and not any(d[8:]):
        d = d[:8]
    if len(d) not in (0, 4, 5, 8) or (fisheye and len(d) != 4):
        raise CalibrationError(f"{where}: {len(d)} distortion coefficients; expected {'4' if fisheye else '4, 5 or 8'}")
    if fisheye:
        model, extra = "OPENCV_FISHEYE", d
    elif not any(d):
        model, extra = "PINHOLE", []
    elif not any(d[4:]):
        model, extra = "OPENCV", d[:4]
    else:
        model, extra = "FULL_OPENCV", d + [0.0] * (8 - len(d))
    return pycolmap.Camera(model=model, width=int(width), height=int(height), params=pinhole + extra)


def camera_to_opencv(camera: pycolmap.Camera) -> tuple[np.ndarray, list[float], bool]:
    """Describe a camera as OpenCV does.

    Returns
    -------
    matrix : (3, 3) float
        Pixels, top-left pixel centre at (0, 0).
    distortions : list of 4 or 8 floats
    fisheye : bool

    Raises
    ------
    CalibrationError
        If OpenCV has no such lens model.
    """
    K = camera.calibration_matrix()
    K[:2, 2] -= HALF_PIXEL
    name, p = camera.model.name, [float(v) for v in camera.params]
    if name in ("SIMPLE_PINHOLE", "PINHOLE"):
        return K, [0.0] * 4, False
    if name == "SIMPLE_RADIAL":
        return K, [p[3], 0.0, 0.0, 0.0], False
    if name == "RADIAL":
        return K, [p[3], p[4], 0.0, 0.0], False
    if name in ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"):
        return K, p[4:], name == "OPENCV_FISHEYE"
    raise CalibrationError(f"a camera of COLMAP's model {name} can't be written for OpenCV; convert it to OPENCV")
