"""Rigid motions of groups of samples, steady against samples that do not follow."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.model.motion_paths import DEPTH_FRACTION, sure_part
from geomocap.model.rotations import rigid_motion, turn_angles

_ROUNDS = 5
_DAMPING = 1e-9
_STILL = 1e-12 * np.eye(3)  # square metres: a group of one place doesn't turn
_START_ROUNDS = 3  # with all directions alike, before rays are told apart


def fit_rigid_motion(
    positions: np.ndarray,
    rest: np.ndarray,
    weights: np.ndarray,
    least_scale: float,
    rounds: int = _ROUNDS,
    ray: np.ndarray | None = None,
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
    ray : (n, T, 3) float, optional
        See `MotionPaths`.

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
    moving = np.ascontiguousarray(positions.swapaxes(0, 1))
    for k in range(rounds if ray is None else _START_ROUNDS + rounds):
        if ray is None or k < _START_ROUNDS:
            rotations, translations = rigid_motion(rest, moving, robust.T, prior=_STILL)
        else:
            rotations, translations = _step(rotations, translations, positions, rest, robust, ray)
        carried = (rest @ rotations.transpose(0, 2, 1) + translations[:, None]).swapaxes(0, 1)
        miss = np.linalg.norm(sure_part(carried - positions, ray), axis=2)
        residuals = np.sqrt((given * miss**2).sum(axis=1) / total)
        scale = 2.0 * max(float(np.median(residuals)), least_scale)
        by_sample = 1.0 / (1.0 + (residuals / scale) ** 4)
        by_position = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 4)
        robust = given * by_sample[:, None] * by_position
    return rotations, translations, residuals


def _step(
    rotations: np.ndarray,
    translations: np.ndarray,
    positions: np.ndarray,
    rest: np.ndarray,
    weights: np.ndarray,
    ray: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of the motion, in which misses along the rays count little."""
    turned = rest @ rotations.transpose(0, 2, 1)  # (T, n, 3), without the shift
    misses = positions.swapaxes(0, 1) - turned - translations[:, None]
    weights, ray = weights.T, ray.swapaxes(0, 1)
    middle = (turned * weights[..., None]).sum(axis=1) / weights.sum(axis=1)[:, None]
    arm = turned - middle[:, None]
    zero = np.zeros(arm.shape[:2])
    x, y, z = np.moveaxis(arm, 2, 0)
    one = np.ones_like(zero)
    # by the turn about the middle, and by the shift
    jacobian = np.stack(
        [
            np.stack([zero, z, -y, one, zero, zero], -1),
            np.stack([-z, zero, x, zero, one, zero], -1),
            np.stack([y, -x, zero, zero, zero, one], -1),
        ],
        -2,
    )
    along = np.einsum("tni,tnij->tnj", ray, jacobian)
    part = 1.0 - DEPTH_FRACTION**2
    normal = np.einsum("tn,tnij,tnik->tjk", weights, jacobian, jacobian)
    normal -= part * np.einsum("tn,tnj,tnk->tjk", weights, along, along)
    right = np.einsum("tn,tnij,tni->tj", weights, jacobian, misses)
    right -= part * np.einsum("tn,tnj,tn->tj", weights, along, (ray * misses).sum(axis=2))
    size = np.einsum("tii->t", normal)[:, None, None]
    step = np.linalg.solve(normal + _DAMPING * size * np.eye(6), right[..., None])[..., 0]
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return turn @ rotations, translations + step[:, 3:] + middle - (turn @ middle[..., None])[..., 0]


def relative_turn(first: np.ndarray, second: np.ndarray, fraction: float = 0.05) -> float:
    """Angle by which two motions (T, 3, 3) differ, exceeded in a small fraction of the frames only, radians."""
    angles = np.sort(turn_angles(first.swapaxes(1, 2) @ second))
    return float(angles[len(angles) - 1 - int(fraction * (len(angles) - 1))])
