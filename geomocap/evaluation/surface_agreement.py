"""How well bodies carry the surface of each frame onto that of the others: a figure that needs no truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree

_POINTS = 2000  # of a frame that are compared


def surface_disagreement(
    points: Callable[[int], np.ndarray],
    label: Callable[[int, np.ndarray], np.ndarray],
    rotations: np.ndarray,
    translations: np.ndarray,
    frames: Sequence[int],
    reach: float,
) -> float:
    """Return the mean distance between a frame's surface and those of other frames, carried there by the bodies.

    Bodies that move wrongly, or in fewer pieces than there are, leave surface behind; where they don't follow a limb at
    all, they leave all of it.

    Parameters
    ----------
    points : callable
        `points(frame) -> (M, 3) float`, metres: a frame's surface, evenly.
    label : callable
        `label(frame, points) -> (M,) int`, bodies of points of a frame.
    rotations, translations : (T, B, 3, 3), (T, B, 3) float, metres
        Motions of the bodies: position(t) = rotation @ position(0) + translation.
    frames : sequence of int
        Those that are compared, each with each.
    reach : float, metres
        Larger distances count as this.

    Returns
    -------
    float, metres
        Of both ways, each point to the nearest one.
    """
    surfaces, rest, bodies = {}, {}, {}
    for k in frames:
        p = points(k)
        p = p[:: max(1, len(p) // _POINTS)]
        b = label(k, p)
        bodied = b >= 0
        surfaces[k], bodies[k] = p, b[bodied]
        away = p[bodied] - translations[k, bodies[k]]
        rest[k] = np.einsum("nji,nj->ni", rotations[k, bodies[k]], away)
    trees = {k: cKDTree(p) for k, p in surfaces.items()}
    distances = []
    for k, other in permutations(frames, 2):
        b = bodies[k]
        if not len(b):
            distances.append(reach)
            continue
        carried = np.einsum("nij,nj->ni", rotations[other, b], rest[k]) + translations[other, b]
        there, back = trees[other].query(carried)[0], cKDTree(carried).query(surfaces[other])[0]
        distances.append(0.5 * (np.minimum(there, reach).mean() + np.minimum(back, reach).mean()))
    return float(np.mean(distances)) if distances else 0.0
