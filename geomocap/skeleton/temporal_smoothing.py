"""Motion made smooth in time, without lag, steady against outliers; gaps are bridged."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

_ROUNDS = 6
_LEAST_TURN = 5e-3  # radians: misses below are all the same


def smooth_rotations(rotations: np.ndarray, weights: np.ndarray, strength: float) -> np.ndarray:
    """Rotations of least weighted misfit plus `strength` times the square of their angular acceleration.

    A Whittaker smoother on SO(3): small turns of the current estimate, in world axes, are found for all frames at once;
    frames that miss count 1 / (1 + (r / 3s)²), s the median. It treats past and future alike, so it has no lag, and
    frames of weight 0 are carried on at an even pace.

    Parameters
    ----------
    rotations : (T, 3, 3) float
    weights : (T,) float
        0 where nothing is known.
    strength : float
        In frames; 1 halves what changes its sign every 3 frames, 100 every 10.

    Returns
    -------
    (T, 3, 3) float
    """
    known = np.flatnonzero(weights > 0)
    if strength <= 0 or len(rotations) < 3 or len(known) < 2:
        return rotations
    observed = Rotation.from_matrix(rotations)
    estimate = _interpolate(observed, known, len(rotations))
    for _ in range(_ROUNDS):
        miss = (observed * estimate.inv()).as_rotvec()
        size = np.linalg.norm(miss, axis=1)
        robust = weights / (1.0 + (size / (3.0 * max(float(np.median(size[known])), _LEAST_TURN))) ** 2)
        pace = (estimate[1:] * estimate[:-1].inv()).as_rotvec()
        turns = _whittaker(miss, np.diff(pace, axis=0), robust, strength)
        estimate = Rotation.from_rotvec(turns) * estimate
    return estimate.as_matrix()


def smooth_positions(positions: np.ndarray, weights: np.ndarray, strength: float, least: float) -> np.ndarray:
    """Positions (T, 3) of least weighted misfit plus `strength` times the square of their acceleration.

    See `smooth_rotations`; misses below `least` (metres) are all the same.
    """
    known = np.flatnonzero(weights > 0)
    if strength <= 0 or len(positions) < 3 or len(known) < 2:
        return positions
    still = np.zeros((len(positions) - 2, 3))
    robust = weights
    for _ in range(_ROUNDS):
        smooth = _whittaker(positions, still, robust, strength)
        size = np.linalg.norm(positions - smooth, axis=1)
        robust = weights / (1.0 + (size / (3.0 * max(float(np.median(size[known])), least))) ** 2)
    return smooth


def _interpolate(observed: Rotation, known: np.ndarray, frames: int) -> Rotation:
    """Rotations of all frames: known ones, and even turns between them."""
    at = np.clip(np.searchsorted(known, np.arange(frames), side="right") - 1, 0, len(known) - 2)
    fraction = np.clip((np.arange(frames) - known[at]) / (known[at + 1] - known[at]), 0.0, 1.0)
    step = (observed[known[at + 1]] * observed[known[at]].inv()).as_rotvec()
    return Rotation.from_rotvec(fraction[:, None] * step) * observed[known[at]]


def _whittaker(target: np.ndarray, bend: np.ndarray, weights: np.ndarray, strength: float) -> np.ndarray:
    """Minimise Σ w |x - target|² + strength Σ |second difference of x + bend|²; (T, 3)."""
    frames = len(target)
    bands = np.zeros((3, frames))  # upper form: second, first, main diagonal
    for offset, value in ((0, 1.0), (1, 4.0), (2, 1.0)):
        bands[2, offset : frames - 2 + offset] += strength * value
    bands[1, 1 : frames - 1] += -2.0 * strength
    bands[1, 2:frames] += -2.0 * strength
    bands[0, 2:] += strength
    bands[2] += weights + 1e-12
    right = weights[:, None] * target
    right[:-2] -= strength * bend
    right[1:-1] += 2.0 * strength * bend
    right[2:] -= strength * bend
    return solveh_banded(bands, right)
