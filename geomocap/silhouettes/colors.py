"""Colours of the subject and of the background in one frame, which tell a shadow from dark clothes."""

from __future__ import annotations

import numpy as np
from numba import njit

LEVELS = 24  # classes of each channel, narrower where it is dark
LEAST_PIXELS = 150  # certain pixels of the subject that a colour model needs
SPREAD = 0.02  # weight of evenly spread colours in each of the two distributions
MOST = 4.0  # no colour counts for more than exp(4) : 1 either way


@njit(cache=True, nogil=True)
def color_evidence(evidence, image, doubtful, certain):
    """Add to doubtful pixels how much likelier their colour is on the subject than elsewhere in this frame.

    The two distributions are smoothed histograms over the pixels that are certain: background below `doubtful`, subject
    from `certain` on.

    Parameters
    ----------
    evidence : (H, W) float32
        Changed in place where it lies between the two limits.
    image : (H, W, 3) uint8
    doubtful, certain : float
        Limits of the evidence, log likelihood ratios.
    """
    h, w = evidence.shape
    level = np.empty(256, np.int64)
    for v in range(256):
        level[v] = min(LEVELS - 1, int(LEVELS * np.sqrt(v / 255.0)))
    front = np.zeros((LEVELS + 2, LEVELS + 2, LEVELS + 2), np.float32)
    back = np.zeros((LEVELS + 2, LEVELS + 2, LEVELS + 2), np.float32)
    n_front, n_back = 0, 0
    for y in range(h):
        for x in range(w):
            r, g, b = level[image[y, x, 0]] + 1, level[image[y, x, 1]] + 1, level[image[y, x, 2]] + 1
            if evidence[y, x] >= certain:
                front[r, g, b] += 1
                n_front += 1
            elif evidence[y, x] <= doubtful:
                back[r, g, b] += 1
                n_back += 1
    if n_front < LEAST_PIXELS or n_back < LEAST_PIXELS:
        return
    _smooth(front)
    _smooth(back)
    even = SPREAD / LEVELS**3
    for y in range(h):
        for x in range(w):
            e = evidence[y, x]
            if doubtful < e < certain:
                r, g, b = level[image[y, x, 0]] + 1, level[image[y, x, 1]] + 1, level[image[y, x, 2]] + 1
                ratio = np.log((front[r, g, b] / n_front + even) / (back[r, g, b] / n_back + even))
                evidence[y, x] = e + np.float32(min(max(ratio, -MOST), MOST))


@njit(cache=True, nogil=True)
def _smooth(histogram):
    """Binomial (1 2 1)/4 along each axis, in place; the border stays out of use."""
    n = histogram.shape[0]
    line = np.empty(n, np.float32)
    for axis in range(3):
        for i in range(n):
            for j in range(n):
                for k in range(n):
                    line[k] = (
                        histogram[k, i, j] if axis == 0 else (histogram[i, k, j] if axis == 1 else histogram[i, j, k])
                    )
                for k in range(1, n - 1):
                    value = np.float32(0.25) * (line[k - 1] + np.float32(2.0) * line[k] + line[k + 1])
                    if axis == 0:
                        histogram[k, i, j] = value
                    elif axis == 1:
                        histogram[i, k, j] = value
                    else:
                        histogram[i, j, k] = value
