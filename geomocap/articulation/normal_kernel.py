"""Normal equations of an articulated fit: what observations of points say of the degrees of freedom of a frame.

A body's small motion is a twist (turn ω, shift v about the world's origin): dx = ω × x + v. Each degree of freedom
turns or shifts all bodies that hang on it by one and the same twist, so that the observations of a body are summed into
6 × 6 blocks first, as composite inertias are (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.2).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True)
def _add_block(block: np.ndarray, x: np.ndarray, y: np.ndarray, weight: np.ndarray, factor: float) -> None:
    """Add factor S(x)ᵀ W S(y) with S(x) = [-[x]×, I], 3 × 6."""
    sx = np.zeros((3, 6))
    sy = np.zeros((3, 6))
    for s, p in ((sx, x), (sy, y)):
        s[0, 1], s[0, 2] = p[2], -p[1]
        s[1, 0], s[1, 2] = -p[2], p[0]
        s[2, 0], s[2, 1] = p[1], -p[0]
        s[0, 3] = s[1, 4] = s[2, 5] = 1.0
    for j in range(6):
        w0 = factor * (weight[0, 0] * sy[0, j] + weight[0, 1] * sy[1, j] + weight[0, 2] * sy[2, j])
        w1 = factor * (weight[1, 0] * sy[0, j] + weight[1, 1] * sy[1, j] + weight[1, 2] * sy[2, j])
        w2 = factor * (weight[2, 0] * sy[0, j] + weight[2, 1] * sy[1, j] + weight[2, 2] * sy[2, j])
        for i in range(6):
            block[i, j] += sx[0, i] * w0 + sx[1, i] * w1 + sx[2, i] * w2


@njit(cache=True, nogil=True)
def _frame_equations(
    t,
    rotations,
    translations,
    twists,
    chain,
    chain_start,
    points,
    bodies,
    shares,
    start,
    point,
    target,
    normal,
    isotropic,
    across,
    cutoff,
    matrix,
    right,
):
    """Fill matrix (K, K) and right (K,) of frame t and return its cost; other parameters as of `normal_equations`."""
    count = rotations.shape[1]
    unknowns = twists.shape[1]
    most = bodies.shape[1]
    cost = 0.0
    blocks = np.zeros((count, count, 6, 6))
    used = np.zeros((count, count), np.bool_)
    forces = np.zeros((count, 6))
    x = np.zeros((most, 3))
    weight = np.zeros((3, 3))
    miss = np.zeros(3)
    force = np.zeros(3)
    for m in range(start[t], start[t + 1]):
        p = point[m]
        for i in range(3):
            miss[i] = target[m, i]
        for k in range(most):
            share = shares[p, k]
            if share == 0.0:
                continue
            b = bodies[p, k]
            for i in range(3):
                x[k, i] = translations[t, b, i]
                for j in range(3):
                    x[k, i] += rotations[t, b, i, j] * points[p, j]
                miss[i] -= share * x[k, i]
        along = miss[0] * normal[m, 0] + miss[1] * normal[m, 1] + miss[2] * normal[m, 2]
        chi2 = isotropic[m] * (miss[0] ** 2 + miss[1] ** 2 + miss[2] ** 2) + across[m] * along**2
        cost += 0.5 * cutoff**2 * np.log(1.0 + chi2 / cutoff**2)
        robust = 1.0 / (1.0 + chi2 / cutoff**2)
        for i in range(3):
            for j in range(3):
                weight[i, j] = robust * across[m] * normal[m, i] * normal[m, j]
            weight[i, i] += robust * isotropic[m]
        for i in range(3):
            force[i] = weight[i, 0] * miss[0] + weight[i, 1] * miss[1] + weight[i, 2] * miss[2]
        for k in range(most):
            share = shares[p, k]
            if share == 0.0:
                continue
            b = bodies[p, k]
            forces[b, 0] += share * (x[k, 1] * force[2] - x[k, 2] * force[1])
            forces[b, 1] += share * (x[k, 2] * force[0] - x[k, 0] * force[2])
            forces[b, 2] += share * (x[k, 0] * force[1] - x[k, 1] * force[0])
            for i in range(3):
                forces[b, 3 + i] += share * force[i]
            for n in range(most):
                other = shares[p, n]
                if other != 0.0:
                    c = bodies[p, n]
                    used[b, c] = True
                    _add_block(blocks[b, c], x[k], x[n], weight, share * other)
    carried = np.zeros((unknowns, 6))
    for b in range(count):
        for u in chain[chain_start[b] : chain_start[b + 1]]:
            for i in range(6):
                right[u] += twists[t, u, i] * forces[b, i]
        for c in range(count):
            if not used[b, c]:
                continue
            for u in chain[chain_start[b] : chain_start[b + 1]]:
                for j in range(6):
                    carried[u, j] = 0.0
                    for i in range(6):
                        carried[u, j] += twists[t, u, i] * blocks[b, c, i, j]
            for u in chain[chain_start[b] : chain_start[b + 1]]:
                for w in chain[chain_start[c] : chain_start[c + 1]]:
                    value = 0.0
                    for i in range(6):
                        value += carried[u, i] * twists[t, w, i]
                    matrix[u, w] += value
    return cost


@njit(cache=True, nogil=True, parallel=True)
def normal_equations(
    rotations: np.ndarray,
    translations: np.ndarray,
    twists: np.ndarray,
    chain: np.ndarray,
    chain_start: np.ndarray,
    points: np.ndarray,
    bodies: np.ndarray,
    shares: np.ndarray,
    start: np.ndarray,
    point: np.ndarray,
    target: np.ndarray,
    normal: np.ndarray,
    isotropic: np.ndarray,
    across: np.ndarray,
    cutoff: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss–Newton normal equations of each frame, observations weighted by 1 / (1 + χ² / cutoff²) (Cauchy).

    Parameters
    ----------
    rotations, translations : (T, B, 3, 3), (T, B, 3) float
        Motion of the bodies.
    twists : (T, K, 6) float
        Turn and shift about the world's origin that a unit of each unknown gives to all bodies that it moves.
    chain, chain_start : (…,) int, (B + 1,) int
        Unknowns that move body b: chain[chain_start[b] : chain_start[b + 1]], ascending.
    points : (N, 3) float, metres
        At rest.
    bodies, shares : (N, C) int, (N, C) float
        The bodies that a point follows.
    start : (T + 1,) int
        Observations of frame t are those from start[t] to start[t + 1].
    point : (M,) int
        Point that an observation is of.
    target, normal : (M, 3) float
        Where it was seen, metres, and a unit direction.
    isotropic, across : (M,) float, 1 / metres²
        Weight of the distance from the target, and of that along the normal.
    cutoff : float
        In standard deviations.

    Returns
    -------
    matrix : (T, K, K) float
    right : (T, K) float
    cost : (T,) float
        Half the sum of cutoff² log(1 + χ² / cutoff²).
    """
    frames = rotations.shape[0]
    unknowns = twists.shape[1]
    matrix = np.zeros((frames, unknowns, unknowns))
    right = np.zeros((frames, unknowns))
    cost = np.zeros(frames)
    for t in prange(frames):
        cost[t] = _frame_equations(
            np.int64(t),
            rotations,
            translations,
            twists,
            chain,
            chain_start,
            points,
            bodies,
            shares,
            start,
            point,
            target,
            normal,
            isotropic,
            across,
            cutoff,
            matrix[t],
            right[t],
        )
    return matrix, right, cost
