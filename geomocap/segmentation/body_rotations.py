"""How far each body has turned since the first frame."""

from __future__ import annotations

import numpy as np

from geomocap.model.ellipsoids import SHELL, Ellipsoids
from geomocap.model.rotations import nearest_rotation
from geomocap.segmentation.carried_ellipsoids import EllipsoidMotion

_AXES = 1.0
_INERTIA = 0.3


def carried_bodies(
    ellipsoids: Ellipsoids, body: np.ndarray, motion: EllipsoidMotion, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """How bodies move if each of their ellipsoids carries its points by its own motion.

    Parameters
    ----------
    ellipsoids : Ellipsoids (T, K)
    body : (K,) int
        Body of each ellipsoid.
    motion : EllipsoidMotion
    count : int
        Number of bodies B.

    Returns
    -------
    rotations : (T, B, 3, 3) float
        Those nearest (Kabsch) to where the points come to be; the identity in frame 0.
    positions : (T, B, 3) float, metres, world
        Of their centres.
    """
    weights = (body == np.arange(count)[:, None]) * ellipsoids.counts[0].astype(float)
    weights /= weights.sum(axis=1, keepdims=True)
    axes, centers = ellipsoids.rotations[0], motion.centers
    spread = np.einsum("kij,kj,klj->kil", axes, ellipsoids.radii[0] ** 2 / SHELL, axes)
    turned = np.einsum("bk,tkij,kjl->tbil", weights, motion.rotations, spread)
    means = np.einsum("bk,tki->tbi", weights, centers)
    apart = np.einsum("bk,tki,kj->tbij", weights, centers, motion.rest)
    apart -= np.einsum("tbi,bj->tbij", means, means[0])
    return nearest_rotation(turned + apart), means


def body_rotations(ellipsoids: Ellipsoids, body: np.ndarray, bodies: Ellipsoids) -> np.ndarray:
    """Rotation of each body since frame 0, continuous over time.

    The rotation is the one nearest (weighted Kabsch) to three pieces of evidence, summed as correlation matrices:
    the centres of the body's small ellipsoids about their mean, weighted by their points; the first and the last axis
    of the ellipsoid of the whole body, signs resolved to the frame before, weighted by how much they differ from the
    middle axis, so that nothing jumps when axes change places; and, weakly, the rotation of the frame before, which
    decides what the others leave open, as the roll of a round limb.

    Parameters
    ----------
    ellipsoids : Ellipsoids (T, K)
    body : (K,) int
        Body of each ellipsoid.
    bodies : Ellipsoids (T, B)
        Ellipsoids of the bodies.

    Returns
    -------
    (T, B, 3, 3) float
        Proper rotations about world axes, the identity in frame 0.
    """
    frames, count = bodies.counts.shape
    result = np.tile(np.eye(3), (frames, count, 1, 1))
    variances = bodies.radii**2 / SHELL
    for b in range(count):
        members = np.flatnonzero(body == b)
        weights = ellipsoids.counts[:, members].astype(float).mean(axis=0)
        weights /= weights.sum()
        centers = ellipsoids.centers[:, members]
        centers = centers - np.einsum("tkc,k->tc", centers, weights)[:, None]
        first = bodies.rotations[0, b]
        for t in range(1, frames):
            before = result[t - 1, b]
            evidence = np.einsum("ki,kj,k->ij", centers[t], centers[0], weights)
            for axis, neighbour in ((0, 1), (2, 1)):
                now = bodies.rotations[t, b, :, axis]
                start = first[:, axis]
                strength = min(
                    abs(variances[t, b, axis] - variances[t, b, neighbour]),
                    abs(variances[0, b, axis] - variances[0, b, neighbour]),
                )
                sign = 1.0 if now @ before @ start >= 0.0 else -1.0
                evidence += _AXES * strength * sign * np.outer(now, start)
            evidence += _INERTIA * variances[0, b].sum() * before
            result[t, b] = nearest_rotation(evidence)
    return result
