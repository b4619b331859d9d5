"""Where two bodies touch, and what they share of an axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geomocap.segmentation.motion_bodies import MotionBodies
from geomocap.segmentation.surface_graph import frames_looked_at

_NEAREST = 6
_FRAMES = 10
_NEAR = 1.5  # spacings of the samples


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
    spacing : float, metres
        Lasting distance of neighbouring samples.
    """

    gap: float
    sides: tuple[np.ndarray, np.ndarray]
    bodies: tuple[np.ndarray, np.ndarray]
    spacing: float

    @property
    def middle(self) -> np.ndarray:
        """Middle of the border, (3,), metres, world, frame 0."""
        return 0.5 * (self.sides[0].mean(axis=0) + self.sides[1].mean(axis=0))

    def middle_along(self, point: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Point of an axis in the middle of the part that both bodies reach along it, (3,), metres.

        Of a hinge across the bodies, as of a lid, that is the middle of the narrower one; but a shaft or a turntable
        goes on along its axis, away from where it is borne: there the border alone counts.
        """
        border = _common_part([(side - point) @ axis for side in self.sides])
        whole = _common_part([(body - point) @ axis for body in self.bodies])
        low, high = whole if np.abs(np.subtract(whole, border)).max() <= 2.0 * _NEAR * self.spacing else border
        return point + 0.5 * (low + high) * axis


def _common_part(along: list[np.ndarray]) -> tuple[float, float]:
    return max(float(a.min()) for a in along), min(float(a.max()) for a in along)


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
    looked_at = frames_looked_at(bodies.positions.shape[1], _FRAMES)
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
            borders[a, b] = Border(gap, (sides[0], sides[1]), both, spacing)
    return {pair: border for pair, border in borders.items() if border.gap <= limit}


def contacts(bodies: MotionBodies) -> np.ndarray:
    """Neighbouring pairs of samples between each two bodies, (B, B) float; the diagonal is 0."""
    rows, columns = bodies.adjacency.nonzero()
    result = np.zeros((bodies.body_count, bodies.body_count))
    np.add.at(result, (bodies.label[rows], bodies.label[columns]), 1)
    np.fill_diagonal(result, 0)
    return result
