"""The iterative variant: the largest body is taken out, and the rest is segmented again set by set (section 9)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.sparse.csgraph import connected_components

from geomocap.errors import GeometryError
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.segmentation.contacts import count_contacts
from geomocap.segmentation.ellipsoid_matching import EllipsoidPaths
from geomocap.segmentation.relative_paths import Grouping, group_paths, path_integrals

Points = Callable[[int], np.ndarray]

_ISOLATED = 0.5


@dataclass(frozen=True)
class _Subset:
    """A part of the points of all frames, divided into ellipsoids by itself.

    `members` are the numbers of its points in each frame, T arrays (n_t,).
    """

    paths: EllipsoidPaths
    members: list[np.ndarray]

    def within(self, chosen: np.ndarray) -> list[np.ndarray]:
        """Numbers of the points of some of its ellipsoids in each frame."""
        inside = np.zeros(len(self.paths.contacts), bool)
        inside[chosen] = True
        return [these[inside[label]] for these, label in zip(self.members, self.paths.labels, strict=True)]

    def isolated(self, chosen: np.ndarray) -> Iterator[np.ndarray]:
        """Ellipsoids among the chosen that touch, directly or through others, in at least half of the frames."""
        graph = self.paths.touching[np.ix_(chosen, chosen)] >= _ISOLATED
        count, component = connected_components(graph, directed=False)
        return (chosen[component == c] for c in range(count))


@dataclass(frozen=True)
class _FoundBody:
    """Ellipsoids of a set that are one body, and the one among them that it was found from."""

    origin: _Subset
    chosen: np.ndarray
    seed: int


def peel_bodies(
    run: Callable[[Points], EllipsoidPaths],
    points: Points,
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
    found: list[_FoundBody] = []
    queue = deque([_Subset(paths, [np.arange(len(labels), dtype=np.int32) for labels in paths.labels])])
    while queue:
        some = queue.popleft()
        first = some.paths.ellipsoids
        grouping = group_paths(path_integrals(first.centers), first.centers[0], first.counts[0], threshold)
        # Take the largest body out
        largest = int(np.argmax(np.bincount(grouping.body, first.counts.mean(axis=0))))
        found.append(_FoundBody(some, np.flatnonzero(grouping.body == largest), int(grouping.seeds[largest])))
        # Repeat on each isolated set of the rest
        for chosen in some.isolated(np.flatnonzero(grouping.body != largest)):
            members = some.within(chosen)
            enough = min(map(len, members)) >= 4 * min_points
            one = len(np.unique(grouping.body[chosen])) == 1
            again = _segmented_again(run, points, members) if enough and not one else None
            if again is not None:
                queue.append(again)
            else:
                found.append(_FoundBody(some, chosen, int(chosen[np.argmax(first.counts[0, chosen])])))
    return _joined(found, points, paths, threshold, spacing)


def _segmented_again(
    run: Callable[[Points], EllipsoidPaths], points: Points, members: list[np.ndarray]
) -> _Subset | None:
    try:
        return _Subset(run(partial(_points_of, points, members)), members)
    except GeometryError:  # too few points in some frame for the ellipsoids of the first
        return None


def _points_of(points: Points, members: list[np.ndarray], frame: int) -> np.ndarray:
    return points(frame)[members[frame]]


def _joined(
    found: list[_FoundBody], points: Points, whole: EllipsoidPaths, threshold: float, spacing: float
) -> tuple[EllipsoidPaths, Grouping]:
    """All bodies' ellipsoids as paths of the whole, numbered body by body."""
    labels = [np.full(len(these), -1, np.int16) for these in whole.labels]
    seeds = np.empty(len(found), np.int32)
    total = 0
    for b, one in enumerate(found):
        for k in one.chosen:
            for label, members in zip(labels, one.origin.within(np.array([k])), strict=True):
                label[members] = total
            if k == one.seed:
                seeds[b] = total
            total += 1
    ellipsoids = Ellipsoids.joined([b.origin.paths.ellipsoids.select(b.chosen) for b in found])
    contacts, touching = np.zeros((total, total)), np.zeros((total, total))
    for frame, these in enumerate(labels):
        grid = np.ascontiguousarray(points(frame), np.float64) / spacing
        between = count_contacts(grid, these.astype(np.int32), total)
        contacts += between / len(labels)
        touching += (between > 0) / len(labels)
    body = np.repeat(np.arange(len(found), dtype=np.int32), [len(b.chosen) for b in found])
    joined = EllipsoidPaths(ellipsoids, tuple(labels), contacts, touching, whole.repaired)
    return joined, Grouping(body, seeds, path_integrals(ellipsoids.centers), threshold)
