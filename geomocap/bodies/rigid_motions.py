"""Rigid motions of groups of samples, steady against samples that do not follow."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.model.motion_paths import DEPTH_FRACTION
from geomocap.model.order_statistics import median
from geomocap.model.rotations import turn_angles
from geomocap.model.small_systems import cholesky, nearest_turn, solve

_ROUNDS = 5
_DAMPING = 1e-9
_LEAST_WEIGHT = 1e-9
_LEAST_SCALE = 1e-12  # metres; residuals of motions that are exact are 0
_STILL = 1e-12  # square metres: a group of one place doesn't turn
_BLOCK = 16  # frames
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
    positions, rest = np.ascontiguousarray(positions, np.float64), np.ascontiguousarray(rest, np.float64)
    if ray is not None:  # what rays take isn't compiled without any
        ray = np.ascontiguousarray(ray, np.float64)
    given = np.ascontiguousarray(np.maximum(weights, _LEAST_WEIGHT), np.float64)
    return _fit(positions, rest, given, ray, rounds, least_scale)


# Frames are worked on in blocks of 16, frames last: sums over the samples run over several frames at once, and each
# adds up in the order of the samples as it would alone. What is beyond the last frame counts nothing.
@njit(cache=True, nogil=True, error_model="numpy")
def _fit(positions, rest, given, ray, rounds, least_scale):
    """Rotations, translations and residuals, see `fit_rigid_motion`; rays are (n, T, 3) or None."""
    count, frames = given.shape
    starts, steps = rounds, 0
    if ray is not None:
        starts, steps = _START_ROUNDS, rounds
    known, weights, motion = _in_blocks(positions, given, ray)
    robust, squares, residuals = weights.copy(), np.zeros_like(weights), np.zeros(count)
    scale = 0.0
    for k in range(starts + steps):
        for b in range(len(known)):
            if k > 0:
                _weigh(weights[b], squares[b], residuals, scale, robust[b])
            some = min(_BLOCK, frames - _BLOCK * b)
            if k < starts:
                _motions(known[b], rest, robust[b], some, motion[b])
            elif ray is not None:
                _step(known[b], rest, robust[b], some, motion[b])
            _misses(known[b], rest, motion[b], ray, squares[b])
        for n in range(count):
            total, mean = 0.0, 0.0
            for t in range(frames):
                total += given[n, t]
                mean += given[n, t] * squares[t // _BLOCK, n, t % _BLOCK]
            residuals[n] = math.sqrt(mean / total)
        scale = 2.0 * max(median(residuals), least_scale, _LEAST_SCALE)
    rotations, translations = np.empty((frames, 3, 3)), np.empty((frames, 3))
    for t in range(frames):
        for i in range(3):
            translations[t, i] = motion[t // _BLOCK, 9 + i, t % _BLOCK]
            for j in range(3):
                rotations[t, i, j] = motion[t // _BLOCK, 3 * i + j, t % _BLOCK]
    return rotations, translations, residuals


@njit(cache=True, nogil=True, error_model="numpy")
def _in_blocks(positions, given, ray):
    """Positions and rays, (K, n, 6, 16), and weights, (K, n, 16), of K blocks of frames; room for motions, (K, 12, 16).

    Motions are nine elements of rotations, by rows, and three of translations.
    """
    count, frames = given.shape
    blocks = (frames + _BLOCK - 1) // _BLOCK
    known, weights = np.zeros((blocks, count, 6, _BLOCK)), np.zeros((blocks, count, _BLOCK))
    for n in range(count):
        for t in range(frames):
            b, k = t // _BLOCK, t % _BLOCK
            weights[b, n, k] = given[n, t]
            for i in range(3):
                known[b, n, i, k] = positions[n, t, i]
                if ray is not None:
                    known[b, n, 3 + i, k] = ray[n, t, i]
    return known, weights, np.zeros((blocks, 12, _BLOCK))


@njit(cache=True, nogil=True, error_model="numpy")
def _motions(known, rest, weights, some, motion):
    """Motions in the first `some` frames of a block as `rigid_motion` finds them, with `_STILL`; they are filled.

    Sums are of what is away from the first sample, which loses less to rounding.
    """
    S, first = np.zeros((16, _BLOCK)), known[0, :3].copy()
    for n in range(len(rest)):
        x, y, z = rest[n, 0] - rest[0, 0], rest[n, 1] - rest[0, 1], rest[n, 2] - rest[0, 2]
        for t in range(_BLOCK):
            w = weights[n, t]
            a = w * (known[n, 0, t] - first[0, t])
            b = w * (known[n, 1, t] - first[1, t])
            c = w * (known[n, 2, t] - first[2, t])
            S[0, t] += a * x
            S[1, t] += a * y
            S[2, t] += a * z
            S[3, t] += b * x
            S[4, t] += b * y
            S[5, t] += b * z
            S[6, t] += c * x
            S[7, t] += c * y
            S[8, t] += c * z
            S[9, t] += a
            S[10, t] += b
            S[11, t] += c
            S[12, t] += w * x
            S[13, t] += w * y
            S[14, t] += w * z
            S[15, t] += w
    moment, turn = np.empty((3, 3)), np.empty((3, 3))
    for t in range(some):
        total = S[15, t]
        for i in range(3):
            for j in range(3):
                moment[i, j] = (S[3 * i + j, t] - S[9 + i, t] * S[12 + j, t] / total) / total
            moment[i, i] += _STILL
        nearest_turn(moment, turn)
        for i in range(3):
            shift = known[0, i, t] + S[9 + i, t] / total
            for j in range(3):
                motion[3 * i + j, t] = turn[i, j]
                shift -= turn[i, j] * (rest[0, j] + S[12 + j, t] / total)
            motion[9 + i, t] = shift


@njit(cache=True, nogil=True, error_model="numpy")
def _misses(known, rest, motion, ray, squares):
    """Squares of the sure parts of what a motion misses in the frames of a block, (n, 16), filled."""
    part = 1.0 - DEPTH_FRACTION
    for n in range(len(rest)):
        x, y, z = rest[n, 0], rest[n, 1], rest[n, 2]
        for t in range(_BLOCK):
            a = motion[9, t] - known[n, 0, t] + motion[0, t] * x + motion[1, t] * y + motion[2, t] * z
            b = motion[10, t] - known[n, 1, t] + motion[3, t] * x + motion[4, t] * y + motion[5, t] * z
            c = motion[11, t] - known[n, 2, t] + motion[6, t] * x + motion[7, t] * y + motion[8, t] * z
            if ray is not None:
                along = a * known[n, 3, t] + b * known[n, 4, t] + c * known[n, 5, t]
                a -= part * along * known[n, 3, t]
                b -= part * along * known[n, 4, t]
                c -= part * along * known[n, 5, t]
            squares[n, t] = a * a + b * b + c * c


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(given, squares, residuals, scale, robust):
    """Weights (n, 16) that fall with the residuals (n,) of samples and with the squares (n, 16) of their misses."""
    least = 4.0 * scale * scale
    for n in range(len(residuals)):
        by_sample = 1.0 / (1.0 + (residuals[n] / scale) ** 4)
        for t in range(_BLOCK):
            share = squares[n, t] / least
            robust[n, t] = given[n, t] * by_sample / (1.0 + share * share)


@njit(cache=True, nogil=True, error_model="numpy")
def _step(known, rest, weights, some, motion):
    """One Gauss-Newton step of the motions in the first frames of a block, in which misses along the rays count little.

    Parameters are those of `_motions`; motions are overwritten.
    """
    S = _step_equations(known, rest, weights, motion)
    normal, right, factor, step = np.empty((6, 6)), np.empty(6), np.empty((6, 6)), np.zeros(6)
    for t in range(some):
        size = 0.0
        for i in range(6):
            right[i] = S[i, t]
            for j in range(i + 1):
                normal[i, j] = S[6 + i * (i + 1) // 2 + j, t]
            size += normal[i, i]
        for i in range(6):
            normal[i, i] += _DAMPING * size
        if not cholesky(normal, factor):
            continue
        solve(factor, right, step)
        turned = _turned(step, S[27, t], S[28, t], S[29, t])
        for i in range(3):
            motion[9 + i, t] += step[3 + i] + S[27 + i, t] - turned[i]
        for j in range(3):
            turned = _turned(step, motion[j, t], motion[3 + j, t], motion[6 + j, t])
            for i in range(3):
                motion[3 * i + j, t] = turned[i]


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
def _step_equations(known, rest, weights, motion):
    """Normal equations of the turns about the middle of the samples, and of the shifts, in the frames of a block.

    Parameters
    ----------
    known, rest, weights, motion : (n, 6, 16), (n, 3), (n, 16), (12, 16) float
        See `_in_blocks`.

    Returns
    -------
    (31, 16) float
        Right sides, turn before shift (6); the lower triangle of the normal matrices by rows (21); the weighted
        mean of the turned places at rest (3); sums of the weights.
    """
    part = 1.0 - DEPTH_FRACTION**2
    S, M = np.zeros((31, _BLOCK)), np.empty((12, _BLOCK))
    for i in range(12):
        for t in range(_BLOCK):
            M[i, t] = motion[i, t]
    for n in range(len(rest)):
        x, y, z = rest[n, 0], rest[n, 1], rest[n, 2]
        for t in range(_BLOCK):
            w = weights[n, t]
            S[27, t] = S[27, t] + w * M[0, t] * x + w * M[1, t] * y + w * M[2, t] * z
            S[28, t] = S[28, t] + w * M[3, t] * x + w * M[4, t] * y + w * M[5, t] * z
            S[29, t] = S[29, t] + w * M[6, t] * x + w * M[7, t] * y + w * M[8, t] * z
            S[30, t] += w
    for i in range(3):
        for t in range(_BLOCK):
            S[27 + i, t] /= S[30, t]
    for n in range(len(rest)):
        u, v, q = rest[n, 0], rest[n, 1], rest[n, 2]
        for t in range(_BLOCK):
            w = weights[n, t]
            X = M[0, t] * u + M[1, t] * v + M[2, t] * q
            Y = M[3, t] * u + M[4, t] * v + M[5, t] * q
            Z = M[6, t] * u + M[7, t] * v + M[8, t] * q
            x, y, z = X - S[27, t], Y - S[28, t], Z - S[29, t]
            a, b = known[n, 0, t] - X - M[9, t], known[n, 1, t] - Y - M[10, t]
            c = known[n, 2, t] - Z - M[11, t]
            # how each unknown moves the sample along the ray
            l3, l4, l5 = known[n, 3, t], known[n, 4, t], known[n, 5, t]
            l0, l1, l2 = y * l5 - z * l4, z * l3 - x * l5, x * l4 - y * l3
            inner, less = a * l3 + b * l4 + c * l5, part * w
            p0, p1, p2, p3, p4, p5 = less * l0, less * l1, less * l2, less * l3, less * l4, less * l5
            # without rays: the shift moves all alike, a turn by ω moves by ω × (x, y, z)
            S[0, t] = S[0, t] + w * (y * c - z * b) - p0 * inner
            S[1, t] = S[1, t] + w * (z * a - x * c) - p1 * inner
            S[2, t] = S[2, t] + w * (x * b - y * a) - p2 * inner
            S[3, t] = S[3, t] + w * a - p3 * inner
            S[4, t] = S[4, t] + w * b - p4 * inner
            S[5, t] = S[5, t] + w * c - p5 * inner
            S[6, t] = S[6, t] + w * (y * y + z * z) - p0 * l0
            S[7, t] = S[7, t] - w * x * y - p1 * l0
            S[8, t] = S[8, t] + w * (x * x + z * z) - p1 * l1
            S[9, t] = S[9, t] - w * x * z - p2 * l0
            S[10, t] = S[10, t] - w * y * z - p2 * l1
            S[11, t] = S[11, t] + w * (x * x + y * y) - p2 * l2
            S[12, t] = S[12, t] - p3 * l0
            S[13, t] = S[13, t] + w * z - p3 * l1
            S[14, t] = S[14, t] - w * y - p3 * l2
            S[15, t] = S[15, t] + w - p3 * l3
            S[16, t] = S[16, t] - w * z - p4 * l0
            S[17, t] = S[17, t] - p4 * l1
            S[18, t] = S[18, t] + w * x - p4 * l2
            S[19, t] = S[19, t] - p4 * l3
            S[20, t] = S[20, t] + w - p4 * l4
            S[21, t] = S[21, t] + w * y - p5 * l0
            S[22, t] = S[22, t] - w * x - p5 * l1
            S[23, t] = S[23, t] - p5 * l2
            S[24, t] = S[24, t] - p5 * l3
            S[25, t] = S[25, t] - p5 * l4
            S[26, t] = S[26, t] + w - p5 * l5
    return S


def relative_turn(first: np.ndarray, second: np.ndarray, fraction: float = 0.05) -> float:
    """Angle by which two motions (T, 3, 3) differ, exceeded in a small fraction of the frames only, radians."""
    angles = np.sort(turn_angles(first.swapaxes(1, 2) @ second))
    return float(angles[len(angles) - 1 - int(fraction * (len(angles) - 1))])
