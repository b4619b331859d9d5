"""Noise that is white in time taken out of complete paths, as strongly as the paths themselves show to be right."""

from __future__ import annotations

import numpy as np

_ORDER = 3  # differences of this order are kept small
_STRENGTHS = np.concatenate([[0.0], np.logspace(-5, 5, 61)])


def smooth_paths(positions: np.ndarray) -> np.ndarray:
    """Smooth paths by a Whittaker filter whose strength generalised cross-validation chooses, one for all.

    Paths without white noise stay as they are (Whittaker, On a new method of graduation, 1923; Golub, Heath, Wahba,
    Generalized cross-validation as a method for choosing a good ridge parameter, 1979).

    Parameters
    ----------
    positions : (N, T, 3) float, metres
        Complete.

    Returns
    -------
    (N, T, 3) float, metres
    """
    frames = positions.shape[1]
    if frames < 2 * _ORDER + 2:
        return positions
    differences = np.diff(np.eye(frames), _ORDER, axis=0)
    values, basis = np.linalg.eigh(differences.T @ differences)
    parts = basis.T @ positions
    power = (parts**2).sum(axis=(0, 2))
    gains = 1.0 / (1.0 + _STRENGTHS[:, None] * np.maximum(values, 0.0))
    removed = 1.0 - gains
    left = removed.mean(axis=1)
    score = np.full(len(gains), np.inf)
    score[1:] = (removed[1:] ** 2 @ power) / left[1:] ** 2
    gain = gains[int(np.argmin(score))]
    return np.ascontiguousarray(basis @ (gain[:, None] * parts))
