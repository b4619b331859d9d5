"""What points that were tracked on a known subject say of its motion."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from geomocap.bodies.rigid_motions import fit_rigid_motion
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.rotations import nearest_rotation, turn_angles
from geomocap.scheduling import map_here
from geomocap.skeleton.body_observations import SkinPoints
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, joint_motion
from geomocap.subject.subject_model import SubjectModel
from geomocap.trajectories.completion import complete_tracks

_LOOKS = 5  # frames in which the model's point nearest to a path is asked for
_FILLED = 0.1  # weight of positions filled in by neighbours
_SETTLE_ROUNDS = 3
_LEAST_MEMBERS = 6
_LEAST_SEEN = 3
_AGREEING = 0.35  # radians
_MEAN_ROUNDS = 5


def attach_paths(model: SubjectModel, bodies: BodyMotion, paths: MotionPaths, reach: float) -> SkinPoints:
    """Places and skin weights, at rest, of points that were tracked on the subject.

    The model's points that are nearest in some frames of its life propose weights; those count that carry the point
    along its path best, so that a hand that rests on a hip stays a hand. The place at rest is the median of the
    observations carried back.

    Parameters
    ----------
    model : SubjectModel
    bodies : BodyMotion
        The model's in the sequence.
    paths : MotionPaths
    reach : float, metres
        A point that is farther from the model than this, in the median, follows it at the place of the nearest point.
    """
    skin = model.skin
    seen = paths.seen
    proposed = _nearest_points(skin, bodies, paths)
    rest = np.empty((paths.count, 3))
    nearest = proposed[:, 0].copy()
    least = np.full(paths.count, np.inf)
    target = np.where(seen[..., None], paths.positions, 0.0).swapaxes(0, 1)

    def carried_back(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        owners, fractions = skin.bodies[column], skin.fractions[column]
        matrix, offset = np.zeros((len(bodies.rotations), paths.count, 3, 3)), 0.0
        for k in range(owners.shape[1]):
            matrix += fractions[:, k, None, None] * bodies.rotations[:, owners[:, k]]
            offset = offset + fractions[:, k, None] * bodies.translations[:, owners[:, k]]
        back = np.linalg.solve(matrix, (target - offset)[..., None])[..., 0].swapaxes(0, 1)
        back = np.where(seen[..., None], back, np.nan)
        place = np.nanmedian(back, axis=1)
        spread = np.nanmedian(np.linalg.norm(back - place[:, None], axis=2), axis=1)
        # far from the model's surface is as bad as off the path
        return place, spread + np.linalg.norm(place - skin.rest[column], axis=1)

    for column, (place, cost) in zip(proposed.T, map_here(carried_back, list(proposed.T)), strict=True):
        better = cost < least
        least[better], nearest[better], rest[better] = cost[better], column[better], place[better]
    far = np.linalg.norm(rest - skin.rest[nearest], axis=1) > reach
    return SkinPoints(np.where(far[:, None], skin.rest[nearest], rest), skin.bodies[nearest], skin.fractions[nearest])


def _nearest_points(skin: SkinPoints, bodies: BodyMotion, paths: MotionPaths) -> np.ndarray:
    """The model's points nearest to each path in frames spread over its life, (N, looks) int."""
    asked = np.empty((paths.count, _LOOKS), int)
    for path, row in enumerate(paths.seen):
        frames = np.flatnonzero(row)
        asked[path] = frames[np.linspace(0, len(frames) - 1, _LOOKS).round().astype(int)]
    nearest = np.empty_like(asked)

    def look(t: int) -> None:
        n, k = np.nonzero(asked == t)
        placed = bodies.part(slice(t, t + 1)).carry(skin.rest, skin.bodies, skin.fractions)[0]
        nearest[n, k] = cKDTree(placed).query(paths.positions[n, t])[1]

    map_here(look, np.unique(asked).tolist())
    return nearest


def turned_by_paths(
    linkage: Linkage, motion: JointMotion, bodies: BodyMotion, points: SkinPoints, paths: MotionPaths, noise: float
) -> JointMotion:
    """Motion whose bodies turn from frame to frame as the paths on them do.

    A surface says where a body is, but little of how it rolls about itself; paths say how it turns, but not from where.
    So each body's turns come from its paths, and the constant turn before them is that on which most frames of the
    motion given agree. In frames where a body shows no paths the motion given stays.

    Parameters
    ----------
    linkage : Linkage
    motion, bodies : JointMotion, BodyMotion
        Found from the surface; one is the other's forward kinematics.
    points : SkinPoints
        What each path follows, see `attach_paths`.
    paths : MotionPaths
    noise : float, metres
        Distances below this are all the same.
    """
    positions, certainty = complete_tracks(paths)
    weights = np.where(paths.seen, paths.weights(), _FILLED * certainty)
    rotations = bodies.rotations.copy()
    for b in range(linkage.body_count):
        mine = np.flatnonzero(points.body == b)
        if len(mine) < _LEAST_MEMBERS:
            continue
        rest = positions[mine, 0]
        ray = None if paths.ray is None else paths.ray[mine]
        for _ in range(_SETTLE_ROUNDS):
            turned, moved, _ = fit_rigid_motion(positions[mine], rest, weights[mine], noise, ray=ray)
            back = ((positions[mine] - moved)[:, :, None] @ turned)[:, :, 0]
            rest = (weights[mine, :, None] * back).sum(axis=1) / weights[mine].sum(axis=1)[:, None]
        shown = paths.seen[mine].sum(axis=0)
        told = shown >= _LEAST_SEEN
        if told.any():
            starts = np.swapaxes(turned[told], 1, 2) @ bodies.rotations[told, b]
            rotations[told, b] = turned[told] @ _agreed_rotation(starts, shown[told].astype(float))
    return joint_motion(linkage, rotations, motion.root)


def _agreed_rotation(rotations: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rotation that most of some (n, 3, 3) are near: the one with most others around it, then their robust mean."""
    apart = turn_angles(np.swapaxes(rotations, 1, 2)[:, None] @ rotations[None])
    best = rotations[int(np.argmax(_nearness(apart) @ weights))]
    for _ in range(_MEAN_ROUNDS):
        near = weights * _nearness(turn_angles(best.T @ rotations))
        best = nearest_rotation(np.einsum("n,nij->ij", near, rotations))
    return best


def _nearness(angles: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + (angles / _AGREEING) ** 2) ** 2
