"""Ends of limbs, found on each frame's surface by themselves: they tell where a limb has gone that moved far."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra


def extremities(graph: csr_matrix, reach: float) -> np.ndarray:
    """Points that are farther from the surface's middle than all others within `reach` along the surface.

    Parameters
    ----------
    graph : (M, M) sparse
        From `surface_graph`.
    reach : float
        Radius in which an end must stand out, metres.

    Returns
    -------
    (E,) int, farthest first
    """
    middle = _middle(graph)
    distance = dijkstra(graph, directed=False, indices=middle)
    distance[~np.isfinite(distance)] = -1.0
    order = np.argsort(-distance, kind="stable")
    ends: list[int] = []
    covered = distance < 0
    for k in order[: len(order) // 2]:
        if covered[k]:
            continue
        near = dijkstra(graph, directed=False, indices=k, limit=reach)
        ball = np.isfinite(near)
        if distance[ball].max() <= distance[k]:
            ends.append(int(k))
        covered |= near < reach
        if covered.all():
            break
    return np.array(ends, int)


def _middle(graph: csr_matrix, landmarks: int = 16) -> int:
    """The point whose distances to landmarks spread over the surface are smallest in the mean."""
    distance = dijkstra(graph, directed=False, indices=0)
    total = np.zeros(graph.shape[0])
    nearest = np.full(graph.shape[0], np.inf)
    chosen = int(np.where(np.isfinite(distance), distance, -1).argmax())
    for _ in range(landmarks):
        distance = dijkstra(graph, directed=False, indices=chosen)
        finite = np.isfinite(distance)
        total += np.where(finite, distance, distance[finite].max())
        nearest = np.minimum(nearest, distance)
        chosen = int(np.where(np.isfinite(nearest), nearest, -1).argmax())
    return int(total.argmin())


def match_ends(expected: np.ndarray, seen: np.ndarray, gate: float) -> tuple[np.ndarray, np.ndarray]:
    """Match expected ends (E, 3) with those seen (F, 3), each at most once and no farther than `gate`, metres.

    Returns indices into both, the assignment with the smallest sum of distances.
    """
    if not len(expected) or not len(seen):
        return np.zeros(0, int), np.zeros(0, int)
    distance = np.linalg.norm(expected[:, None] - seen[None], axis=-1)
    i, j = linear_sum_assignment(np.minimum(distance, gate))
    near = distance[i, j] < gate
    return i[near], j[near]
