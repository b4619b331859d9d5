"""Ellipsoids carried by points that were tracked on the surface: paths that don't slip.

Volumes of several frames are split independently of each other, and so their ellipsoids slide on the surface. What was
tracked doesn't. Each tracked point belongs to the ellipsoid that it was first seen in; the points of an ellipsoid move
it, and tell which pieces of the next frame it may be matched to.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.rotations import rigid_motion
from geomocap.segmentation.ellipsoid_splitting import SplitFrame

_FEWEST = 4  # points by which a motion is known, and one more that checks it
_ASTRAY = 2.5  # times the median miss, beyond which a point went astray; no other value was tried


@dataclass(frozen=True)
class EllipsoidMotion:
    """Rigid motions of K ellipsoids since frame 0.

    Attributes
    ----------
    rotations : (T, K, 3, 3) float
    translations : (T, K, 3) float, metres
        A point p of ellipsoid k in frame 0 is at R p + t in another frame, world axes.
    rest : (K, 3) float, metres
        Centres in frame 0.
    """

    rotations: np.ndarray
    translations: np.ndarray
    rest: np.ndarray

    @property
    def centers(self) -> np.ndarray:
        """Where the motions carry the centres: slip-free paths, (T, K, 3), metres, world."""
        return np.einsum("tkij,kj->tki", self.rotations, self.rest) + self.translations

    def integrals(self) -> np.ndarray:
        """Integrals of the distance curves between relative paths, as each ellipsoid sees the others.

        A relative path of section 7 is a path less its mean; on one rigid body these differ as soon as it turns. Seen
        from an ellipsoid, in its own axes, the path of another one of the same body is a point: the integral, divided
        by the duration, is the mean distance from the mean. Of the two views of a pair the steadier one counts, as
        ellipsoids with few points turn uncertainly.

        Returns
        -------
        (K, K) float, metres
        """
        centers = self.centers
        found = np.empty((len(self.rest), len(self.rest)))
        for k in range(len(self.rest)):
            away = centers - centers[:, k, None]
            seen = np.einsum("tji,tnj->tni", self.rotations[:, k], away)
            found[k] = np.linalg.norm(seen - seen.mean(axis=0), axis=2).mean(axis=0)
        return np.minimum(found, found.T)


@dataclass(frozen=True)
class Guide:
    """What tracked points say of one frame before its pieces are matched.

    Attributes
    ----------
    centers : (K, 3) float, metres, world
        Where they carry the ellipsoids.
    owner : (n,) int
        Ellipsoid of each point that is seen and has one.
    nearest : (n,) int
        The frame's point that is nearest to it.
    """

    centers: np.ndarray
    owner: np.ndarray
    nearest: np.ndarray

    def votes(self, labels: np.ndarray, count: int) -> np.ndarray:
        """Points of each ellipsoid in each of `count` sets of a frame, (K, count); `labels` (N,): set of its points."""
        found = np.zeros((len(self.centers), count))
        np.add.at(found, (self.owner, labels[self.nearest]), 1.0)
        return found


@dataclass
class Carrier:
    """Follows the ellipsoids of a sequence by tracked points, frame by frame.

    Attributes
    ----------
    tracks : (N, T, 3) float, metres, world
        NaN where not seen.
    owner : (N,) int
        Ellipsoid of each track, −1 before it was seen.
    rest : (N, 3) float, metres
        Its place in frame 0, if it moved with its ellipsoid since.
    """

    tracks: np.ndarray
    owner: np.ndarray = field(init=False)
    rest: np.ndarray = field(init=False)
    _centers: np.ndarray = field(init=False)
    _motions: list[tuple[np.ndarray, np.ndarray]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.owner = np.full(len(self.tracks), -1)
        self.rest = np.full((len(self.tracks), 3), np.nan)

    def begin(self, centers: np.ndarray, split: SplitFrame, labels: np.ndarray) -> None:
        """Take the ellipsoids of frame 0: centres (K, 3), metres, and the ellipsoid of each of its points (N,)."""
        self._centers = centers
        self._motions = [(np.tile(np.eye(3), (len(centers), 1, 1)), np.zeros((len(centers), 3)))]
        self.adopt(split, labels)

    def guide(self, split: SplitFrame) -> Guide:
        """Move the ellipsoids to the next frame, and tell what its points are near to."""
        frame = len(self._motions)
        self._motions.append(self._moved(frame))
        rotations, translations = self._motions[-1]
        known = np.flatnonzero(self._seen(frame) & (self.owner >= 0))
        centers = np.einsum("kij,kj->ki", rotations, self._centers) + translations
        return Guide(centers, self.owner[known], _nearest(split, self.tracks[known, frame]))

    def adopt(self, split: SplitFrame, labels: np.ndarray) -> None:
        """Give the tracks that are seen for the first time to the ellipsoids (N,) of the last frame's points."""
        frame = len(self._motions) - 1
        new = np.flatnonzero(self._seen(frame) & (self.owner < 0))
        if not len(new):
            return
        rotations, translations = self._motions[-1]
        at = self.tracks[new, frame]
        owner = labels[_nearest(split, at)].astype(int)
        self.owner[new] = owner
        self.rest[new] = np.einsum("nji,nj->ni", rotations[owner], at - translations[owner])

    def motion(self) -> EllipsoidMotion:
        """The motions of all frames so far."""
        rotations, translations = (np.stack(parts) for parts in zip(*self._motions, strict=True))
        return EllipsoidMotion(rotations, translations, self._centers)

    def _seen(self, frame: int) -> np.ndarray:
        return np.asarray(np.isfinite(self.tracks[:, frame]).all(axis=1))

    def _moved(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Motions since frame 0; an ellipsoid with too few points moves on as the nearest one that has enough."""
        before, shift_before = self._motions[-1]
        rotations, translations = before.copy(), shift_before.copy()
        seen = np.flatnonzero(self._seen(frame) & (self.owner >= 0))
        seen = seen[np.argsort(self.owner[seen], kind="stable")]
        bounds = np.searchsorted(self.owner[seen], np.arange(len(self._centers) + 1))
        followed = np.diff(bounds) >= _FEWEST
        for k in np.flatnonzero(followed):
            points = seen[bounds[k] : bounds[k + 1]]
            rotations[k], translations[k] = _robust_motion(self.rest[points], self.tracks[points, frame])
        if followed.any() and not followed.all():
            places = np.einsum("kij,kj->ki", before, self._centers) + shift_before
            lost, held = np.flatnonzero(~followed), np.flatnonzero(followed)
            leader = held[cKDTree(places[held]).query(places[lost])[1]]
            turn = rotations[leader] @ before[leader].transpose(0, 2, 1)
            rotations[lost] = turn @ before[lost]
            away = shift_before[lost] - shift_before[leader]
            translations[lost] = np.einsum("kij,kj->ki", turn, away) + translations[leader]
        return rotations, translations


def _nearest(split: SplitFrame, places: np.ndarray) -> np.ndarray:
    """Number of the frame's point, as given, nearest to each place (n, 3), metres: (n,) int."""
    if not len(places):
        return np.zeros(0, int)
    return np.asarray(split.order[cKDTree(split.points).query((places - split.origin) / split.spacing)[1]], int)


def _robust_motion(rest: np.ndarray, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rigid motion of points (n, 3) to where they are now, without those that it then misses most."""
    rotation, shift = rigid_motion(rest, now)
    miss = np.linalg.norm(now - rest @ rotation.T - shift, axis=1)
    good = miss <= _ASTRAY * np.median(miss)
    if _FEWEST <= good.sum() < len(good):
        rotation, shift = rigid_motion(rest[good], now[good])
    return rotation, shift
