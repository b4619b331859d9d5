"""Joints as points that two bodies' motions have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.rotations import nearest_rotation
from geomocap.skeleton.hinges import main_axis

_ROUNDS = 6
INDEPENDENT = 0.2  # fraction of the frames; neighbouring ones err together


@dataclass(frozen=True)
class CommonPoint:
    """A point that stays, as nearly as can be, in the same place on two bodies.

    Attributes
    ----------
    point : (3,) float, metres, world
        In frame 0.
    std : (3,) float, metres
        Standard deviation along x, y, z; large along the axis of a hinge without a prior.
    miss : float, metres
        How far the two bodies carry the point apart: root mean square over time, robust.
    axis : (3,) float
        About which most of the bodies' turns against each other are; frame 0, world.
    hinge : bool
        The bodies turn about that axis only: what the observations say of it when the skeleton is refined.
    """

    point: np.ndarray
    std: np.ndarray
    miss: float
    axis: np.ndarray
    hinge: bool = False


def common_point(
    rotations: tuple[np.ndarray, np.ndarray],
    translations: tuple[np.ndarray, np.ndarray],
    weights: np.ndarray,
    interface: np.ndarray,
    prior: float,
    spread: float,
    noise: float,
    independence: float = INDEPENDENT,
) -> CommonPoint:
    """Least squares point c with R_a c + t_a = R_b c + t_b in all frames, drawn to the bodies' interface.

    Frames count less, the more they miss (weights 1 / (1 + (r / 2s)²), s the median). The prior is worth `prior` frames
    in which the bodies turn by a radian; it decides along the axis of a hinge, where every point is common. It is worth
    more where the motions miss so much that they know the point less well than the interface does.

    Parameters
    ----------
    rotations : two (T, 3, 3) float
        Of both bodies, since frame 0.
    translations : two (T, 3) float, metres
    weights : (T,) float
        Reliability of each frame.
    interface : (3,) float, metres
        Where the bodies touch in frame 0.
    prior : float
        Least weight of the interface, in frames.
    spread : float, metres
        How far from the middle of the interface a joint may be, standard deviation.
    noise : float, metres
        Misses below this are all the same.
    independence : float
        Fraction of the frames that err independently of each other; 0: all err alike.
    """
    turned = rotations[0] - rotations[1]
    apart = translations[1] - translations[0]
    robust = np.array(weights, float)
    total = max(float(weights.sum()), 1e-9)
    independent = max(independence * total, 1.0)
    point = interface
    for k in range(_ROUNDS + 1):
        miss = np.linalg.norm(turned @ point - apart, axis=1)
        scale = 2.0 * max(_weighted_median(miss, weights), noise)
        robust = weights / (1.0 + (miss / scale) ** 2)
        rms = float(np.sqrt((robust * miss**2).sum() / max(robust.sum(), 1e-9)))
        if k == _ROUNDS:
            break
        held = max(prior, max(rms, noise) ** 2 / (independent * max(spread, noise) ** 2))
        normal = np.einsum("t,tji,tjk->ik", robust, turned, turned) / total + held * np.eye(3)
        right = np.einsum("t,tji,tj->i", robust, turned, apart) / total + held * interface
        point = np.linalg.solve(normal, right)
    covariance = np.linalg.inv(normal) * max(rms, noise) ** 2 / independent
    relative = rotations[0].swapaxes(1, 2) @ rotations[1]
    # counted from their mean, not from frame 0, so that the noise of one frame does not tilt the axis
    mean = nearest_rotation(np.einsum("t,tij->ij", weights + 1e-9, relative))
    return CommonPoint(point, np.sqrt(np.diag(covariance)), rms, main_axis(relative @ mean.T, weights))


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    running = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(running, 0.5 * running[-1])]]) if running[-1] > 0 else 0.0
