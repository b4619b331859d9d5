"""Rigid motions of groups of samples, steady against samples that do not follow."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from geomocap.model.motion_paths import DEPTH_FRACTION, sure_part
from geomocap.model.rotations import rigid_motion, turn_angles
from geomocap.scheduling import spread

_ROUNDS = 5
_DAMPING = 1e-9
_STILL = 1e-12 * np.eye(3)  # square metres: a group of one place doesn't turn
FEW_POSITIONS = 20_000  # that are not worth waking other threads for
_START_ROUNDS = 3  # with all directions alike, before rays are told apart


def fit_rigid_motion(
    positions: np.ndarray,
    rest: np.ndarray,
    weights: np.ndarray,
    least_scale: float,
    rounds: int = _ROUNDS,
    ray: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rigid motion of one group of samples, by weighted Kabsch with weights that fall with the residual.

    A sample counts 1 / (1 + (r / 2s)⁴) with r its residual (root mean square over time) and s the median of all: those
    of a soft border count little. Within a frame, positions count in the same way by their own residuals.

    Parameters
    ----------
    positions : (n, T, 3) float, metres
        Complete; of weight 0 where not seen.
    rest : (n, 3) float, metres
        In the reference.
    weights : (n, T) float
    least_scale : float, metres
        Residuals below this are all the same.
    rounds : int
        Times that the weights are found anew.
    ray : (n, T, 3) float, optional
        See `MotionPaths`.

    Returns
    -------
    rotations : (T, 3, 3) float
        world from reference.
    translations : (T, 3) float, metres
        position = rotation @ rest + translation.
    residuals : (n,) float, metres
        Root mean square over time.
    """
    given = np.maximum(weights, 1e-9)
    robust = given
    total = given.sum(axis=1)
    moving = np.ascontiguousarray(positions.swapaxes(0, 1))
    for k in range(rounds if ray is None else _START_ROUNDS + rounds):
        if ray is None or k < _START_ROUNDS:
            rotations, translations = rigid_motion(rest, moving, robust.T, prior=_STILL)
        else:
            rotations, translations = _step(rotations, translations, positions, rest, robust, ray)
        carried = (rest @ rotations.transpose(0, 2, 1) + translations[:, None]).swapaxes(0, 1)
        miss = np.linalg.norm(sure_part(carried - positions, ray), axis=2)
        residuals = np.sqrt((given * miss**2).sum(axis=1) / total)
        scale = 2.0 * max(float(np.median(residuals)), least_scale)
        by_sample = 1.0 / (1.0 + (residuals / scale) ** 4)
        by_position = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 4)
        robust = given * by_sample[:, None] * by_position
    return rotations, translations, residuals


def _step(
    rotations: np.ndarray,
    translations: np.ndarray,
    positions: np.ndarray,
    rest: np.ndarray,
    weights: np.ndarray,
    ray: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of the motion, in which misses along the rays count little."""
    frames = len(rotations)
    middle, normal, right = np.zeros((frames, 3)), np.zeros((frames, 6, 6)), np.zeros((frames, 6))
    arrays = (np.ascontiguousarray(a, np.float64) for a in (rotations, translations, positions, rest, weights, ray))
    spread(_step_equations, frames, *arrays, middle, normal, right, few=frames if weights.size < FEW_POSITIONS else 1)
    size = np.einsum("tii->t", normal)[:, None, None]
    step = np.linalg.solve(normal + _DAMPING * size * np.eye(6), right[..., None])[..., 0]
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return turn @ rotations, translations + step[:, 3:] + middle - (turn @ middle[..., None])[..., 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _step_equations(begin, end, rotations, translations, positions, rest, weights, ray, middle, normal, right):
    """Normal equations of the turns about the middle of the samples, and of the shifts; zeros are given.

    Parameters
    ----------
    begin, end : int
        Frames to work on.
    rotations, translations : (T, 3, 3), (T, 3) float
    positions, rest, weights, ray : (n, T, 3), (n, 3), (n, T), (n, T, 3) float
    middle : (T, 3) float
        Filled: weighted mean of the turned places at rest.
    normal, right : (T, 6, 6), (T, 6) float
        Filled; turn before shift.
    """
    part = 1.0 - DEPTH_FRACTION**2
    total = np.zeros(len(rotations))
    a, turned, along = np.empty(3), np.empty(3), np.empty(6)
    for n in range(len(rest)):
        for t in range(begin, end):
            total[t] += weights[n, t]
            for i in range(3):
                for j in range(3):
                    middle[t, i] += weights[n, t] * rotations[t, i, j] * rest[n, j]
    for t in range(begin, end):
        for i in range(3):
            middle[t, i] /= total[t]
    for n in range(len(rest)):
        for t in range(begin, end):
            w, inner = weights[n, t], 0.0
            for i in range(3):
                turned[i] = 0.0
                for j in range(3):
                    turned[i] += rotations[t, i, j] * rest[n, j]
                along[3 + i] = ray[n, t, i]
            x, y, z = turned[0] - middle[t, 0], turned[1] - middle[t, 1], turned[2] - middle[t, 2]
            for i in range(3):
                a[i] = positions[n, t, i] - turned[i] - translations[t, i]
                inner += a[i] * along[3 + i]
            along[0] = y * along[5] - z * along[4]
            along[1] = z * along[3] - x * along[5]
            along[2] = x * along[4] - y * along[3]
            # without rays: the shift moves all alike, a turn by ω moves by ω × (x, y, z)
            normal[t, 0, 0] += w * (y * y + z * z)
            normal[t, 1, 1] += w * (x * x + z * z)
            normal[t, 2, 2] += w * (x * x + y * y)
            normal[t, 1, 0] -= w * x * y
            normal[t, 2, 0] -= w * x * z
            normal[t, 2, 1] -= w * y * z
            normal[t, 4, 0] -= w * z
            normal[t, 5, 0] += w * y
            normal[t, 3, 1] += w * z
            normal[t, 5, 1] -= w * x
            normal[t, 3, 2] -= w * y
            normal[t, 4, 2] += w * x
            right[t, 0] += w * (y * a[2] - z * a[1])
            right[t, 1] += w * (z * a[0] - x * a[2])
            right[t, 2] += w * (x * a[1] - y * a[0])
            for i in range(3):
                normal[t, 3 + i, 3 + i] += w
                right[t, 3 + i] += w * a[i]
            for i in range(6):
                right[t, i] -= part * w * along[i] * inner
                for j in range(i + 1):
                    normal[t, i, j] -= part * w * along[i] * along[j]
    for t in range(begin, end):
        for i in range(6):
            for j in range(i):
                normal[t, j, i] = normal[t, i, j]


def relative_turn(first: np.ndarray, second: np.ndarray, fraction: float = 0.05) -> float:
    """Angle by which two motions (T, 3, 3) differ, exceeded in a small fraction of the frames only, radians."""
    angles = np.sort(turn_angles(first.swapaxes(1, 2) @ second))
    return float(angles[len(angles) - 1 - int(fraction * (len(angles) - 1))])
