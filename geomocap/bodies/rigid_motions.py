"""Rigid motions of groups of samples, steady against samples that do not follow."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.model.motion_paths import DEPTH_FRACTION
from geomocap.model.rotations import turn_angles
from geomocap.model.small_systems import cholesky, nearest_turn, solve
from geomocap.scheduling import spread

_ROUNDS = 5
_DAMPING = 1e-9
_LEAST_WEIGHT = 1e-9
_LEAST_SCALE = 1e-12  # metres; residuals of motions that are exact are 0
_STILL = 1e-12  # square metres: a group of one place doesn't turn
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
    count, frames = weights.shape
    positions, rest = np.ascontiguousarray(positions, np.float64), np.ascontiguousarray(rest, np.float64)
    ray = np.zeros((count, 0, 3)) if ray is None else np.ascontiguousarray(ray, np.float64)
    given = np.ascontiguousarray(np.maximum(weights, _LEAST_WEIGHT), np.float64)
    robust, squares, residuals = given.copy(), np.empty((count, frames)), np.empty(count)
    equations = np.empty((frames, 3)), np.empty((frames, 6, 6)), np.empty((frames, 6))
    rotations, translations = np.empty((frames, 3, 3)), np.empty((frames, 3))
    few = count + frames if weights.size < FEW_POSITIONS else 1
    for k in range(rounds if not ray.size else _START_ROUNDS + rounds):
        if not ray.size or k < _START_ROUNDS:
            spread(_motions, frames, positions, rest, robust, rotations, translations, few=few)
        else:
            spread(_step, frames, rotations, translations, positions, rest, robust, ray, *equations, few=few)
        spread(_misses, count, rotations, translations, positions, rest, given, ray, squares, residuals, few=few)
        ordered = np.sort(residuals)  # quicker than NumPy's median of few
        median = 0.5 * float(ordered[(count - 1) // 2] + ordered[count // 2])
        scale = 2.0 * max(median, least_scale, _LEAST_SCALE)
        spread(_weigh, count, given, squares, residuals, scale, robust, few=few)
    return rotations, translations, residuals


@njit(cache=True, nogil=True, error_model="numpy")
def _motions(begin, end, positions, rest, weights, rotations, translations):
    """Motions in frames `begin` to `end` as `rigid_motion` finds them, with `_STILL`; they are filled.

    Sums are of what is away from the first sample, which loses less to rounding.
    """
    frames = len(rotations)
    start, goal, moment = np.empty((frames, 3)), np.empty((frames, 3)), np.empty((frames, 3, 3))
    total, a = np.zeros(frames), np.empty(3)
    start[begin:end] = 0.0
    goal[begin:end] = 0.0
    moment[begin:end] = 0.0
    for n in range(len(rest)):
        x, y, z = rest[n, 0] - rest[0, 0], rest[n, 1] - rest[0, 1], rest[n, 2] - rest[0, 2]
        for t in range(begin, end):
            w = weights[n, t]
            total[t] += w
            start[t, 0] += w * x
            start[t, 1] += w * y
            start[t, 2] += w * z
            for i in range(3):
                a[i] = w * (positions[n, t, i] - positions[0, t, i])
                goal[t, i] += a[i]
                moment[t, i, 0] += a[i] * x
                moment[t, i, 1] += a[i] * y
                moment[t, i, 2] += a[i] * z
    for t in range(begin, end):
        for i in range(3):
            for j in range(3):
                moment[t, i, j] = (moment[t, i, j] - goal[t, i] * start[t, j] / total[t]) / total[t]
            moment[t, i, i] += _STILL
        nearest_turn(moment[t], rotations[t])
        for i in range(3):
            translations[t, i] = positions[0, t, i] + goal[t, i] / total[t]
            for j in range(3):
                translations[t, i] -= rotations[t, i, j] * (rest[0, j] + start[t, j] / total[t])


@njit(cache=True, nogil=True, error_model="numpy")
def _misses(begin, end, rotations, translations, positions, rest, weights, ray, squares, residuals):
    """Squares of the sure parts of what a motion misses, (n, T), and their roots of means over time, (n,), filled.

    `begin` and `end` are of samples; rays are (n, T, 3), or (n, 0, 3): none.
    """
    a = np.empty(3)
    for n in range(begin, end):
        total, mean = 0.0, 0.0
        for t in range(len(rotations)):
            for i in range(3):
                a[i] = translations[t, i] - positions[n, t, i]
                for j in range(3):
                    a[i] += rotations[t, i, j] * rest[n, j]
            if ray.shape[1]:
                along = a[0] * ray[n, t, 0] + a[1] * ray[n, t, 1] + a[2] * ray[n, t, 2]
                for i in range(3):
                    a[i] -= (1.0 - DEPTH_FRACTION) * along * ray[n, t, i]
            squares[n, t] = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
            total += weights[n, t]
            mean += weights[n, t] * squares[n, t]
        residuals[n] = math.sqrt(mean / total)


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(begin, end, given, squares, residuals, scale, robust):
    """Weights (n, T) that fall with the residuals (n,) of samples and with the squares (n, T) of their misses."""
    for n in range(begin, end):
        by_sample = 1.0 / (1.0 + (residuals[n] / scale) ** 4)
        for t in range(given.shape[1]):
            share = squares[n, t] / (4.0 * scale * scale)
            robust[n, t] = given[n, t] * by_sample / (1.0 + share * share)


@njit(cache=True, nogil=True, error_model="numpy")
def _step(begin, end, rotations, translations, positions, rest, weights, ray, middle, normal, right):
    """One Gauss-Newton step of the motions in frames `begin` to `end`, in which misses along the rays count little.

    Other parameters are those of `_step_equations`; motions are overwritten.
    """
    _step_equations(begin, end, rotations, translations, positions, rest, weights, ray, middle, normal, right)
    factor, step = np.empty((6, 6)), np.zeros(6)
    for t in range(begin, end):
        size = np.trace(normal[t])
        for i in range(6):
            normal[t, i, i] += _DAMPING * size
        if not cholesky(normal[t], factor):
            continue
        solve(factor, right[t], step)
        x, y, z = middle[t]
        turned = _turned(step, x, y, z)
        for i in range(3):
            translations[t, i] += step[3 + i] + middle[t, i] - turned[i]
        for j in range(3):
            turned = _turned(step, rotations[t, 0, j], rotations[t, 1, j], rotations[t, 2, j])
            for i in range(3):
                rotations[t, i, j] = turned[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _turned(turn, x, y, z):
    """Vector x, y, z turned by the rotation vector `turn[:3]`, radians."""
    u, v, w = turn[0], turn[1], turn[2]
    angle = math.sqrt(u * u + v * v + w * w)
    a, b = 1.0, 0.5
    if angle > 0.0:
        a, b = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    # what it moves by, and what that moves by
    p, q, r = v * z - w * y, w * x - u * z, u * y - v * x
    return x + a * p + b * (v * r - w * q), y + a * q + b * (w * p - u * r), z + a * r + b * (u * q - v * p)


@njit(cache=True, nogil=True, error_model="numpy")
def _step_equations(begin, end, rotations, translations, positions, rest, weights, ray, middle, normal, right):
    """Normal equations of the turns about the middle of the samples, and of the shifts.

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
    middle[begin:end] = 0.0
    normal[begin:end] = 0.0
    right[begin:end] = 0.0
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
