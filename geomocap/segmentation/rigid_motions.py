"""Rigid motions of groups of samples, steady against samples that do not follow."""

from __future__ import annotations

import numpy as np

from geomocap.segmentation.rotations import nearest_rotation

_ROUNDS = 5


def fit_rigid_motion(
    positions: np.ndarray, rest: np.ndarray, weights: np.ndarray, least_scale: float, rounds: int = _ROUNDS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rigid motion of one group of samples, by weighted Kabsch with weights that fall with the residual.

    A sample counts 1 / (1 + (r / 2s)⁴) with r its residual (root mean square over time) and s the median of all: those
    of a soft border count little. Within a frame, positions count in the same way by their own residuals.

    Parameters
    ----------
    positions : (n, T, 3) float, metres
        Complete; of weight 0 where not seen.
    rest : (n, 3) float, metres
        In the reference.
    weights : (n, T) float
    least_scale : float, metres
        Residuals below this are all the same.
    rounds : int
        Times that the weights are found anew.

    Returns
    -------
    rotations : (T, 3, 3) float
        world from reference.
    translations : (T, 3) float, metres
        position = rotation @ rest + translation.
    residuals : (n,) float, metres
        Root mean square over time.
    """
    given = np.maximum(weights, 1e-9)
    robust = given
    total = given.sum(axis=1)
    for _ in range(rounds):
        rotations, translations = _kabsch(positions, rest, robust)
        miss = np.linalg.norm(
            rest @ rotations.transpose(0, 2, 1) + translations[:, None] - positions.swapaxes(0, 1), axis=2
        ).T
        residuals = np.sqrt((given * miss**2).sum(axis=1) / total)
        scale = 2.0 * max(float(np.median(residuals)), least_scale)
        by_sample = 1.0 / (1.0 + (residuals / scale) ** 4)
        by_position = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 4)
        robust = given * by_sample[:, None] * by_position
    return rotations, translations, residuals


def _kabsch(positions: np.ndarray, rest: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    total = weights.sum(axis=0)
    share = (weights / total).T  # (T, n)
    moving = positions.swapaxes(0, 1)  # (T, n, 3)
    center = (share[:, None] @ moving)[:, 0]
    start = share @ rest
    moments = (moving * share[..., None]).transpose(0, 2, 1) @ rest - center[:, :, None] * start[:, None, :]
    rotations = nearest_rotation(moments + 1e-12 * np.eye(3))
    return rotations, center - (rotations @ start[..., None])[..., 0]


def turn_angles(rotations: np.ndarray) -> np.ndarray:
    """Angles of rotation matrices (…, 3, 3), radians."""
    cosine = (np.trace(rotations, axis1=-2, axis2=-1) - 1.0) / 2.0
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def relative_turn(first: np.ndarray, second: np.ndarray, share: float = 0.05) -> float:
    """Angle by which two motions (T, 3, 3) differ, exceeded in a small share of the frames only, radians."""
    angles = np.sort(turn_angles(first.swapaxes(1, 2) @ second))
    return float(angles[len(angles) - 1 - int(share * (len(angles) - 1))])
