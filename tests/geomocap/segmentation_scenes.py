"""Point sequences with known rigid parts, for the tests of segmentation and skeleton."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def capsule(rng: np.random.Generator, count: int, start: list[float], end: list[float], radius: float) -> np.ndarray:
    """Points on the surface of a capsule, (count, 3)."""
    a, b = np.array(start, float), np.array(end, float)
    length = np.linalg.norm(b - a)
    axis = (b - a) / length
    across = np.linalg.svd(axis[None])[2][1:]
    along = rng.uniform(-radius, length + radius, count)
    beyond = np.maximum(np.maximum(-along, along - length), 0.0)
    turn = rng.uniform(0, 2 * np.pi, count)
    ring = np.sqrt(radius**2 - beyond**2)[:, None] * (
        np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
    )
    return a + along[:, None] * axis + ring


def hinged_arm(
    frames: int = 24, swing: float = 0.8, count: int = 3000
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Two capsules with a hinge at the origin: one rests along -x, the other swings about z from +x.

    Returns
    -------
    points : list of T arrays (N, 3), metres
        The same surface points in every frame, in the same order.
    part : (N,) int
        0 at rest, 1 swinging.
    angles : (T,) float
        Of the swing since frame 0.
    """
    rng = np.random.default_rng(0)
    rest = capsule(rng, count, [-0.6, 0, 0], [-0.06, 0, 0], 0.05)
    swinging = capsule(rng, count, [0.06, 0, 0], [0.5, 0, 0], 0.05)
    angles = swing * np.sin(np.linspace(0, 2 * np.pi, frames, endpoint=False))
    points = [np.concatenate([rest, Rotation.from_rotvec([0, 0, a]).apply(swinging)]) for a in angles]
    return points, np.repeat([0, 1], count), angles
