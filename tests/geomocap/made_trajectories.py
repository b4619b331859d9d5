"""Trajectories that move as told: points of rigid bodies, with gaps and faults where a test wants them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.model.trajectories import Trajectories


def rigid_tracks(
    points: np.ndarray, n_frames: int, shift: np.ndarray, turn_deg: np.ndarray, noise: float = 0.0
) -> Trajectories:
    """Points (N, 3) that shift (m) and turn (degrees, rotation vector) by the same amount from frame to frame."""
    turns = Rotation.from_rotvec(np.radians(turn_deg) * np.arange(n_frames)[:, None]).as_matrix()
    positions = np.einsum("tij,nj->nti", turns, points) + np.arange(n_frames)[None, :, None] * np.asarray(shift)
    positions = positions + np.random.default_rng(0).normal(0, noise, positions.shape)
    return make_tracks(positions, np.repeat(turns[None], len(points), axis=0))


def make_tracks(positions: np.ndarray, rotations: np.ndarray | None = None) -> Trajectories:
    """Trajectories with these positions (N, T, 3), NaN where not measured."""
    N, T = positions.shape[:2]
    if rotations is None:
        rotations = np.broadcast_to(np.eye(3), (N, T, 3, 3)).copy()
    seen = np.isfinite(positions[:, :, 0])
    zero = np.zeros(N, int)
    return Trajectories(
        positions,
        np.where(seen[:, :, None, None], rotations, np.nan),
        np.where(seen, 1e-3, np.nan),
        np.where(seen, 0.95, np.nan),
        np.where(seen, 3, 0),
        np.zeros((N, T, 3)),
        np.tile([0.0, 0, 1], (N, 1)),
        zero,
        zero.copy(),
        zero.copy(),
    )


def join_tracks(first: Trajectories, second: Trajectories) -> Trajectories:
    """Both together."""
    names = first.__dataclass_fields__
    return Trajectories(**{n: np.concatenate([getattr(first, n), getattr(second, n)]) for n in names})
