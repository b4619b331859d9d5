"""The subject's own model from a sequence: a surface that many frames agree on, limits and poses seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.errors import GeometryError
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.surface import outward_normals
from geomocap.skeleton.body_observations import INFLUENCES, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.skeleton.motion_skeleton import MotionSkeleton
from geomocap.subject.subject_model import SubjectModel, rotation_limits

FRAMES = 12  # that have a say in the surface
AGREEING = 0.5  # fraction of the frames that must show a point
CELL = 2.0  # of the grid in which points of several frames are one; spacings
KEY_POSES = 8
_SKIN_VOTERS = 4
_LEAST_POINTS = 50


@dataclass(frozen=True)
class BodyCloud:
    """Points of one frame and the bodies that they belong to.

    Attributes
    ----------
    points : (N, 3) float, metres, world
    body : (N,) int
        -1: none.
    colors : (N, 3) float, 0 to 1, optional
    """

    points: np.ndarray
    body: np.ndarray
    colors: np.ndarray | None = None


def build_model(
    found: MotionSkeleton,
    bodies: MotionBodies,
    read: Callable[[int], BodyCloud],
    spacing: float,
    up: int = 2,
) -> SubjectModel:
    """Make the model of a subject from its (refined) skeleton, bodies, and the geometry of its frames.

    Every body's points of several frames are carried back to rest; a place is on the surface if at least half of the
    frames show it, so that what a single frame's hull invents is left out.

    Parameters
    ----------
    found : MotionSkeleton
    bodies : MotionBodies
        Samples with skin weights.
    read : callable
        `read(frame) -> BodyCloud`.
    spacing : float, metres
        Distance of neighbouring points.
    up : int
        World axis that points up, 0 to 2.

    Raises
    ------
    GeometryError
        If the frames agree on no surface.
    """
    frames = len(bodies.rotations)
    chosen = evenly_chosen(frames, FRAMES)
    motion = BodyMotion(bodies.rotations, bodies.translations)
    points, normals, colors, body = _agreed_surface([read(int(t)) for t in chosen], chosen, motion, spacing)
    if len(points) < _LEAST_POINTS:
        raise GeometryError(f"model: the frames agree on {len(points)} surface points only; no model can be made")
    skin = _skin_of(points, body, bodies)
    return _model(found, points, normals, colors, skin, float(spacing * CELL), up)


def rebuilt_model(before: SubjectModel, found: MotionSkeleton, points: np.ndarray, normals: np.ndarray) -> SubjectModel:
    """Return a model with another skeleton of its bodies, and its surface elsewhere: (P, 3) at rest, metres."""
    skin = SkinPoints(points, before.skin_bodies, before.skin_weights)
    return _model(found, points, normals, before.colors, skin, before.spacing, before.up)


def _model(
    found: MotionSkeleton,
    points: np.ndarray,
    normals: np.ndarray,
    colors: np.ndarray,
    skin: SkinPoints,
    spacing: float,
    up: int,
) -> SubjectModel:
    skeleton = found.skeleton
    bodies = len(skeleton.body_names)
    return SubjectModel(
        points,
        normals,
        colors,
        skin.bodies,
        skin.fractions,
        skeleton.joint_positions[0],
        skeleton.joint_bodies,
        np.array([joint.axis for joint in found.joints]).reshape(-1, 3),
        np.array([joint.hinge for joint in found.joints], dtype=bool),
        rotation_limits(skeleton.local_rotations[:, skeleton.joint_bodies[:, 1]]),
        skeleton.joint_names,
        skeleton.body_names,
        skeleton.root,
        skeleton.body_positions[0, skeleton.root],
        np.stack([_extents(points[skin.body == b]) for b in range(bodies)]),
        skeleton.local_rotations[key_poses(skeleton.local_rotations)],
        float(np.linalg.norm(np.ptp(points, axis=0))),
        spacing,
        up,
    )


def _agreed_surface(
    clouds: list[BodyCloud], frames: np.ndarray, motion: BodyMotion, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals, colours and bodies of what the frames agree on, at rest."""
    outward = [outward_normals(c.points) for c in clouds]
    size = CELL * spacing
    parts: list[tuple[np.ndarray, ...]] = []
    for b in range(motion.rotations.shape[1]):
        carried, turned, tints, source = [], [], [], []
        for k, (cloud, normals, t) in enumerate(zip(clouds, outward, frames, strict=True)):
            mine = cloud.body == b
            rotation = motion.rotations[t, b]
            carried.append((cloud.points[mine] - motion.translations[t, b]) @ rotation)
            turned.append(normals[mine] @ rotation)
            tints.append(np.zeros((mine.sum(), 3)) if cloud.colors is None else cloud.colors[mine])
            source.append(np.full(int(mine.sum()), k))
        place, normal = np.concatenate(carried), np.concatenate(turned)
        if not len(place):
            continue
        tint = np.concatenate(tints)
        cells, inverse = np.unique(np.floor(place / size).astype(np.int64), axis=0, return_inverse=True)
        inverse = inverse.ravel()
        count = np.bincount(inverse, minlength=len(cells))[:, None]
        middle, mean_normal, mean_tint = (_sums(inverse, v, len(cells)) / count for v in (place, normal, tint))
        showing = [cKDTree(c).query(middle)[0] < size if len(c) else np.zeros(len(cells), bool) for c in carried]
        filled = [len(c) > 0 for c in carried]
        agreed = np.sum(showing, axis=0) >= max(1.0, AGREEING * sum(filled))
        length = np.linalg.norm(mean_normal, axis=1)
        agreed &= length > 0.3
        parts.append(
            (middle[agreed], mean_normal[agreed] / length[agreed, None], mean_tint[agreed], np.full(agreed.sum(), b))
        )
    points, directions, colored, body = (np.concatenate([p[i] for p in parts]) for i in range(4))
    colors = np.rint(255 * colored).astype(np.uint8) if clouds[0].colors is not None else np.zeros((0, 3), np.uint8)
    return points, directions, colors, body.astype(int)


def _sums(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    return np.stack([np.bincount(index, values[:, i], count) for i in range(values.shape[1])], axis=1)


def _skin_of(points: np.ndarray, body: np.ndarray, bodies: MotionBodies) -> SkinPoints:
    """Skin weights of surface points from those of the nearest samples of their own body."""
    weights = np.zeros((len(points), bodies.body_count))
    for b in np.unique(body):
        members = np.flatnonzero(bodies.label == b)
        mine = np.flatnonzero(body == b)
        k = min(_SKIN_VOTERS, len(members))
        distance, nearest = cKDTree(bodies.rest[members]).query(points[mine], k)
        distance, nearest = distance.reshape(len(mine), k), nearest.reshape(len(mine), k)
        fraction = 1.0 / np.maximum(distance, 1e-6)
        fraction /= fraction.sum(axis=1, keepdims=True)
        weights[mine] = np.einsum("nk,nkb->nb", fraction, bodies.weights[members[nearest]])
    skin = SkinPoints.of_weights(points, weights)
    missing = INFLUENCES - skin.bodies.shape[1]
    return SkinPoints(
        points, np.pad(skin.bodies, ((0, 0), (0, missing))), np.pad(skin.fractions, ((0, 0), (0, missing)))
    )


def _extents(points: np.ndarray) -> np.ndarray:
    if len(points) < 4:
        return np.zeros(3)
    away = points - points.mean(axis=0)
    return np.ptp(away @ np.linalg.eigh(away.T @ away)[1][:, ::-1], axis=0)


def key_poses(local: np.ndarray, count: int = KEY_POSES) -> np.ndarray:
    """Frames whose poses (T, B, 3, 3) differ most, (K,) int: each the farthest from those before it."""
    flat = local.reshape(len(local), -1)
    chosen = [0]
    distance = np.linalg.norm(flat - flat[0], axis=1)
    while len(chosen) < min(count, len(local)):
        farthest = int(distance.argmax())
        if distance[farthest] < 1e-3:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(flat - flat[farthest], axis=1))
    return np.array(chosen)
