"""Rotations: the one nearest to a matrix, the rigid motion between points, and how far matrices turn."""

from __future__ import annotations

import numpy as np


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the proper rotations R that maximise trace(Rᵀ M) for matrices (…, 3, 3) (Kabsch 1976, Umeyama 1991)."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return u @ vt


def rigid_motion(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None, prior: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations that take points to others in the weighted least squares sense.

    The rotations are proper even if the points are mirrored: a mirrored world stays an error.

    Parameters
    ----------
    source, target : (…, N, 3) float
        They may be broadcast against each other.
    weights : (…, N) float, optional
        All the same if not given.
    prior : (…, 3, 3) float, optional
        Rotations times squared lengths, added to the points' second moments (of mean weight 1): they decide what the
        points leave open.

    Returns
    -------
    rotations : (…, 3, 3) float
    translations : (…, 3) float
        target = rotation @ source + translation.
    """
    if weights is None:
        weights = np.ones(target.shape[:-1])
    fraction = weights / weights.sum(axis=-1, keepdims=True)
    start, end = ((fraction[..., None, :] @ x)[..., 0, :] for x in (source, target))
    moment = np.swapaxes((target - end[..., None, :]) * fraction[..., None], -1, -2) @ source
    rotations = nearest_rotation(moment + prior)
    return rotations, end - (rotations @ start[..., None])[..., 0]


def turn_angles(rotations: np.ndarray) -> np.ndarray:
    """Angles of rotation matrices (…, 3, 3), radians."""
    cosine = (np.trace(rotations, axis1=-2, axis2=-1) - 1.0) / 2.0
    return np.arccos(np.clip(cosine, -1.0, 1.0))
