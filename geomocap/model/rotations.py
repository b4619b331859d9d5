"""Rotations and rigid motions: the nearest ones, angles, and Euler angles, quaternions, vectors that run on over time.

Rotations are matrices (…, 3, 3) everywhere.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from geomocap.model.small_systems import nearest_turns


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the proper rotations R that maximise trace(Rᵀ M) for matrices (…, 3, 3) (Kabsch 1976, Umeyama 1991)."""
    rotations = np.empty(matrix.shape)
    given = np.ascontiguousarray(matrix, np.float64).reshape(-1, 3, 3)
    nearest_turns(given, rotations.reshape(-1, 3, 3))
    return rotations


def rigid_motion(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None, prior: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations that take points to others in the weighted least squares sense.

    The rotations are proper even if the points are mirrored: a mirrored world stays an error.

    Parameters
    ----------
    source, target : (…, N, 3) float
        They may be broadcast against each other.
    weights : (…, N) float, optional
        All the same if not given.
    prior : (…, 3, 3) float, optional
        Rotations times squared lengths, added to the points' second moments (of mean weight 1): they decide what the
        points leave open.

    Returns
    -------
    rotations : (…, 3, 3) float
    translations : (…, 3) float
        target = rotation @ source + translation.
    """
    if weights is None:
        weights = np.ones(target.shape[:-1])
    fraction = weights / weights.sum(axis=-1, keepdims=True)
    start, end = ((fraction[..., None, :] @ x)[..., 0, :] for x in (source, target))
    moment = np.swapaxes((target - end[..., None, :]) * fraction[..., None], -1, -2) @ source
    rotations = nearest_rotation(moment + prior)
    return rotations, end - (rotations @ start[..., None])[..., 0]


def turn_angles(rotations: np.ndarray) -> np.ndarray:
    """Angles of rotations (…, 3, 3), radians."""
    cosine = (np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2
    return np.arccos(np.clip(cosine, -1, 1))


def relative_turns(parents: np.ndarray, children: np.ndarray) -> np.ndarray:
    """Rotations (…, 3, 3) parent from child, of rotations of both in the same axes."""
    return np.einsum("...ji,...jk->...ik", parents, children)


def rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Rotation vectors (T, N, 3), radians, that run on smoothly over time, of rotations (T, N, 3, 3) with any NaN.

    Of the vectors that mean the same rotation, that nearest to the frame before is taken: no jumps at half a turn.
    """
    flat = rotations.reshape(-1, 3, 3)
    whole = np.isfinite(flat).all(axis=(1, 2))
    vectors = np.full((len(flat), 3), np.nan)
    if whole.any():
        vectors[whole] = Rotation.from_matrix(flat[whole]).as_rotvec()
    vectors = vectors.reshape(*rotations.shape[:2], 3)
    for t in range(1, len(vectors)):
        size = np.linalg.norm(vectors[t], axis=1, keepdims=True)
        axis = vectors[t] / np.maximum(size, 1e-12)
        turned = np.stack([vectors[t] + 2 * np.pi * k * axis for k in (0, -1, 1)])
        distance = np.nan_to_num(np.linalg.norm(turned - vectors[t - 1], axis=2), nan=0.0)
        vectors[t] = np.take_along_axis(turned, distance.argmin(axis=0)[None, :, None], axis=0)[0]
    return vectors


def zxy_angles(rotations: np.ndarray) -> np.ndarray:
    """Euler angles of R = Rz(a) Rx(b) Ry(c), chosen so that they run on smoothly over time.

    Of the two solutions and their full turns the one nearest to the frame before is taken; where the axes of the first
    and last turn coincide (b = ±90°), the first angle is held.

    Parameters
    ----------
    rotations : (T, ..., 3, 3) float

    Returns
    -------
    (T, ..., 3) float
        a, b, c in radians.
    """
    R = np.asarray(rotations, float)
    result = np.empty(R.shape[:-1])
    before = np.zeros(R.shape[1:-1])
    for t in range(len(R)):
        r = R[t]
        cos_b = np.hypot(r[..., 0, 1], r[..., 1, 1])
        b = np.arctan2(r[..., 2, 1], cos_b)
        a = np.arctan2(-r[..., 0, 1], r[..., 1, 1])
        c = np.arctan2(-r[..., 2, 0], r[..., 2, 2])
        # Gimbal lock: only a + c (or a - c) is determined.
        locked = cos_b < 1e-9
        sign = np.sign(r[..., 2, 1])
        together = np.arctan2(r[..., 1, 0], r[..., 0, 0])
        a = np.where(locked, before[..., 0], a)
        c = np.where(locked, sign * (together - a), c)
        first = _nearest_turn(np.stack([a, b, c], -1), before)
        second = _nearest_turn(np.stack([a + np.pi, np.pi - b, c + np.pi], -1), before)
        nearer = np.abs(second - before).sum(-1) < np.abs(first - before).sum(-1) - 1e-9
        before = np.where(nearer[..., None], second, first)
        result[t] = before
    return result


def _nearest_turn(euler: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return euler + 2 * np.pi * np.round((reference - euler) / (2 * np.pi))


def rotation_about(axis: int, turn: np.ndarray) -> np.ndarray:
    """Rotation matrices, (..., 3, 3), about coordinate axis 0, 1 or 2 by `turn`, (...,) radians."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((*np.shape(turn), 3, 3))
    R[..., axis, axis] = 1
    R[..., i, i] = R[..., j, j] = np.cos(turn)
    R[..., j, i] = np.sin(turn)
    R[..., i, j] = -R[..., j, i]
    return R


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions x, y, z, w, (T, ..., 4), without sign flips over time, of rotations (T, ..., 3, 3)."""
    R = np.asarray(rotations, float)
    q = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(*R.shape[:-2], 4)
    if len(q) > 1:
        dot = np.sum(q[1:] * q[:-1], axis=-1)
        flips = np.cumprod(np.where(dot < 0, -1.0, 1.0), axis=0)
        q[1:] *= flips[..., None]
    return q


def fill_rotations(rotations: np.ndarray) -> np.ndarray:
    """Fill frames without a rotation (NaN) by turning evenly between their neighbours; ends are held.

    Parameters
    ----------
    rotations : (T, 3, 3) float
        One body's; if no frame has a rotation, the result is the identity.
    """
    good = np.isfinite(rotations).all(axis=(1, 2))
    if good.all():
        return np.asarray(rotations, float)
    frames = np.flatnonzero(good)
    if len(frames) == 0:
        return np.tile(np.eye(3), (len(rotations), 1, 1))
    if len(frames) == 1:
        return np.tile(rotations[frames[0]].astype(float), (len(rotations), 1, 1))
    turn = Slerp(frames, Rotation.from_matrix(rotations[frames]))
    filled = turn(np.clip(np.arange(len(rotations)), frames[0], frames[-1])).as_matrix()
    filled[frames] = rotations[frames]
    return filled
