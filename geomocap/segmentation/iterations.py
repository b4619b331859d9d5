"""The iterative variant: the largest body is taken out, and the rest is segmented again set by set (section 9)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.sparse.csgraph import connected_components

from geomocap.errors import GeometryError
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.segmentation.contacts import count_contacts
from geomocap.segmentation.ellipsoid_matching import EllipsoidPaths
from geomocap.segmentation.relative_paths import Grouping, group_paths, path_integrals

_ISOLATED = 0.5


def _subset(points: Callable[[int], np.ndarray], members: list[np.ndarray], frame: int) -> np.ndarray:
    return points(frame)[members[frame]]


def peel_bodies(
    run: Callable[[Callable[[int], np.ndarray]], EllipsoidPaths],
    points: Callable[[int], np.ndarray],
    paths: EllipsoidPaths,
    threshold: float,
    min_points: int,
    spacing: float,
) -> tuple[EllipsoidPaths, Grouping]:
    """Find bodies from the largest outward.

    The largest body of a set is taken out of all frames. What is left falls into isolated sets: ellipsoids that touch,
    directly or through others, in at least half of the frames. Each set is split, merged, matched and grouped again,
    until it is one body. The threshold stays that of the whole, or a rigid set would be divided without end.

    Parameters
    ----------
    run : callable
        Gives the paths of a part of the points.
    points : callable
        All points of a frame.
    paths : EllipsoidPaths
        Those of the whole.
    threshold : float, metres
    min_points : int
        A set with less than four times as many points in any frame is one body.
    spacing : float, metres

    Returns
    -------
    EllipsoidPaths
        All ellipsoids of all final sets.
    Grouping
        Bodies in the order in which they were found.
    """
    frames = len(paths.labels)
    everything = [np.arange(len(labels), dtype=np.int32) for labels in paths.labels]
    queue: deque[tuple[EllipsoidPaths, list[np.ndarray]]] = deque([(paths, everything)])
    parts: list[tuple[Ellipsoids, int]] = []
    labels = [np.full(len(these), -1, np.int16) for these in paths.labels]
    seeds: list[int] = []
    total = 0

    def keep(found: EllipsoidPaths, members: list[np.ndarray], chosen: np.ndarray, seed: int) -> None:
        nonlocal total
        number = np.full(found.ellipsoids.counts.shape[1], -1, np.int16)
        number[chosen] = total + np.arange(len(chosen))
        for t in range(frames):
            new = number[found.labels[t]]
            labels[t][members[t][new >= 0]] = new[new >= 0]
        seeds.append(int(number[seed]))
        parts.append((_choose(found.ellipsoids, chosen), len(chosen)))
        total += len(chosen)

    while queue:
        found, members = queue.popleft()
        first = found.ellipsoids
        integrals = path_integrals(first.centers)
        grouping = group_paths(integrals, first.centers[0], first.counts[0], threshold)
        sizes = np.bincount(grouping.body, first.counts.mean(axis=0))
        largest = int(np.argmax(sizes))
        keep(found, members, np.flatnonzero(grouping.body == largest), grouping.seeds[largest])
        rest = np.flatnonzero(grouping.body != largest)
        if len(rest) == 0:
            continue
        graph = found.touching[np.ix_(rest, rest)] >= _ISOLATED
        count, component = connected_components(graph, directed=False)
        for c in range(count):
            chosen = rest[component == c]
            inside = np.zeros(first.counts.shape[1], bool)
            inside[chosen] = True
            these = [members[t][inside[found.labels[t]]] for t in range(frames)]
            again = None
            if min(len(m) for m in these) >= 4 * min_points and len(np.unique(grouping.body[chosen])) > 1:
                try:
                    again = run(partial(_subset, points, these))
                except GeometryError:  # too few points in some frame for the ellipsoids of the first
                    again = None
            if again is not None:
                queue.append((again, these))
            else:
                keep(found, members, chosen, int(chosen[np.argmax(first.counts[0, chosen])]))
    ellipsoids = _join([part for part, _ in parts])
    body = np.repeat(np.arange(len(parts), dtype=np.int32), [n for _, n in parts])
    contacts, touching = _contacts(points, labels, total, spacing)
    joined = EllipsoidPaths(ellipsoids, tuple(labels), contacts, touching, paths.repaired)
    integrals = path_integrals(ellipsoids.centers)
    return joined, Grouping(body, np.array(seeds, np.int32), integrals, threshold)


def _choose(ellipsoids: Ellipsoids, chosen: np.ndarray) -> Ellipsoids:
    return Ellipsoids(
        ellipsoids.centers[:, chosen],
        ellipsoids.radii[:, chosen],
        ellipsoids.rotations[:, chosen],
        ellipsoids.counts[:, chosen],
        ellipsoids.errors[:, chosen],
    )


def _join(parts: list[Ellipsoids]) -> Ellipsoids:
    return Ellipsoids(
        np.concatenate([p.centers for p in parts], axis=1),
        np.concatenate([p.radii for p in parts], axis=1),
        np.concatenate([p.rotations for p in parts], axis=1),
        np.concatenate([p.counts for p in parts], axis=1),
        np.concatenate([p.errors for p in parts], axis=1),
    )


def _contacts(
    points: Callable[[int], np.ndarray], labels: list[np.ndarray], count: int, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    contacts = np.zeros((count, count))
    touching = np.zeros((count, count))
    for frame, these in enumerate(labels):
        grid = np.ascontiguousarray(points(frame), np.float64) / spacing
        found = count_contacts(grid, these.astype(np.int32), count)
        contacts += found
        touching += found > 0
    return contacts / len(labels), touching / len(labels)
