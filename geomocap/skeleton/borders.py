"""Where two bodies touch, and what they share of an axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.model.even_choice import evenly_chosen

_NEAREST = 6  # samples of a body that are on the border in any case
_FRAMES = 10  # looked at
_NEAR = 1.5  # spacings of the samples
_BESIDE = 0.75  # of the narrower body
_SHORT = 2.0 / 3.0  # of its radius
_OUTLIERS = 0.02  # fraction of the places that reach farther


@dataclass(frozen=True)
class Border:
    """Samples of two bodies that stay near the other body.

    Attributes
    ----------
    gap : float, metres
        Lasting distance of the bodies beyond that of neighbouring samples.
    sides : two (n, 3) float, metres, world
        Places in frame 0 of the samples of each body that are on the border.
    bodies : two (n, 3) float, metres, world
        Places in frame 0 of all samples of each body.
    """

    gap: float
    sides: tuple[np.ndarray, np.ndarray]
    bodies: tuple[np.ndarray, np.ndarray]

    @property
    def middle(self) -> np.ndarray:
        """Middle of the border, (3,), metres, world, frame 0."""
        return 0.5 * (self.sides[0].mean(axis=0) + self.sides[1].mean(axis=0))

    @property
    def spread(self) -> float:
        """Root mean square distance of the border's samples from its middle, metres."""
        return float(np.sqrt(((np.concatenate(self.sides) - self.middle) ** 2).sum(axis=1).mean()))

    def middle_along(self, point: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Where on a hinge's axis the joint is, (3,), metres: the motion leaves that open, the bodies' shapes say it.

        Where the bodies lie side by side along most of the narrower one, as a lid and its box or thigh and shank do,
        the joint is in the middle of what they share. Otherwise one begins where the other ends: if the smaller one is
        short along the axis against its radius, as a wheel or an upper arm, it turns about its own middle; a shaft, a
        turret or a head goes on along the axis, and the joint is where it is borne, at the border.
        """
        ends = [_reach(body, point, axis) for body in self.bodies]
        low, high = max(e[0] for e in ends), min(e[1] for e in ends)
        lengths = [e[1] - e[0] for e in ends]
        if high - low >= _BESIDE * min(lengths):
            return point + 0.5 * (low + high) * axis
        smaller = int(len(self.bodies[1]) < len(self.bodies[0]))
        if lengths[smaller] < _SHORT * _radius(self.bodies[smaller], point, axis):
            return point + 0.5 * sum(ends[smaller]) * axis
        return point + ((self.middle - point) @ axis) * axis


def _reach(places: np.ndarray, point: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """From where to where places reach along an axis, metres from the point; a few outliers apart."""
    low, high = np.quantile((places - point) @ axis, (_OUTLIERS, 1.0 - _OUTLIERS))
    return float(low), float(high)


def _radius(places: np.ndarray, point: np.ndarray, axis: np.ndarray) -> float:
    """How far places reach from an axis, metres; a few outliers apart."""
    return float(np.quantile(np.linalg.norm(np.cross(places - point, axis), axis=1), 1.0 - _OUTLIERS))


def find_borders(bodies: MotionBodies, limit: float) -> dict[tuple[int, int], Border]:
    """Borders of all pairs of bodies whose samples stay within a distance.

    A sample is on the border if it stays near the other body, though perhaps not near the same sample of it: a shaft
    that turns in its bearing touches it all around.

    Parameters
    ----------
    bodies : MotionBodies
    limit : float, metres

    Returns
    -------
    dict
        For each pair of bodies, the lower number first.
    """
    count = bodies.body_count
    apart = bodies.lasting + np.diag(np.full(len(bodies.lasting), np.inf, np.float32))
    spacing = float(np.median(apart.min(axis=1)))
    members = [np.flatnonzero(bodies.label == b) for b in range(count)]
    looked_at = evenly_chosen(bodies.positions.shape[1], _FRAMES)
    moved = [bodies.positions[m][:, looked_at] for m in members]
    trees = [[cKDTree(part[:, f]) for f in range(len(looked_at))] for part in moved]
    borders = {}
    for a in range(count):
        for b in range(a + 1, count):
            if bodies.lasting[np.ix_(members[a], members[b])].min() > limit:
                continue
            sides, nearest = [], []
            for one, other in ((a, b), (b, a)):
                distances = np.stack([trees[other][f].query(moved[one][:, f])[0] for f in range(len(looked_at))])
                lasting = np.sort(distances, axis=0)[-2 if len(looked_at) > 5 else -1]
                few = np.sort(lasting)[: min(_NEAREST, len(lasting))]
                sides.append(bodies.rest[members[one][lasting <= max(float(few[-1]), _NEAR * spacing)]])
                nearest.append(float(few[:3].mean()))
            gap = max(min(nearest) - 2.0 * spacing, 0.0)
            both = bodies.rest[members[a]], bodies.rest[members[b]]
            borders[a, b] = Border(gap, (sides[0], sides[1]), both)
    return {pair: border for pair, border in borders.items() if border.gap <= limit}


def contacts(bodies: MotionBodies) -> np.ndarray:
    """Neighbouring pairs of samples between each two bodies, (B, B) float; the diagonal is 0."""
    rows, columns = bodies.adjacency.nonzero()
    result = np.zeros((bodies.body_count, bodies.body_count))
    np.add.at(result, (bodies.label[rows], bodies.label[columns]), 1)
    np.fill_diagonal(result, 0)
    return result
