"""Noise of a camera's frames against its background: larger at edges."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numba import njit

LEAST_NOISE = 0.7  # grey levels; 8-bit rounding alone gives 0.29, compression hides the rest in flat parts
GRADIENT_BINS = 12
MOST_JITTER = 0.3  # pixels that edges move at most, by compression and vibration


def noise(
    frames: Sequence[np.ndarray],
    lights: Sequence[tuple[np.ndarray, np.ndarray]],
    background: np.ndarray,
    known: np.ndarray,
) -> np.ndarray:
    """Measure the standard deviation of frames against the background, (H, W) float32, grey levels.

    Variance a + b · gradient², fitted to robust variances (median absolute deviation, so that the subject does not
    count) of pixels sorted by the background's gradient: edges move by fractions of a pixel and are compressed worst.

    Parameters
    ----------
    frames : sequence of T arrays (H, W, 3) uint8
    lights : sequence of T pairs of (3,) float64
        Gain and offset of each frame.
    background : (H, W, 3) float32
    known : (H, W) bool
    """
    gradient = _gradient(background)
    step = max(1, int(np.sqrt(gradient.size / 20000)))
    part = (slice(None, None, step), slice(None, None, step))
    use = known[part] & (background[part] > 6).all(-1) & (background[part] < 249).all(-1)
    if use.sum() < 50:
        use = known[part]
    g = gradient[part][use]
    if g.size < 50:
        return np.full(gradient.shape, 2.0, np.float32)
    edges = np.quantile(g, np.linspace(0, 1, GRADIENT_BINS + 1))
    which = np.clip(np.searchsorted(edges, g, side="right") - 1, 0, GRADIENT_BINS - 1)
    order = np.argsort(which, kind="stable")
    g, mean = g[order], background[part][use][order]
    pixels = np.flatnonzero(use)[order]
    colors = np.stack([image[part] for image in frames]).reshape(len(frames), -1, 3)
    gains, offsets = (np.array(values, np.float64) for values in zip(*lights, strict=True))
    x, y = [], []
    for inside in np.split(np.arange(len(g)), np.searchsorted(which[order], np.arange(1, GRADIENT_BINS))):
        if len(inside) >= 20:
            some = slice(inside[0], inside[-1] + 1)
            x.append(np.median(g[some]) ** 2)
            y.append((1.4826 * middle(absolute_misses(colors, pixels[some], mean[some], gains, offsets))) ** 2)
    a = max(float(np.median(y[: max(1, len(y) // 2)])), LEAST_NOISE**2)
    steepest = [max(0.0, v - a) / u for u, v in zip(x, y, strict=True) if u > 4.0][-4:]
    b = min(float(np.median(steepest)), MOST_JITTER**2) if steepest else 0.0
    return np.sqrt(a + b * gradient**2).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def absolute_misses(images, pixels, mean, gains, offsets):
    """By how much the background in the frames' light misses the frames, in each channel.

    Parameters
    ----------
    images : (T, K, 3) uint8
    pixels : (n,) int64
        Which of the frames' pixels.
    mean : (n, 3) float32
        Background there.
    gains, offsets : (T, 3) float64

    Returns
    -------
    (3 T n,) float64
        |colour - (gain · mean + offset)|.
    """
    misses = np.empty((len(images), len(pixels), 3))
    for t in range(len(images)):
        for i in range(len(pixels)):
            for c in range(3):
                misses[t, i, c] = abs(images[t, pixels[i], c] - (gains[t, c] * mean[i, c] + offsets[t, c]))
    return misses.ravel()


def middle(values: np.ndarray) -> float:
    """Median of values (N,), sought only among those that a sample says are near it."""
    sample = np.sort(values[:: max(1, len(values) // 1000)])
    at = len(sample) * 9 // 20
    first, near = between(values, sample[at], sample[-1 - at])
    low, high = (len(values) - 1) // 2 - first, len(values) // 2 - first
    if not 0 <= low <= high < len(near):
        return float(np.median(values))
    near.partition((low, high))
    return float(near[low] + near[high]) / 2


@njit(cache=True, nogil=True, error_model="numpy")
def between(values, low, high):
    """Count the values (N,) below `low`, and list those from there to `high`, both ends included."""
    below, count = 0, 0
    found = np.empty(len(values), values.dtype)
    for value in values:
        below += value < low
        found[count] = value
        count += low <= value <= high
    return below, found[:count]


def _gradient(mean: np.ndarray) -> np.ndarray:
    """Largest gradient of the three channels, grey levels a pixel, (H, W) float32."""
    dx, dy = cv2.Sobel(mean, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(mean, cv2.CV_32F, 0, 1, scale=1 / 8)
    return np.sqrt((dx * dx + dy * dy).max(axis=-1))
