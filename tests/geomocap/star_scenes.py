"""A made-up star of five limbs that bend one against the other: known motion of every point of its surface."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.nodes.node_tracking import NodeTracks

LIMBS = np.array([[1.0, 0, 0.3], [-1, 0.2, 0.3], [0.4, 0, -1], [-0.4, 0, -1], [0, 0.1, 1]])
LIMBS /= np.linalg.norm(LIMBS, axis=1, keepdims=True)
LENGTH, RADIUS, TRUNK = 0.6, 0.07, 0.2


def rest_points(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the star at rest (count, 3), metres, and their limb (count,), −1: trunk."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(4 * count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    along = rng.uniform(0.5 * TRUNK, TRUNK + LENGTH, 4 * count)
    limb = rng.integers(-1, len(LIMBS), 4 * count)
    axis = LIMBS[np.maximum(limb, 0)]
    around = d - (d * axis).sum(axis=1, keepdims=True) * axis
    around *= RADIUS / np.linalg.norm(around, axis=1, keepdims=True)
    points = np.where((limb < 0)[:, None], TRUNK * d, around + along[:, None] * axis)
    # limbs end in half spheres
    tip = (limb >= 0) & (along > TRUNK + LENGTH - RADIUS * 0.7)
    outward = np.where(((d * axis).sum(axis=1) < 0)[:, None], -d, d)
    points[tip] = (TRUNK + LENGTH - RADIUS) * axis[tip] + RADIUS * outward[tip]
    inside = (limb >= 0) & (np.linalg.norm(points, axis=1) < TRUNK)
    for k, a in enumerate(LIMBS):
        t = points @ a
        inside |= (limb != k) & (t > 0) & (np.linalg.norm(points - t[:, None] * a, axis=1) < RADIUS)
    chosen = np.flatnonzero(~inside)[:count]
    return points[chosen], limb[chosen]


def pose(points: np.ndarray, limb: np.ndarray, phase: float) -> np.ndarray:
    """Points at rest (N, 3) with each limb bent in its middle, smoothly over 10 cm, at a phase between 0 and 1."""
    out = points.copy()
    middle = TRUNK + LENGTH / 2
    for k, a in enumerate(LIMBS):
        own = limb == k
        fraction = np.clip((points[own] @ a - middle + 0.05) / 0.1, 0, 1)
        angle = 0.9 * np.sin(2 * np.pi * phase + k) * fraction
        axis = np.cross(a, [0.1, 1.0, 0.2])
        R = Rotation.from_rotvec(angle[:, None] * axis / np.linalg.norm(axis)).as_matrix()
        out[own] = np.einsum("nij,nj->ni", R, points[own] - middle * a) + middle * a
    return out


def star_points(phase: float, count: int, seed: int) -> np.ndarray:
    """The star's surface in one frame, sampled afresh (count, 3), metres."""
    points, limb = rest_points(count, seed)
    return pose(points, limb, phase)


def star_truth(tracks: NodeTracks, n_frames: int) -> np.ndarray:
    """Distance of each node from the point of the surface it began on (N, T), metres."""
    points, limb = rest_points(60000, 1000)
    reference = pose(points, limb, tracks.reference_frame / n_frames)
    at = cKDTree(reference).query(tracks.reference)[1]
    truth = np.stack([pose(points[at], limb[at], t / n_frames) for t in range(n_frames)], axis=1)
    return np.linalg.norm(tracks.positions - truth, axis=-1)
