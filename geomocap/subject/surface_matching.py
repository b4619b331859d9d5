"""Which points of a posed surface and of a frame's geometry belong together: nearest in place, normal and colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.surface import outward_normals
from geomocap.scheduling import map_here
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.subject.subject_model import SubjectModel

SOUGHT = 4  # points of a frame among which the model looks for its own, times those that look for the model
_LEAST_OF_BODY = 25
_SAME_SIDE = 0.2  # cosine of the normals' angle


@dataclass(frozen=True)
class MatchingScales:
    """How places, normals and colours weigh against each other.

    Attributes
    ----------
    normal : float, metres
        Distance that counts as much as normals at right angles, times √2.
    color : float, metres
        Distance that counts as much as black against one full primary colour.
    reach : float, metres
        Farther points don't belong together.
    sigma : float, metres
        Standard deviation of a surface point across the surface.
    along : float
        Weight of distances along the surface, as a fraction of that across it.
    independence : float
        Fraction of the points that err independently of each other.
    """

    normal: float
    color: float
    reach: float
    sigma: float
    along: float
    independence: float


@dataclass(frozen=True)
class OrientedPoints:
    """Points of a surface with outward normals and, perhaps, colours.

    Attributes
    ----------
    points : (N, 3) float, metres
    normals : (N, 3) float
    colors : (N, 3) float, 0 to 1, optional
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray | None = None

    def part(self, chosen: np.ndarray) -> OrientedPoints:
        """Some of the points."""
        colors = None if self.colors is None else self.colors[chosen]
        return OrientedPoints(self.points[chosen], self.normals[chosen], colors)

    def features(self, scales: MatchingScales) -> np.ndarray:
        """Coordinates in which near points belong together."""
        parts = [self.points, scales.normal * self.normals]
        if self.colors is not None and scales.color > 0:
            parts.append(scales.color * self.colors)
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class FrameSurface:
    """A frame's surface, ready to be asked for nearest points.

    Attributes
    ----------
    points : (N, 3) float, metres
    sought : OrientedPoints
        A part of the points, spread over all, among which points of the model look for their nearest.
    tree : cKDTree
        Of its features.
    some : OrientedPoints
        A part of the points, spread over all, that looks for its own nearest points of the model.
    """

    points: np.ndarray
    sought: OrientedPoints
    tree: cKDTree
    some: OrientedPoints

    @classmethod
    def of_points(
        cls, points: np.ndarray, colors: np.ndarray | None, spacing: float, scales: MatchingScales, count: int
    ) -> FrameSurface:
        """Prepare the points of a frame; `count` of them look for the model, which looks for `SOUGHT` times as many."""
        order = np.random.default_rng(0).permutation(len(points))
        rows = np.sort(order[: SOUGHT * count])
        sought = OrientedPoints(points[rows], outward_normals(points, rows), None if colors is None else colors[rows])
        some = sought.part(np.isin(rows, order[:count]))
        return cls(points, sought, cKDTree(sought.features(scales)), some)


@dataclass(frozen=True)
class ModelSurface:
    """Some points of a model's surface, spread over all of its bodies.

    Attributes
    ----------
    skin : SkinPoints
    normals : (N, 3) float
        At rest.
    colors : (N, 3) float, 0 to 1, optional
    """

    skin: SkinPoints
    normals: np.ndarray
    colors: np.ndarray | None

    @classmethod
    def of_model(cls, model: SubjectModel, count: int, with_colors: bool) -> ModelSurface:
        """Choose about `count` points, and at least a few of each body."""
        rng = np.random.default_rng(0)
        chosen = []
        for b in range(model.body_count):
            members = np.flatnonzero(model.skin.body == b)
            wanted = max(_LEAST_OF_BODY, round(count * len(members) / len(model.points)))
            chosen.append(rng.permutation(members)[:wanted])
        some = np.sort(np.concatenate(chosen))
        skin = SkinPoints(model.points[some], model.skin_bodies[some], model.skin_weights[some])
        colors = model.colors[some] / 255.0 if with_colors and len(model.colors) else None
        return cls(skin, model.normals[some], colors)

    def posed(self, bodies: BodyMotion) -> list[OrientedPoints]:
        """The surface in each frame."""
        skin = self.skin
        places = bodies.carry(skin.rest, skin.bodies, skin.fractions)
        turned = np.einsum("tnij,nj->tni", bodies.rotations[:, skin.body], self.normals)
        return [OrientedPoints(p, n, self.colors) for p, n in zip(places, turned, strict=True)]


def match_surfaces(
    model: ModelSurface, posed: Sequence[OrientedPoints], frames: Sequence[FrameSurface], scales: MatchingScales
) -> Observations:
    """Observations of the model's points on the frames' surfaces, and of the frames' points on the model.

    Both directions: every point of the model looks for its nearest in the frame, and points of the frame for theirs on
    the model, so that neither is left uncovered. Distances across the surface count, those along it a little.

    Parameters
    ----------
    model : ModelSurface
    posed : sequence of OrientedPoints
        The model in each frame.
    frames : sequence of FrameSurface
    scales : MatchingScales
    """
    pairs = list(zip(posed, frames, strict=True))
    return Observations.of_frames(map_here(lambda pair: _match(*pair, scales), pairs))


def _match(posed: OrientedPoints, frame: FrameSurface, scales: MatchingScales) -> tuple[np.ndarray, ...]:
    features = posed.features(scales)
    nearest = frame.tree.query(features)[1]
    back = cKDTree(features).query(frame.some.features(scales))[1]
    point = np.concatenate([np.arange(len(features)), back])
    target = np.concatenate([frame.sought.points[nearest], frame.some.points])
    normal = np.concatenate([frame.sought.normals[nearest], frame.some.normals])
    away = np.linalg.norm(posed.points[point] - target, axis=1)
    together = (away < scales.reach) & (np.einsum("ni,ni->n", posed.normals[point], normal) > _SAME_SIDE)
    weight = np.full(int(together.sum()), scales.independence / scales.sigma**2)
    return point[together], target[together], normal[together], scales.along * weight, weight


def misfit(posed: OrientedPoints, frame: FrameSurface, scales: MatchingScales) -> float:
    """Distance of two surfaces in place, normal and colour: root mean square over both directions, at most `reach`."""
    features = posed.features(scales)
    there = frame.tree.query(features)[0]
    back = cKDTree(features).query(frame.some.features(scales))[0]
    squares = [np.minimum(d, scales.reach) ** 2 for d in (there, back)]
    return float(np.sqrt(0.5 * (squares[0].mean() + squares[1].mean())))


def distance_between(posed: OrientedPoints, frame: FrameSurface) -> float:
    """Distance of two surfaces, metres: root mean square of the nearest points' distances, both directions."""
    there = cKDTree(frame.points).query(posed.points)[0]
    back = cKDTree(posed.points).query(frame.some.points)[0]
    return float(np.sqrt(0.5 * ((there**2).mean() + (back**2).mean())))
