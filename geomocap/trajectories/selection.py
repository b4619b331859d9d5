"""Choosing trajectories that together cover the surface evenly, long ones first."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def spread_out(positions: np.ndarray, count: int, least_fraction: float = 0.25) -> np.ndarray:
    """Choose about `count` long trajectories, evenly over the surface.

    Trajectories are taken in the order of their length; each one taken bars those that are nearer to it than a distance
    found by bisection. Nearness is judged in the middle of the taken one's life, among those measured there.

    Parameters
    ----------
    positions : (N, T, 3) float, metres
        NaN where not measured.
    count : int
        Number wanted at most.
    least_fraction : float
        Trajectories measured in a smaller fraction of the frames are left out.

    Returns
    -------
    (M,) int
        Indices, ascending.
    """
    measured = np.isfinite(positions[:, :, 0])
    lengths = measured.sum(axis=1)
    long = np.flatnonzero(lengths >= max(2, least_fraction * positions.shape[1]))
    if len(long) <= count:
        return long
    middle = np.array([np.flatnonzero(m)[m.sum() // 2] for m in measured[long]])
    order = np.argsort(-lengths[long], kind="stable")
    trees = {}
    for t in np.unique(middle):
        there = np.flatnonzero(measured[long, t])
        trees[t] = there, cKDTree(positions[long[there], t])
    low, high = 0.0, float(np.linalg.norm(np.nanmax(positions[long], (0, 1)) - np.nanmin(positions[long], (0, 1))))
    chosen = long
    for _ in range(16):
        distance = (low + high) / 2
        taken = np.zeros(len(long), bool)
        barred = np.zeros(len(long), bool)
        for i in order:
            if barred[i]:
                continue
            taken[i] = True
            there, tree = trees[middle[i]]
            barred[there[tree.query_ball_point(positions[long[i], middle[i]], distance)]] = True
        if taken.sum() > count:
            low = distance
        else:
            high, chosen = distance, long[taken]
    return chosen
