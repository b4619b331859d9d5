"""Central projection with the camera model of the self-calibrating adjustment, and its exact derivatives.

The interior parameters are those of COLMAP's `FULL_OPENCV`, in its order, and a shear:
fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, shear. With u, v the ideal and u', v' the distorted image coordinates
of a camera of focal length one,

    x = fx u' + shear v' + cx,    y = fy v' + cy.

The paper's differential scale is fx ≠ fy; its shear is the one here, in pixels (D'Apuzzo, section 2).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap

INTERIOR_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "shear")
N_INTERIOR = 13
N_PARAMETERS = 19
"""Interior parameters, then rotation (3) and translation (3) of the view."""


@njit(cache=True, nogil=True, error_model="numpy")
def project_point(q, R, t, X, xy, J):
    """Project one point and differentiate.

    Parameters
    ----------
    q : (13,) float
        Interior parameters.
    R : (3, 3) float
    t : (3,) float
        Exterior orientation: x_cam = R X + t.
    X : (3,) float
        Point, metres, world.
    xy : (2,) float
        Set to the COLMAP pixel.
    J : (2, 22) float
        Set to the derivatives by interior (13), rotation vector applied on the left (3), translation (3), point (3).

    Returns
    -------
    in_front : bool
        Whether the point is in front of the camera; nothing is set otherwise.
    """
    Yx = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2]
    Yy = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2]
    Yz = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2]
    z = Yz + t[2]
    if z < 1e-6:
        return False
    iz = 1.0 / z
    u = (Yx + t[0]) * iz
    v = (Yy + t[1]) * iz
    fx, fy, p1, p2, shear = q[0], q[1], q[6], q[7], q[12]
    uu, uv, vv = u * u, u * v, v * v
    r2 = uu + vv
    r4 = r2 * r2
    inverse = 1.0 / (1.0 + r2 * (q[9] + r2 * (q[10] + r2 * q[11])))
    radial = (1.0 + r2 * (q[4] + r2 * (q[5] + r2 * q[8]))) * inverse
    slope = (
        q[4] + r2 * (2 * q[5] + 3 * r2 * q[8]) - radial * (q[9] + r2 * (2 * q[10] + 3 * r2 * q[11]))
    ) * inverse  # of `radial` by r2
    ud = u * radial + 2 * p1 * uv + p2 * (r2 + 2 * uu)
    vd = v * radial + 2 * p2 * uv + p1 * (r2 + 2 * vv)
    xy[0] = fx * ud + shear * vd + q[2]
    xy[1] = fy * vd + q[3]

    # Interior orientation
    J[0, :13] = 0.0
    J[1, :13] = 0.0
    J[0, 0] = ud
    J[1, 1] = vd
    J[0, 2] = 1.0
    J[1, 3] = 1.0
    J[0, 12] = vd
    for k, power in ((4, r2), (5, r4), (8, r4 * r2)):
        a = power * inverse
        J[0, k] = (fx * u + shear * v) * a
        J[1, k] = fy * v * a
    for k, power in ((9, r2), (10, r4), (11, r4 * r2)):
        a = -radial * power * inverse
        J[0, k] = (fx * u + shear * v) * a
        J[1, k] = fy * v * a
    J[0, 6] = fx * 2 * uv + shear * (r2 + 2 * vv)
    J[1, 6] = fy * (r2 + 2 * vv)
    J[0, 7] = fx * (r2 + 2 * uu) + shear * 2 * uv
    J[1, 7] = fy * 2 * uv

    # Point in the camera's system, then rotation, translation, point in the world
    cross = 2 * uv * slope + 2 * p1 * u + 2 * p2 * v
    uu_ = radial + 2 * uu * slope + 2 * p1 * v + 6 * p2 * u
    vv_ = radial + 2 * vv * slope + 2 * p2 * u + 6 * p1 * v
    for row in range(2):
        if row == 0:
            a = fx * uu_ + shear * cross
            b = fx * cross + shear * vv_
        else:
            a = fy * cross
            b = fy * vv_
        B0 = a * iz
        B1 = b * iz
        B2 = -(a * u + b * v) * iz
        J[row, 13] = B2 * Yy - B1 * Yz
        J[row, 14] = B0 * Yz - B2 * Yx
        J[row, 15] = B1 * Yx - B0 * Yy
        J[row, 16] = B0
        J[row, 17] = B1
        J[row, 18] = B2
        J[row, 19] = B0 * R[0, 0] + B1 * R[1, 0] + B2 * R[2, 0]
        J[row, 20] = B0 * R[0, 1] + B1 * R[1, 1] + B2 * R[2, 1]
        J[row, 21] = B0 * R[0, 2] + B1 * R[1, 2] + B2 * R[2, 2]
    return True


def interior_of(camera: pycolmap.Camera) -> np.ndarray:
    """Return the 13 interior parameters of a COLMAP camera.

    Raises
    ------
    CalibrationError
        If its model is not one that these parameters can express (a fisheye, say).
    """
    q = np.zeros(N_INTERIOR)
    p = np.asarray(camera.params, dtype=np.float64)
    q[:4] = camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y
    model = camera.model.name
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return q
    if model == "SIMPLE_RADIAL":
        q[4] = p[3]
    elif model == "RADIAL":
        q[4:6] = p[3:5]
    elif model == "OPENCV":
        q[4:8] = p[4:8]
    elif model == "FULL_OPENCV":
        q[4:12] = p[4:12]
    else:
        raise CalibrationError(
            f"camera model {model} can't be expressed by radial and tangential polynomials; use OPENCV or FULL_OPENCV"
        )
    return q


def camera_of(interior: np.ndarray, size: tuple[int, int]) -> pycolmap.Camera:
    """Return the COLMAP camera of interior parameters (the shear, which COLMAP has not, is left out).

    The model is `OPENCV`, or `FULL_OPENCV` if k3 … k6 are not all zero.
    """
    full = bool(np.any(interior[8:12] != 0.0))
    return pycolmap.Camera(
        model="FULL_OPENCV" if full else "OPENCV",
        width=int(size[0]),
        height=int(size[1]),
        params=[float(p) for p in interior[: 12 if full else 8]],
    )
