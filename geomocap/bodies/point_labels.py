"""Bodies of arbitrary points, as voxels, from points of the surface that were followed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from geomocap.bodies.body_settings import FOLLOWED
from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.errors import GeometryError
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.point_grid import PointGrid
from geomocap.model.surface import plane_normals

_VOTERS = 12
LEAST_VOTES = 0.05
"""Fraction of all votes, of a body that is proposed."""
_UNSEEN = 0.3  # of a vote: a sample that is not seen in the frame, but filled in
_NEAREST = 3
_PLANE = 8
_THICKNESS = 0.7
_CHUNK = 65536


@dataclass(frozen=True)
class Voters:
    """V points of the surface whose bodies are known, followed over T frames: they say what is around them.

    Attributes
    ----------
    positions : (V, T, 3) float32, metres, world
        NaN where a point is not there.
    seen : (V, T) bool
        Where it was measured, not filled in; its vote counts less elsewhere.
    weights : (V, B) float
        Skin weights.
    rotations, translations
        Of the bodies, as in `MotionBodies`.
    shapes : tuple of B PointGrid
        The points of each body in frame 0.
    normals : tuple of B (n, 3) float
        Of the surface through these, of either side.
    spacing : float, metres
        Distance of neighbouring points.
    """

    positions: np.ndarray
    seen: np.ndarray
    weights: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    shapes: tuple[PointGrid, ...]
    normals: tuple[np.ndarray, ...]
    spacing: float

    @classmethod
    def of(cls, bodies: MotionBodies, paths: MotionPaths) -> Voters:
        """The samples from which bodies were found."""
        return cls._of(bodies, bodies.positions, paths.seen, bodies.weights, bodies.rest, bodies.label)

    @classmethod
    def with_tracks(
        cls, bodies: MotionBodies, paths: MotionPaths, tracks: np.ndarray, labels: np.ndarray, rest: np.ndarray
    ) -> Voters:
        """The samples, and tracks (N, T, 3), NaN where unseen, of bodies (N,) int, −1: none, at `rest` in frame 0."""
        some = np.flatnonzero(labels >= 0)
        own = np.eye(bodies.body_count)[labels[some]]
        return cls._of(
            bodies,
            np.concatenate([bodies.positions, tracks[some]], dtype=np.float32),
            np.concatenate([paths.seen, np.isfinite(tracks[some, :, 0])]),
            np.concatenate([bodies.weights, own]),
            np.concatenate([bodies.rest, rest[some]]),
            np.concatenate([bodies.label, labels[some]]),
        )

    @classmethod
    def _of(
        cls,
        bodies: MotionBodies,
        positions: np.ndarray,
        seen: np.ndarray,
        weights: np.ndarray,
        rest: np.ndarray,
        label: np.ndarray,
    ) -> Voters:
        alike = FOLLOWED * float(np.linalg.norm(np.ptp(rest, axis=0)))  # voters may lie on one another
        places = rest[np.unique(np.rint(rest / max(alike, 1e-12)), axis=0, return_index=True)[1]]
        spacing = float(np.median(PointGrid.of(places).query(places, 2)[0][:, 1]))
        shapes = tuple(PointGrid.of(rest[label == b]) for b in range(bodies.body_count))
        planes = [shape.query(shape.data, min(_PLANE, shape.n))[1].reshape(shape.n, -1) for shape in shapes]
        normals = tuple(plane_normals(shape.data, near) for shape, near in zip(shapes, planes, strict=True))
        positions = positions.astype(np.float32, copy=False)
        return cls(positions, seen, weights, bodies.rotations, bodies.translations, shapes, normals, spacing)

    def votes(self, frame: int, points: np.ndarray) -> np.ndarray:
        """Votes for the body of each point (M, 3) of a frame, by those nearest to it: (M, B), rows sum to 1."""
        there = np.flatnonzero(np.isfinite(self.positions[:, frame, 0]))
        grid = PointGrid.of(self.positions[there, frame].astype(float))
        voters = min(_VOTERS, grid.n)
        distances, nearest = grid.query(points, voters)
        distances, nearest = distances.reshape(len(points), voters), nearest.reshape(len(points), voters)
        trust = np.where(self.seen[there, frame], 1.0, _UNSEEN)
        votes = trust[nearest] / (distances**2 + (0.5 * self.spacing) ** 2)
        rows = np.arange(0, votes.size + 1, voters)
        score = csr_matrix((votes.ravel(), nearest.ravel(), rows), (len(points), grid.n)) @ self.weights[there]
        return score / score.sum(axis=1, keepdims=True)


def label_points(voters: Voters, frame: int, points: np.ndarray) -> np.ndarray:
    """Body of each point of a frame.

    The nearest voters of the frame propose bodies, with votes by distance. A body that is proposed must also fit: the
    point is carried back to frame 0 by the body's motion, and its distance from the body's own points there, and still
    more from the surface through them, counts against it. A hand at rest on a hip gets few votes inside the hip, and
    points beside it do not fit the hand's shape.

    Parameters
    ----------
    voters : Voters
    frame : int
    points : (M, 3) float, metres, world

    Returns
    -------
    (M,) int32

    Raises
    ------
    GeometryError
        If there is no such frame, or the points have another shape or aren't finite.
    """
    points, frames = np.asarray(points, float), voters.positions.shape[1]
    if not 0 <= frame < frames:
        raise GeometryError(f"frame {frame}: there are frames 0 to {frames - 1}")
    if (points.size and points.shape[-1:] != (3,)) or points.ndim > 2 or not np.isfinite(points).all():
        raise GeometryError(f"points have shape {points.shape}, expected (M, 3), metres, finite")
    points = points.reshape(-1, 3)
    if not len(points) or not len(voters.shapes):
        return np.full(len(points), -1, np.int32)
    parts = [_label_some(voters, frame, points[i : i + _CHUNK]) for i in range(0, len(points), _CHUNK)]
    return np.concatenate(parts)


def _label_some(voters: Voters, frame: int, points: np.ndarray) -> np.ndarray:
    score = voters.votes(frame, points)
    score[score <= LEAST_VOTES] = 0.0
    doubtful = (score > 0).sum(axis=1) > 1
    for b, (shape, normals) in enumerate(zip(voters.shapes, voters.normals, strict=True)):
        proposed = np.flatnonzero(doubtful & (score[:, b] > 0))
        if not len(proposed):
            continue
        back = (points[proposed] - voters.translations[frame, b]) @ voters.rotations[frame, b]
        k = min(_NEAREST, shape.n)
        distances, nearest = shape.query(back, k)
        distances, nearest = distances.reshape(len(back), k), nearest.reshape(len(back), k)
        offsets = back[:, None] - shape.data[nearest]
        above = np.abs(np.einsum("mkc,mkc->mk", offsets, normals[nearest])).mean(axis=1)
        misfit = (distances.mean(axis=1) / (2.0 * voters.spacing)) ** 2 + (above / (_THICKNESS * voters.spacing)) ** 2
        score[proposed, b] *= 1.0 / (1.0 + misfit)
    return score.argmax(axis=1).astype(np.int32)
