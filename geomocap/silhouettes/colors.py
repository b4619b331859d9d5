"""Colours of the subject: how likely each is, learnt from all cameras and frames."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

LEVELS = 24  # classes of each channel, narrower where it is dark
UNSEEN = 0.3  # fraction of the subject's pixels whose colours weren't met where the others were learnt
GAMUT = 30.0  # grey levels that those span in each channel
LEAST_PIXELS = 150  # certain pixels of the subject that say anything about its colours

LEVEL = np.minimum(LEVELS - 1, (LEVELS * np.sqrt(np.arange(256) / 255.0)).astype(int)).astype(np.uint8)
"""Class of each grey level, (256,) uint8."""


def count_colors(image: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Count the pixels of each class of colours.

    Parameters
    ----------
    image : (H, W, 3) uint8
    where : (H, W) bool
        The pixels that count.

    Returns
    -------
    (LEVELS³,) float64
    """
    r, g, b = LEVEL[image[where]].T.astype(np.int64)
    return np.bincount((r * LEVELS + g) * LEVELS + b, minlength=LEVELS**3).astype(float)


def color_density(counts: np.ndarray) -> np.ndarray:
    """Log density of the subject's colours.

    The smoothed histogram of those that were counted, and an even fraction for those that weren't.

    Parameters
    ----------
    counts : (LEVELS³,) float

    Returns
    -------
    (LEVELS, LEVELS, LEVELS) float32
        Log of the density per grey level³.
    """
    even = np.full((LEVELS,) * 3, 1.0 / GAMUT**3)
    if counts.sum() < LEAST_PIXELS:
        return np.log(even).astype(np.float32)
    width = np.bincount(LEVEL, minlength=LEVELS).astype(float)
    cell = np.maximum(width[:, None, None] * width[None, :, None] * width[None, None, :], 1.0)
    histogram = gaussian_filter(counts.reshape(even.shape), 0.7) / counts.sum()
    return np.log((1 - UNSEEN) * histogram / cell + UNSEEN * even).astype(np.float32)
