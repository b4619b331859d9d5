"""Bodies of arbitrary points, as voxels, from the bodies of the samples."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.point_grid import PointGrid
from geomocap.model.surface import plane_normals

_VOTERS = 12
_LEAST_VOTES = 0.05  # fraction of all, of a body that is proposed
_NEAREST = 3
_PLANE = 8
_THICKNESS = 0.7
_CHUNK = 65536


def label_points(bodies: MotionBodies, paths: MotionPaths, frame: int, points: np.ndarray) -> np.ndarray:
    """Body of each point of a frame.

    The nearest samples of the frame propose bodies, with votes by distance. A body that is proposed must also fit: the
    point is carried back to frame 0 by the body's motion, and its distance from the body's own samples there, and still
    more from the surface through them, counts against it. A hand at rest on a hip gets few votes inside the hip, and
    points beside it do not fit the hand's shape.

    Parameters
    ----------
    bodies : MotionBodies
    paths : MotionPaths
        From which the bodies were found; samples that are not seen in the frame vote less.
    frame : int
    points : (M, 3) float, metres, world

    Returns
    -------
    (M,) int32
    """
    points = np.asarray(points, float).reshape(-1, 3)
    if not len(points) or not bodies.body_count:
        return np.full(len(points), -1, np.int32)
    samples = bodies.positions[:, frame]
    trust = np.where(paths.seen[:, frame], 1.0, 0.3)
    spacing = float(np.median(PointGrid.of(bodies.rest).query(bodies.rest, 2)[0][:, 1]))
    shapes = [PointGrid.of(bodies.rest[bodies.label == b]) for b in range(bodies.body_count)]
    # of either side
    planes = [shape.query(shape.data, min(_PLANE, shape.n))[1].reshape(shape.n, -1) for shape in shapes]
    normals = [plane_normals(shape.data, near) for shape, near in zip(shapes, planes, strict=True)]
    grid = PointGrid.of(samples)
    parts = [
        _label_some(bodies, frame, points[i : i + _CHUNK], grid, trust, shapes, normals, spacing)
        for i in range(0, len(points), _CHUNK)
    ]
    return np.concatenate(parts)


def _label_some(
    bodies: MotionBodies,
    frame: int,
    points: np.ndarray,
    grid: PointGrid,
    trust: np.ndarray,
    shapes: list[PointGrid],
    normals: list[np.ndarray],
    spacing: float,
) -> np.ndarray:
    voters = min(_VOTERS, grid.n)
    distances, nearest = grid.query(points, voters)
    distances, nearest = distances.reshape(len(points), voters), nearest.reshape(len(points), voters)
    votes = trust[nearest] / (distances**2 + (0.5 * spacing) ** 2)
    rows = np.arange(0, votes.size + 1, voters)
    score = csr_matrix((votes.ravel(), nearest.ravel(), rows), (len(points), grid.n)) @ bodies.weights
    score /= score.sum(axis=1, keepdims=True)
    score[score <= _LEAST_VOTES] = 0.0
    doubtful = (score > 0).sum(axis=1) > 1
    for b in range(bodies.body_count):
        proposed = np.flatnonzero(doubtful & (score[:, b] > 0))
        if not len(proposed):
            continue
        back = (points[proposed] - bodies.translations[frame, b]) @ bodies.rotations[frame, b]
        k = min(_NEAREST, shapes[b].n)
        distances, nearest = shapes[b].query(back, k)
        distances, nearest = distances.reshape(len(back), k), nearest.reshape(len(back), k)
        offsets = back[:, None] - shapes[b].data[nearest]
        above = np.abs(np.einsum("mkc,mkc->mk", offsets, normals[b][nearest])).mean(axis=1)
        misfit = (distances.mean(axis=1) / (2.0 * spacing)) ** 2 + (above / (_THICKNESS * spacing)) ** 2
        score[proposed, b] *= 1.0 / (1.0 + misfit)
    return score.argmax(axis=1).astype(np.int32)
