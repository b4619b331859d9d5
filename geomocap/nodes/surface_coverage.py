"""Which pieces of a surface motion paths speak for, and which are left to others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from geomocap.nodes.node_graph import farthest_points

SMALLEST_PIECE = 0.01
"""Fraction of the surface that counts as a piece of its own: bodies may be as small."""

_LOOKS = 9  # frames, evenly over all, in which the surface is looked at


def piece_reach(points: np.ndarray) -> float:
    """Return the distance, metres, within which a path speaks for the surface around it.

    It is the radius of a smallest piece: as many of those as there are, put as far from each other as possible, reach
    all points.

    Parameters
    ----------
    points : (M, 3) float, metres
        Of a frame's surface.
    """
    middles = points[farthest_points(points, round(1 / SMALLEST_PIECE))]
    return float(cKDTree(middles).query(points)[0].max())


def even_spacing(points: np.ndarray, count: int) -> float:
    """Return the distance, metres, that so many points have if they are spread evenly over the surface.

    Parameters
    ----------
    points : (M, 3) float, metres
        Of the surface, as dense anywhere as they like.
    count : int
    """
    return piece_reach(points) / float(np.sqrt(SMALLEST_PIECE * count))


def uncovered(points: np.ndarray, paths: np.ndarray, reach: float) -> np.ndarray:
    """Find which points (M, 3) are farther than `reach` from all paths (N, 3), NaN where not followed: (M,) bool."""
    there = paths[np.isfinite(paths[:, 0])]
    if not len(there):
        return np.ones(len(points), bool)
    return ~np.isfinite(cKDTree(there).query(points, distance_upper_bound=reach)[0])


def looks(n_frames: int) -> list[int]:
    """Return some frames, evenly over all."""
    return sorted({int(k) for k in np.linspace(0, n_frames - 1, _LOOKS).round()})


def uncovered_fraction(points: Callable[[int], np.ndarray], paths: np.ndarray, reach: float) -> float:
    """Return the fraction of the surface for which no path speaks, on average over the frames.

    Parameters
    ----------
    points : callable
        `points(frame) -> (M, 3) float`, metres: a frame's surface, evenly.
    paths : (N, T, 3) float, metres
        NaN where not followed.
    reach : float, metres
    """
    return float(np.mean([uncovered(points(k), paths[:, k], reach).mean() for k in looks(paths.shape[1])]))


def left_over(samples: np.ndarray, paths: np.ndarray, reach: float) -> np.ndarray:
    """Find which samples lie on pieces for which no path speaks in most of the frames in which they are followed.

    Parameters
    ----------
    samples : (K, T, 3) float, metres
        NaN where not followed.
    paths : (N, T, 3) float, metres
    reach : float, metres

    Returns
    -------
    (K,) bool
    """
    alone, there = np.zeros(len(samples), int), np.isfinite(samples[:, :, 0])
    for k in range(samples.shape[1]):
        rows = np.flatnonzero(there[:, k])
        alone[rows] += uncovered(samples[rows, k], paths[:, k], reach)
    return 2 * alone > there.sum(axis=1)


def limbs_apart(one: np.ndarray, other: np.ndarray, distance: float) -> np.ndarray:
    """Find which nodes (N, 3) are farther than `distance` from their other places (N, 3): (N,) bool.

    None if they are fewer than the smallest piece has: so few are no limb.
    """
    apart = np.asarray(np.linalg.norm(one - other, axis=1) > distance)
    return apart & (apart.mean() >= SMALLEST_PIECE)
