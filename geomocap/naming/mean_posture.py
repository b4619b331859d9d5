"""The mean posture of a subject: its motion without its way over the ground and its turns about the vertical."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.skeleton import Skeleton
from geomocap.naming.tree_features import PosedTree


@dataclass(frozen=True)
class BodySurface:
    """Points of a subject's surface in the first frame, each with its body.

    Attributes
    ----------
    points : (P, 3) float, metres, world
    bodies : (P,) int
    """

    points: np.ndarray
    bodies: np.ndarray


@dataclass(frozen=True)
class MeanPosture:
    """A subject's mean posture, and what its motion says of the way it faces. Axes: two horizontal ones, and up.

    Attributes
    ----------
    tree : PosedTree
    heading : (2,) float
        Horizontal direction in which the motion goes, with a length of 0 (it says nothing) to 1.
    from_world : (3, 3) float
        Axes of the posture from those of the world: up comes last.
    """

    tree: PosedTree
    heading: np.ndarray
    from_world: np.ndarray


def mean_posture(skeleton: Skeleton, up: int, surface: BodySurface | None = None) -> MeanPosture:
    """Return the mean posture of a skeleton in motion.

    Frames are turned back about the vertical by the mean turn of the bodies, by their surface. (Their places would not
    do: arms and legs that swing against each other look like a turn.)

    Parameters
    ----------
    skeleton : Skeleton
        With at least one joint.
    up : int
        World axis that points up.
    surface : BodySurface, optional
        Without it bodies are as large as their bones are long.
    """
    axes = np.roll(np.eye(3), up - 2, axis=1)  # up last, cyclic order kept
    known = np.isfinite(skeleton.body_rotations).all(axis=(2, 3))
    rotations = axes @ np.where(known[..., None, None], skeleton.body_rotations, 0.0) @ axes.T
    joints, centers = _filled(skeleton.joint_positions) @ axes.T, _filled(skeleton.body_positions) @ axes.T
    lengths, weights = _lengths(skeleton, surface)
    middle = np.einsum("b,tbi->ti", weights, centers)
    turned = np.einsum("tb,tbij->tij", known * weights, rotations)
    turns = _about_up(np.arctan2(turned[:, 0, 1] - turned[:, 1, 0], turned[:, 0, 0] + turned[:, 1, 1]))
    turned = np.concatenate([centers, joints], axis=1) - middle[:, None]
    turned[..., :2] = np.einsum("tij,tkj->tki", turns, turned[..., :2])
    count = skeleton.body_count
    mean = turned.mean(axis=0)
    tree = PosedTree(skeleton.hierarchy, mean[count:], mean[:count], lengths, weights)
    way = np.einsum("tij,tj->ti", turns, np.gradient(middle[:, :2], axis=0)) if len(middle) > 1 else None
    return MeanPosture(tree, _heading(turned[:, :count], way), axes)


def _heading(bodies: np.ndarray, way: np.ndarray | None) -> np.ndarray:
    """Direction of the motion, (2,), with a length from 0 to 1.

    A subject that goes on its way shows it; so does the way of its lowest bodies relative to it: whatever the gait, a
    foot swings forward above the height at which it goes back. The loops' areas, ∮ z dx, are compared with those of
    circles of the same length.

    Parameters
    ----------
    bodies : (T, B, 3) float
        Up last, relative to the subject.
    way : (T, 2) float or None
        What the subject moves in each frame, in the same axes.
    """
    if way is None:
        return np.zeros(2)
    size = float(np.linalg.norm(np.ptp(bodies.reshape(-1, 3), axis=0)))
    travelled = way.sum(axis=0) / max(size, 1e-9)
    low = bodies[:, bodies[..., 2].mean(axis=0) < 0]
    steps = np.diff(low, axis=0)
    height = (low[1:] + low[:-1])[..., 2] / 2 - low[..., 2].mean(axis=0)
    area = np.einsum("tb,tbi->bi", height, steps[..., :2])
    circle = np.linalg.norm(steps, axis=-1).sum(axis=0) ** 2 / (4 * np.pi)
    loops = area.sum(axis=0) / max(float(circle.sum()), 1e-12)
    total = travelled + loops
    return total / max(1.0, float(np.linalg.norm(total)))


def _lengths(skeleton: Skeleton, surface: BodySurface | None) -> tuple[np.ndarray, np.ndarray]:
    """From each joint to the farthest points of its bodies, (B, J), and the bodies' fractions of the surface, (B,)."""
    pairs = skeleton.joint_bodies
    lengths = np.full((skeleton.body_count, len(pairs)), np.nan)
    centers, joints = _filled(skeleton.body_positions)[0], _filled(skeleton.joint_positions)[0]
    for j, both in enumerate(pairs.tolist()):
        for body in both:
            mine = None if surface is None else surface.points[surface.bodies == body]
            if mine is not None and len(mine):
                lengths[body, j] = np.linalg.norm(mine - joints[j], axis=1).max()
            else:
                lengths[body, j] = 2 * np.linalg.norm(centers[body] - joints[j])
    if surface is not None:
        fractions = np.bincount(surface.bodies, minlength=skeleton.body_count).astype(float)
    else:
        fractions = np.nanmax(lengths, axis=1)
    fractions = np.maximum(fractions, max(1e-3 * fractions.sum(), 1e-12))
    return lengths, fractions / fractions.sum()


def _about_up(angles: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def _filled(positions: np.ndarray) -> np.ndarray:
    """Positions (T, N, 3) with gaps filled by the mean over time."""
    known = np.isfinite(positions)
    count = np.maximum(known.sum(axis=0), 1)
    return np.where(known, positions, np.where(known, positions, 0.0).sum(axis=0) / count)
