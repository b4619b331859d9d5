"""Which ellipsoid of the next frame each ellipsoid becomes: the least error of matching, by dynamic programming."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import cdist

_CANDIDATES = 16


def assign(cost: np.ndarray, old: np.ndarray, new: np.ndarray, coherence: float) -> np.ndarray:
    """Assign a target to every ellipsoid, (K,) int64; several may get the same (section 6).

    The stages of the dynamic programming are the ellipsoids. With a weight for coherence neighbours are coupled, which
    should move alike; without, as in the paper, each stage stands for itself.

    Parameters
    ----------
    cost : (K, L) float
        See `match_cost`.
    old, new : (K, 3), (L, 3) float
        Centres.
    coherence : float
    """
    if coherence == 0:
        return cost.argmin(axis=1)
    candidates = np.argsort(cost, axis=1, kind="stable")[:, :_CANDIDATES]
    order, parent = _stages(old)
    return assign_tree(np.take_along_axis(cost, candidates, axis=1), candidates, order, parent, old, new, coherence)


@njit(cache=True, nogil=True, error_model="numpy")
def assign_tree(
    cost: np.ndarray,
    candidates: np.ndarray,
    order: np.ndarray,
    parent: np.ndarray,
    old: np.ndarray,
    new: np.ndarray,
    coherence: float,
) -> np.ndarray:
    """Assign a target to every ellipsoid by dynamic programming on a tree; several may get the same.

    Minimises Σ cost[i, target_i] + coherence · Σ_(edges i, p) ‖(new_target_i − old_i) − (new_target_p − old_p)‖.

    Parameters
    ----------
    cost : (K, C) float
        Cost of the candidates of each ellipsoid.
    candidates : (K, C) int
        Targets to choose from.
    order : (K,) int
        Parents before children; the stages run through it backwards.
    parent : (K,) int
        Parent in the tree; of the first in the order it is not used.
    old : (K, 3) float
    new : (L, 3) float
    coherence : float

    Returns
    -------
    (K,) int64
    """
    count, choices = cost.shape
    value = cost.copy()
    choice = np.empty((count, choices), np.int64)
    for step in range(count - 1, 0, -1):
        i = order[step]
        p = parent[i]
        for a in range(choices):
            tp = candidates[p, a]
            best, arg = np.inf, 0
            for b in range(choices):
                v = value[i, b]
                if v >= best:
                    continue
                if coherence > 0.0:
                    ti = candidates[i, b]
                    dx = (new[ti, 0] - old[i, 0]) - (new[tp, 0] - old[p, 0])
                    dy = (new[ti, 1] - old[i, 1]) - (new[tp, 1] - old[p, 1])
                    dz = (new[ti, 2] - old[i, 2]) - (new[tp, 2] - old[p, 2])
                    v += coherence * np.sqrt(dx * dx + dy * dy + dz * dz)
                if v < best:
                    best, arg = v, b
            value[p, a] += best
            choice[i, a] = arg
    picked = np.empty(count, np.int64)
    target = np.empty(count, np.int64)
    for step in range(count):
        i = order[step]
        picked[i] = np.argmin(value[i]) if step == 0 else choice[i, picked[parent[i]]]
        target[i] = candidates[i, picked[i]]
    return target


def _stages(centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order of the stages: the minimum spanning tree over the centres, breadth first from the most central one."""
    distance = cdist(centers, centers)
    root = int(np.argmin(distance.sum(axis=1)))
    tree = minimum_spanning_tree(distance + 1e-12)
    order, parent = breadth_first_order(tree, root, directed=False)
    return order.astype(np.int64), np.where(parent < 0, root, parent).astype(np.int64)


def match_cost(
    old: np.ndarray, old_counts: np.ndarray, new: np.ndarray, new_counts: np.ndarray, size_weight: float
) -> np.ndarray:
    """Cost of every pair of ellipsoids: distance of the centres plus weighted difference of the sizes (section 6).

    The difference of the counts is divided by the square root of the mean count: both terms are lengths then, in
    spacings, and their balance does not change with the resolution.

    Parameters
    ----------
    old, new : (K, 3), (L, 3) float, spacings
    old_counts, new_counts : (K,), (L,) float
    size_weight : float

    Returns
    -------
    (K, L) float, spacings
    """
    difference = np.abs(old_counts[:, None] - new_counts[None])
    return cdist(old, new) + size_weight / np.sqrt(old_counts.mean()) * difference
