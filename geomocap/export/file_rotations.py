"""Rotations as files want them: Euler angles and quaternions that run on continuously over time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


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
    angles = np.empty(R.shape[:-1])
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
        angles[t] = before
    return angles


def _nearest_turn(angles: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return angles + 2 * np.pi * np.round((reference - angles) / (2 * np.pi))


def rotation_about(axis: int, angles: np.ndarray) -> np.ndarray:
    """Rotation matrices, (..., 3, 3), about coordinate axis 0, 1 or 2 by `angles`, (...,) radians."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((*np.shape(angles), 3, 3))
    R[..., axis, axis] = 1
    R[..., i, i] = R[..., j, j] = np.cos(angles)
    R[..., j, i] = np.sin(angles)
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


def fill_positions(positions: np.ndarray) -> np.ndarray:
    """Fill frames without a position (NaN) linearly between their neighbours; ends are held.

    Parameters
    ----------
    positions : (T, 3) float
        If no frame has a position, the result is zero.
    """
    good = np.isfinite(positions).all(axis=1)
    if good.all():
        return np.asarray(positions, float)
    frames = np.flatnonzero(good)
    if len(frames) == 0:
        return np.zeros(positions.shape)
    every = np.arange(len(positions))
    return np.stack([np.interp(every, frames, positions[frames, i]) for i in range(3)], axis=1)
