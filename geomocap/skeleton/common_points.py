"""Joints as points that two bodies' motions have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.rotations import nearest_rotation, turn_angles

_ROUNDS = 6
_INDEPENDENT = 0.2  # fraction of the frames; neighbouring ones err together
_LEAST_SPREAD = 1e-4


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
    turn : float, radians
        Largest turn of the bodies against each other (two frames in a hundred may exceed it).
    axis : (3,) float
        Axis of a hinge in frame 0, world; the mean axis for a ball.
    off_axis : float
        Root mean square fraction of the turn about other axes: 0 for a perfect hinge.
    axis_std : float, radians
        Standard deviation of the axis' direction.
    hinge : bool
        The bodies turn about one axis only, as far as their motions can tell.
    """

    point: np.ndarray
    std: np.ndarray
    miss: float
    turn: float
    axis: np.ndarray
    off_axis: float
    axis_std: float
    hinge: bool


def common_point(
    rotations: tuple[np.ndarray, np.ndarray],
    translations: tuple[np.ndarray, np.ndarray],
    weights: np.ndarray,
    interface: np.ndarray,
    prior: float,
    spread: float,
    noise: float,
    hinge_fraction: float,
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
    hinge_fraction : float
        A joint is a hinge if the turns about other axes are, root mean square, less than this fraction of all turns.
    """
    turned = rotations[0] - rotations[1]
    apart = translations[1] - translations[0]
    robust = np.array(weights, float)
    total = max(float(weights.sum()), 1e-9)
    independent = max(_INDEPENDENT * total, 1.0)
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
    axis, off_axis, axis_std = _hinge_axis(rotations, weights)
    relative = turn_angles(rotations[0].swapaxes(1, 2) @ rotations[1])
    turn = float(np.quantile(relative, 0.98))
    return CommonPoint(
        point, np.sqrt(np.diag(covariance)), rms, turn, axis, off_axis, axis_std, bool(off_axis < hinge_fraction)
    )


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    running = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(running, 0.5 * running[-1])]]) if running[-1] > 0 else 0.0


def _hinge_axis(rotations: tuple[np.ndarray, np.ndarray], weights: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Direction about which the bodies turn against each other, from the moments of all relative turns.

    The turns are counted from their mean, not from frame 0, so that the noise of one frame does not tilt the axis.
    """
    relative = rotations[0].swapaxes(1, 2) @ rotations[1]
    mean = nearest_rotation(np.einsum("t,tij->ij", weights + 1e-9, relative))
    since = relative @ mean.T
    skew = since - since.swapaxes(1, 2)
    vectors = 0.5 * np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)  # sin(angle) axis
    total = max(float(weights.sum()), 1e-9)
    values, directions = np.linalg.eigh(np.einsum("t,ti,tj->ij", weights, vectors, vectors) / total)
    values = np.maximum(values, 0.0)
    axis = directions[:, 2] * (1.0 if directions[np.argmax(np.abs(directions[:, 2])), 2] > 0 else -1.0)
    spread = max(float(values[2]), _LEAST_SPREAD**2)
    off_axis = float(np.sqrt((values[0] + values[1]) / (values.sum() + 1e-18)))
    # small turns: off-axis noise against the turns about the axis, in about a fifth of the frames independent
    return axis, off_axis, float(np.sqrt(values[1] / spread / max(0.2 * total, 1.0)))
