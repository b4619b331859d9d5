"""Slow light changes: gain and offset of a frame against its background."""

from __future__ import annotations

import numpy as np
from numba import njit

SAMPLES = 3000
ITERATIONS = 8


def light_change(
    image: np.ndarray, mean: np.ndarray, sigma: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate gain and offset of each channel, image = gain · mean + offset, from the background alone.

    Robust: the gain starts at the median ratio and is refined by iteratively reweighted least squares with Tukey's
    weights, so the subject may cover nearly half of the view. A weak prior holds the offset at zero where the
    background has too little contrast to tell the two apart.

    Parameters
    ----------
    image : (H, W, 3) uint8
    mean : (H, W, 3) float32
        Background, grey levels.
    sigma : (H, W) float32
        Noise, grey levels.
    known : (H, W) bool
        Where the background is known.

    Returns
    -------
    gain, offset : (3,) float64
    """
    gain, offset = np.ones(3), np.zeros(3)
    step = max(1, int(np.sqrt(known.size / SAMPLES)))
    for c in range(3):
        x, y, s = _samples(image, mean, sigma, known, c, step)
        if len(x) < 50:
            continue
        gain[c] = _median(y / x)
        scale = 1.4826 * _median(np.abs(y - gain[c] * x) / s)
        gain[c], offset[c] = _reweighted_line(x, y, s, gain[c], max(scale, 1.0))
    return gain, offset


@njit(cache=True, nogil=True, error_model="numpy")
def _samples(image, mean, sigma, known, channel, step):
    """Values of a channel at every so many pixels, neither dark nor overexposed: background, frame, noise, float64."""
    h, w = known.shape
    found = np.empty((3, (h // step + 1) * (w // step + 1)))
    count = 0
    for y in range(step // 2, h, step):
        for x in range(step // 2, w, step):
            before, now = np.float64(mean[y, x, channel]), np.float64(image[y, x, channel])
            if known[y, x] and 4 < now < 251 and 4 < before < 251:
                found[0, count], found[1, count], found[2, count] = before, now, sigma[y, x]
                count += 1
    return found[0, :count], found[1, :count], found[2, :count]


def _median(values: np.ndarray) -> float:
    """Median of some finite values (N,), which change their order: `np.median` takes ten times as long to call."""
    half = len(values) // 2
    values.partition(half)
    upper = float(values[half])
    return upper if len(values) % 2 else float(values[:half].max() + upper) / 2


@njit(cache=True, nogil=True, error_model="numpy")
def _reweighted_line(x, y, sigma, gain, scale):
    """Line through (x, y) by Tukey's weights, from a first gain; scale shrinks to 1 sigma as it converges."""
    offset = 0.0
    reach = 4.685 * min(scale, 6.0)
    prior = 0.25 * x.size / 100.0  # offset known to be 0 to a few grey levels
    for _ in range(ITERATIONS):
        sw, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(x.size):
            r = (y[k] - gain * x[k] - offset) / (sigma[k] * reach)
            if r * r < 1.0:
                weight = (1.0 - r * r) ** 2 / (sigma[k] * sigma[k])
                sw += weight
                sx += weight * x[k]
                sy += weight * y[k]
                sxx += weight * x[k] * x[k]
                sxy += weight * x[k] * y[k]
        if sxx <= 0.0:
            break
        sw += prior
        det = sw * sxx - sx * sx
        if det <= 1e-9 * sw * sxx:
            offset = 0.0
            gain = sxy / sxx
        else:
            offset = (sxx * sy - sx * sxy) / det
            gain = (sw * sxy - sx * sy) / det
        reach = max(4.685, 0.6 * reach)
    return gain, offset
