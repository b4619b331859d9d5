"""Choosing trajectories that together cover the surface evenly, long ones first."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def spread_out(positions: np.ndarray, spacing: float, least_fraction: float = 0.25) -> np.ndarray:
    """Choose long trajectories that keep a distance from each other: as many on each part of the surface.

    Trajectories are taken in the order of their length; each one taken bars those that are nearer to it. Nearness is
    judged in the middle of the taken one's life, among those measured there.

    Parameters
    ----------
    positions : (N, T, 3) float, metres
        NaN where not measured.
    spacing : float, metres
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
    middle = [int(np.flatnonzero(m)[m.sum() // 2]) for m in measured[long]]
    trees = {}
    for t in sorted(set(middle)):
        there = np.flatnonzero(measured[long, t])
        trees[t] = there, cKDTree(positions[long[there], t])
    taken = np.zeros(len(long), bool)
    barred = np.zeros(len(long), bool)
    for i in np.argsort(-lengths[long], kind="stable"):
        if not barred[i]:
            taken[i] = True
            there, tree = trees[middle[i]]
            barred[there[tree.query_ball_point(positions[long[i], middle[i]], spacing)]] = True
    return long[taken]
