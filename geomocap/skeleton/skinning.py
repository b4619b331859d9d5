"""Skin weights from motion: which bodies a point follows, and by which fractions (linear blend skinning)."""

from __future__ import annotations

import numba
import numpy as np
from scipy.spatial import cKDTree

from geomocap.scheduling import spread
from geomocap.skeleton.body_observations import INFLUENCES, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion, Linkage

_SWEEPS = 60


def fit_fractions(
    points: SkinPoints,
    bodies: BodyMotion,
    positions: np.ndarray,
    weights: np.ndarray,
    candidates: np.ndarray,
    pull: np.ndarray,
) -> SkinPoints:
    """Fractions of the bodies that explain the paths of points best, places at rest given.

    Least squares over the frames under w ≥ 0 and Σ w = 1 (Le & Deng, Smooth Skinning Decomposition with Rigid Bones,
    2012, section 4.2), with a pull towards the fractions that a point has.

    Parameters
    ----------
    points : SkinPoints
    bodies : BodyMotion
    positions : (N, T, 3) float, metres
    weights : (N, T) float
        0 where not seen.
    candidates : (N, 4) int32
        Bodies that may move a point; -1: none.
    pull : (N,) float, metres²
        Weight of the squared difference from the present fractions, beside the mean squared distance.
    """
    count = bodies.rotations.shape[1]
    present = points.weights(count)
    fractions = np.zeros(present.shape)
    spread(
        _fit_fractions,
        len(points.rest),
        points.rest,
        np.ascontiguousarray(bodies.rotations),
        np.ascontiguousarray(bodies.translations),
        np.where(np.isfinite(positions), positions, 0.0),
        weights,
        candidates,
        present,
        pull,
        fractions,
    )
    return SkinPoints.of_weights(points.rest, fractions)


def candidates_near(linkage: Linkage, points: SkinPoints) -> np.ndarray:
    """Bodies that may move each point, (N, 4) int32: its own and those joined to it, the nearest at rest first."""
    count = linkage.body_count
    joined = np.eye(count, dtype=bool)
    parents, children = linkage.hierarchy.joint_bodies.T
    joined[parents, children] = joined[children, parents] = True
    distance = np.full((len(points), count), np.inf)
    for b in range(count):
        members = points.rest[points.body == b]
        asked = joined[points.body, b]
        if len(members) and asked.any():
            distance[asked, b] = cKDTree(members).query(points.rest[asked])[0]
    order = np.argsort(distance, axis=1, kind="stable")[:, :INFLUENCES]
    there = np.isfinite(np.take_along_axis(distance, order, axis=1))
    result = np.full((len(points), INFLUENCES), -1, np.int32)
    result[:, : order.shape[1]] = np.where(there, order, -1)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit_one(n, rest, rotations, translations, positions, weights, candidates, present, pull, result):
    """Fill the fractions of point n."""
    bodies = np.empty(candidates.shape[1], np.int64)
    k = 0
    for c in range(candidates.shape[1]):
        if candidates[n, c] >= 0:
            bodies[k] = candidates[n, c]
            k += 1
    gram = np.zeros((k, k))
    away = np.zeros((k, 3))  # seen minus carried: Σ w away is what is left, as Σ w = 1
    total = 1e-12
    for t in range(weights.shape[1]):
        w = weights[n, t]
        if w == 0.0:
            continue
        total += w
        for a in range(k):
            for i in range(3):
                away[a, i] = positions[n, t, i] - translations[t, bodies[a], i]
                for j in range(3):
                    away[a, i] -= rotations[t, bodies[a], i, j] * rest[n, j]
            for b in range(a + 1):
                product = away[a, 0] * away[b, 0] + away[a, 1] * away[b, 1] + away[a, 2] * away[b, 2]
                gram[a, b] += w * product
    fraction = np.zeros(k)
    linear = np.zeros(k)
    for a in range(k):
        for b in range(a + 1):
            gram[a, b] /= total
            gram[b, a] = gram[a, b]
        gram[a, a] += pull[n]
        linear[a] = pull[n] * present[n, bodies[a]]
        fraction[a] = present[n, bodies[a]]
    amount = 0.0
    for a in range(k):
        amount += fraction[a]
    if amount <= 0.0:
        fraction[0] = amount = 1.0
    for a in range(k):
        fraction[a] /= amount
    for _ in range(_SWEEPS):  # mass goes from one body to another, as much as is best
        moved = 0.0
        for a in range(k):
            for b in range(a):
                slope = linear[a] - linear[b]
                for c in range(k):
                    slope -= (gram[a, c] - gram[b, c]) * fraction[c]
                curve = gram[a, a] + gram[b, b] - 2.0 * gram[a, b]
                if curve <= 1e-18:
                    continue
                step = min(max(slope / curve, -fraction[a]), fraction[b])
                fraction[a] += step
                fraction[b] -= step
                moved = max(moved, abs(step))
        if moved < 1e-4:
            break
    for a in range(k):
        result[n, bodies[a]] = fraction[a]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit_fractions(begin, end, rest, rotations, translations, positions, weights, candidates, present, pull, result):
    for n in range(begin, end):
        _fit_one(n, rest, rotations, translations, positions, weights, candidates, present, pull, result)
