"""Ellipsoids matched from frame to frame, with a repair that keeps their number constant."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from geomocap.errors import GeometryError
from geomocap.model.ellipsoids import Ellipsoids, from_moments, union_errors
from geomocap.segmentation.carried_ellipsoids import Carrier, EllipsoidMotion, Guide
from geomocap.segmentation.contacts import count_contacts
from geomocap.segmentation.ellipsoid_assignment import assign, match_cost
from geomocap.segmentation.ellipsoid_merging import merge_frame
from geomocap.segmentation.ellipsoid_splitting import SplitFrame, split_points
from geomocap.segmentation.m3_settings import SegmentationSettings

_CONTACTS_EVERY = 4
# What it costs, spacings, to go where none of an ellipsoid's tracked points does: more than any other way. Core index
# of a man, a mechanism and two horses, from where points carry ellipsoids alone → and from what they say of leaves:
# 0.85, 0.67, 0.39, 0.66 → 0.87, 0.71, 0.55, 0.54.
_ELSEWHERE = 1e6


@dataclass(frozen=True)
class EllipsoidPaths:
    """The ellipsoids of a sequence, the same K in every frame.

    Attributes
    ----------
    ellipsoids : Ellipsoids
        With a leading axis T: centers (T, K, 3) are the paths.
    labels : tuple of (N_t,) int16
        Ellipsoid of every point of every frame.
    contacts : (K, K) float
        Neighbouring pairs of points between two ellipsoids, mean over every fourth frame.
    touching : (K, K) float
        Fraction of every fourth frame in which two ellipsoids touch.
    repaired : (T,) int32
        Ellipsoids that were split because several were matched to them; 0 in the first frame.
    motion : EllipsoidMotion, optional
        How tracked points carry them.
    """

    ellipsoids: Ellipsoids
    labels: tuple[np.ndarray, ...]
    contacts: np.ndarray
    touching: np.ndarray
    repaired: np.ndarray
    motion: EllipsoidMotion | None = None


@njit(cache=True, nogil=True, error_model="numpy")
def halve(
    points: np.ndarray, order: np.ndarray, begin: np.ndarray, end: np.ndarray, moments: np.ndarray, k: int, count: int
) -> bool:
    """Cut set k in two by the plane of the split stage, in place; the upper half becomes set `count`.

    Set k is points[begin[k]:end[k]]. Returns False, and changes nothing, if the set can't be cut.
    """
    a, b = begin[k], end[k]
    if b - a < 2:
        return False
    once = min(b - a, 1)  # no literal: Numba would compile the splitting anew for it
    pts, within, starts, parts, _ = split_points(points[a:b], 0.0, once, once)
    if starts.shape[0] < 3:
        return False
    points[a:b] = pts
    order[a:b] = order[a:b][within]
    begin[count], end[count] = a + starts[1], b
    end[k] = a + starts[1]
    moments[k], moments[count] = parts[0], parts[1]
    return True


class _Sets:
    """The sets of a frame while matching is under way: ranges of points that can be cut further."""

    def __init__(self, split: SplitFrame, room: int) -> None:
        self.points, self.order = split.points.copy(), split.order.copy()
        self.count = len(split.errors)
        self.begin = np.zeros(self.count + room, np.int64)
        self.end = np.zeros(self.count + room, np.int64)
        self.begin[: self.count], self.end[: self.count] = split.starts[:-1], split.starts[1:]
        self.moments = np.zeros((self.count + room, 10))
        self.moments[: self.count] = split.moments

    def halve(self, chosen: np.ndarray) -> int:
        """Cut the chosen sets in two; returns how many could be cut."""
        before = self.count
        for k in chosen:
            if self.count < len(self.begin) and halve(
                self.points, self.order, self.begin, self.end, self.moments, k, self.count
            ):
                self.count += 1
        return self.count - before

    @property
    def counts(self) -> np.ndarray:
        return self.moments[: self.count, 0]

    @property
    def centers(self) -> np.ndarray:
        return self.moments[: self.count, 1:4] / self.counts[:, None]

    def labels(self, sets: np.ndarray) -> np.ndarray:
        """Label of each of the points, when set k is part of `sets[k]`."""
        labels = np.empty(len(self.points), np.int32)
        for k in range(self.count):
            labels[self.begin[k] : self.end[k]] = sets[k]
        return labels

    def of_points(self) -> np.ndarray:
        """Set of each of the points in the order in which they were given."""
        sets = np.empty(len(self.points), np.int32)
        sets[self.order] = self.labels(np.arange(self.count))
        return sets


@dataclass(frozen=True)
class MatchedFrame:
    """A frame divided into the K ellipsoids of the sequence.

    Attributes
    ----------
    labels : (N,) int16
        Ellipsoid of each point, in the order in which the points were given.
    moments : (K, 10) float, grid units
    errors : (K,) float, grid units
    contacts : (K, K) int32, optional
        Neighbouring pairs of points between two ellipsoids, if they were counted.
    repaired : int
        Sets that were cut because several ellipsoids had been matched to them.
    origin : (3,) float, metres, world
    spacing : float, metres
    """

    labels: np.ndarray
    moments: np.ndarray
    errors: np.ndarray
    contacts: np.ndarray | None
    repaired: int
    origin: np.ndarray
    spacing: float

    @property
    def ellipsoids(self) -> Ellipsoids:
        """The ellipsoids in metres."""
        return from_moments(self.moments, self.errors, self.origin, self.spacing)

    @property
    def centers(self) -> np.ndarray:
        """Centres, (K, 3), spacings, world."""
        return self.origin / self.spacing + self.moments[:, 1:4] / self.moments[:, :1]

    @classmethod
    def of(
        cls, split: SplitFrame, sets: _Sets, partner: np.ndarray, count: int, repaired: int, touch: bool
    ) -> MatchedFrame:
        """Unite the sets of each partner."""
        ordered = sets.labels(partner)
        moments = np.zeros((count, 10))
        np.add.at(moments, partner, sets.moments[: sets.count])
        labels = np.empty(len(ordered), np.int16)
        labels[sets.order] = ordered
        return cls(
            labels,
            moments,
            union_errors(sets.points, sets.begin, sets.end, partner, moments),
            count_contacts(sets.points, ordered, count) if touch else None,
            repaired,
            split.origin,
            split.spacing,
        )


def first_frame(split: SplitFrame, settings: SegmentationSettings) -> MatchedFrame:
    """Merge the first frame (section 5.2.2); the number of its ellipsoids is that of the sequence."""
    merged = merge_frame(split, settings.merge_error)
    return MatchedFrame.of(split, _Sets(split, 0), merged, int(merged.max()) + 1, 0, True)


def match_frame(
    before: MatchedFrame,
    split: SplitFrame,
    settings: SegmentationSettings,
    frame: int = 0,
    touch: bool = True,
    guide: Guide | None = None,
) -> MatchedFrame:
    """Match the K ellipsoids of a frame to the leaves of the next, and make these K as well (section 6, figure 3).

    Parameters
    ----------
    before : MatchedFrame
        Frame t.
    split : SplitFrame
        The leaves of frame t + 1.
    settings : SegmentationSettings
    frame : int
        Number of frame t + 1, for errors.
    touch : bool
        Whether to count contacts.
    guide : Guide, optional
        What tracked points say: an ellipsoid is looked for where they carry it, and among the leaves that hold some of
        its own; a leaf without a partner goes to the ellipsoid of which it holds most.

    Returns
    -------
    MatchedFrame
        Frame t + 1 in K sets: set k is the partner of set k of frame t.

    Raises
    ------
    GeometryError
        If the frame has too few points for K ellipsoids.
    """
    count = len(before.moments)
    old, old_counts = before.centers - split.origin / split.spacing, before.moments[:, 0]
    if guide is not None:
        old = (guide.centers - split.origin) / split.spacing
    sets = _Sets(split, 4 * count)
    repaired = 0

    def costs() -> np.ndarray:
        cost = match_cost(old, old_counts, sets.centers, sets.counts, settings.size_weight)
        if guide is None:
            return cost
        votes = guide.votes(sets.of_points(), sets.count)
        return np.where((votes > 0) | ~votes.any(axis=1, keepdims=True), cost, cost + _ELSEWHERE)

    while True:
        new, cost = sets.centers, costs()
        target = assign(cost, old, new, settings.coherence_weight)
        # Duplicated ellipsoids: split them and assign again
        duplicated = np.flatnonzero(np.bincount(target) > 1)
        cut = sets.halve(duplicated)
        repaired += cut
        if cut == 0:
            break
    if len(duplicated):
        # Splitting has not told them apart: the cheapest one-to-one assignment does
        while sets.count < count and sets.halve(np.argsort(-sets.counts, kind="stable")[:1]):
            repaired += 1
        if sets.count < count:
            raise GeometryError(
                f"frame {frame}: its {len(split.points)} points can't be divided into the {count} ellipsoids of the "
                "first frame; check this frame's geometry, or leave it out"
            )
        new = sets.centers
        target = linear_sum_assignment(costs())[1]
    # Missing correspondences: merge the ellipsoid into the nearest matched one
    partner = cdist(new, new[target]).argmin(axis=1).astype(np.int32)
    if guide is not None:
        votes = guide.votes(sets.of_points(), sets.count)
        partner = np.where(votes.any(axis=0), votes.argmax(axis=0), partner).astype(np.int32)
    partner[target] = np.arange(count)
    return MatchedFrame.of(split, sets, partner, count, repaired, touch)


def match_frames(
    splits: Iterable[SplitFrame], settings: SegmentationSettings, tracks: np.ndarray | None = None
) -> EllipsoidPaths:
    """Merge the first frame and match all others along the sequence, two frames at a time.

    Parameters
    ----------
    splits : iterable of SplitFrame
        The frames in order; each is let go after the next.
    settings : SegmentationSettings
    tracks : (N, T, 3) float, optional
        Points of the surface that were tracked, metres, world; NaN where not seen. They carry the ellipsoids.

    Raises
    ------
    GeometryError
        If there is no frame, or one has too few points.
    """
    frames, labels, repaired = [], [], []
    current: MatchedFrame | None = None
    carrier = None if tracks is None else Carrier(tracks)
    for number, split in enumerate(splits):
        if current is None:
            current = first_frame(split, settings)
            if carrier is not None:
                carrier.begin(current.ellipsoids.centers, split, current.labels)
            looks = 0
            contacts = np.zeros((len(current.moments),) * 2)
            touching = np.zeros(contacts.shape)
        else:
            guide = None if carrier is None else carrier.guide(split)
            current = match_frame(current, split, settings, number, number % _CONTACTS_EVERY == 0, guide)
            if carrier is not None:
                carrier.adopt(split, current.labels)
        frames.append(current.ellipsoids)
        labels.append(current.labels)
        repaired.append(current.repaired)
        if current.contacts is not None:
            looks += 1
            contacts += current.contacts
            touching += current.contacts > 0
    if current is None:
        raise GeometryError("no frames to segment; the capture or the folder of scans is empty")
    return EllipsoidPaths(
        Ellipsoids.stack(frames),
        tuple(labels),
        contacts / looks,
        touching / looks,
        np.array(repaired, np.int32),
        None if carrier is None else carrier.motion(),
    )
