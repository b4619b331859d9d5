"""Normal equations of an articulated fit: what observations of points say of the degrees of freedom of a frame.

A body's small motion is a twist (turn ω, shift v about the world's origin): dx = ω × x + v. Each degree of freedom
turns or shifts all bodies that hang on it by one and the same twist, so that the observations of a body are summed into
6 × 6 blocks first, as composite inertias are (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.2).
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _add_block(block: np.ndarray, x: np.ndarray, y: np.ndarray, weight: np.ndarray, factor: float) -> None:
    """Add factor S(x)ᵀ W S(y) with S(x) = [-[x]×, I], 3 × 6."""
    x0, x1, x2 = x[0], x[1], x[2]
    y0, y1, y2 = y[0], y[1], y[2]
    for i in range(3):
        # row i of W, and of W S(y) for the turn; both go to the rows of S(x)ᵀ that they enter
        w0, w1, w2 = factor * weight[i, 0], factor * weight[i, 1], factor * weight[i, 2]
        t0, t1, t2 = w2 * y1 - w1 * y2, w0 * y2 - w2 * y0, w1 * y0 - w0 * y1
        if i == 0:
            upper, lower, up, low = 2, 1, -x1, x2
        elif i == 1:
            upper, lower, up, low = 0, 2, -x2, x0
        else:
            upper, lower, up, low = 1, 0, -x0, x1
        block[3 + i, 0] += t0
        block[3 + i, 1] += t1
        block[3 + i, 2] += t2
        block[3 + i, 3] += w0
        block[3 + i, 4] += w1
        block[3 + i, 5] += w2
        for row, arm in ((upper, up), (lower, low)):
            block[row, 0] += arm * t0
            block[row, 1] += arm * t1
            block[row, 2] += arm * t2
            block[row, 3] += arm * w0
            block[row, 4] += arm * w1
            block[row, 5] += arm * w2


@njit(cache=True, nogil=True, error_model="numpy")
def _frame_equations(t, motion, chains, skin, observations, cutoff, matrix, right):
    """Add to the matrix and right side of frame t, and return its cost; parameters as of `normal_equations`."""
    rotations, translations, twists = motion
    chain, chain_start = chains
    points, bodies, fractions = skin
    start, point, target, normal, isotropic, across = observations
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
            fraction = fractions[p, k]
            if fraction == 0.0:
                continue
            b = bodies[p, k]
            for i in range(3):
                x[k, i] = translations[t, b, i]
                for j in range(3):
                    x[k, i] += rotations[t, b, i, j] * points[p, j]
                miss[i] -= fraction * x[k, i]
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
            fraction = fractions[p, k]
            if fraction == 0.0:
                continue
            b = bodies[p, k]
            forces[b, 0] += fraction * (x[k, 1] * force[2] - x[k, 2] * force[1])
            forces[b, 1] += fraction * (x[k, 2] * force[0] - x[k, 0] * force[2])
            forces[b, 2] += fraction * (x[k, 0] * force[1] - x[k, 1] * force[0])
            for i in range(3):
                forces[b, 3 + i] += fraction * force[i]
            for n in range(most):
                other = fractions[p, n]
                if other != 0.0:
                    c = bodies[p, n]
                    used[b, c] = True
                    _add_block(blocks[b, c], x[k], x[n], weight, fraction * other)
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


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(begin, end, motion, chains, skin, observations, cutoff, matrix, right, cost):
    """Gauss–Newton normal equations of each frame, observations weighted by 1 / (1 + χ² / cutoff²) (Cauchy).

    Parameters
    ----------
    begin, end : int
        The frames of the part, of T.
    motion : rotations (T, B, 3, 3), translations (T, B, 3), twists (T, K, 6)
        Motion of the bodies; turn and shift about the world's origin that a unit of each unknown gives to all bodies
        that it moves.
    chains : chain (…,) int, chain_start (B + 1,) int
        Unknowns that move body b: chain[chain_start[b] : chain_start[b + 1]], ascending.
    skin : points (N, 3), bodies (N, C) int, fractions (N, C)
        `SkinPoints`: at rest, metres; the bodies that a point follows.
    observations : start (T + 1,) int, point (M,) int, target (M, 3), normal (M, 3), isotropic (M,), across (M,)
        `Observations`: where points were seen, metres, and weights of the distance from there.
    cutoff : float
        In standard deviations.
    matrix, right : (T, K, K), (T, K) float
        Zeros; the equations are added to them.
    cost : (T,) float
        Filled: half the sum of cutoff² log(1 + χ² / cutoff²).
    """
    for t in range(begin, end):
        cost[t] = _frame_equations(t, motion, chains, skin, observations, cutoff, matrix[t], right[t])
