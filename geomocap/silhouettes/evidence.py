"""Evidence of each pixel: its misfit against the background, and the vote of its neighbours."""

from __future__ import annotations

import numpy as np
from numba import njit

SMOOTHING = 3.0  # reach of the vote, pixels
EDGE = 12.0  # colour step that stops it, noise sigmas
BAND = 16  # rows that are smoothed along x at once


@njit(cache=True, nogil=True, error_model="numpy")
def background_misfit(image, mean, sigma, known, gain, offset):
    """Compare each pixel with the lit background: half the chi-square of the three channels.

    Parameters
    ----------
    image : (H, W, 3) uint8
    mean : (H, W, 3) float32
    sigma : (H, W) float32
    known : (H, W) bool
    gain, offset : (3,) float32

    Returns
    -------
    (H, W) float32
        0 where the background isn't known.
    """
    h, w = known.shape
    misfit = np.empty((h, w), np.float32)
    half = np.float32(0.5)
    for y in range(h):
        for x in range(w):
            if not known[y, x]:
                misfit[y, x] = np.float32(0.0)
                continue
            a = np.float32(image[y, x, 0]) - gain[0] * mean[y, x, 0] - offset[0]
            b = np.float32(image[y, x, 1]) - gain[1] * mean[y, x, 1] - offset[1]
            c = np.float32(image[y, x, 2]) - gain[2] * mean[y, x, 2] - offset[2]
            s = sigma[y, x]
            misfit[y, x] = half * (a * a + b * b + c * c) / (s * s)
    return misfit


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_evidence(evidence, image, sigma):
    """Let neighbours vote, but not across colour edges of the image.

    A recursive filter over rows and columns, forwards and backwards, two rounds with falling reach, as the domain
    transform of Gastal & Oliveira (2011, section 4.2); its weights fall with the colour step in noise sigmas.
    SMOOTHING is the vote's standard deviation where the image is flat, EDGE the step at which it falls off.

    Parameters
    ----------
    evidence : (H, W) float32
    image : (H, W, 3) uint8
    sigma : (H, W) float32

    Returns
    -------
    (H, W) float32
    """
    h, w = evidence.shape
    bands = (h + BAND - 1) // BAND
    right = np.zeros((bands, w, BAND), np.float32)  # weights across the border to the next pixel, columns before rows
    down = np.zeros((h, w), np.float32)
    _edge_weights(image, sigma, right, down)
    out = evidence.copy()
    columns = np.zeros((w, BAND), np.float32)
    for k in range(2):
        # Rounds with standard deviations that add up to the reach: sigma sqrt(3) 2^(N-1-k) / sqrt(4^N - 1), N = 2.
        a = np.float32(np.exp(-np.sqrt(2.0) / (SMOOTHING * np.sqrt(3.0) * 2.0 ** (1 - k) / np.sqrt(15.0))))
        for band in range(bands):
            rows = out[band * BAND : (band + 1) * BAND]
            for y in range(rows.shape[0]):
                for x in range(w):
                    columns[x, y] = rows[y, x]
            _vote_along(columns, right[band], a)
            for y in range(rows.shape[0]):
                for x in range(w):
                    rows[y, x] = columns[x, y]
        for y in range(1, h):
            _vote(out[y], out[y - 1], down[y - 1], a)
        for y in range(h - 2, -1, -1):
            _vote(out[y], out[y + 1], down[y], a)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _vote_along(columns, weights, a):
    """Let each of some columns (N, BAND) vote on the next one, then on the one before."""
    band, last = np.uint64(BAND), np.uint64(columns.size - BAND)
    values, weight = columns.ravel(), weights.ravel()
    for begin in range(np.uint64(0), last, band):
        for n in range(begin, begin + band):
            values[n + band] += a * weight[n] * (values[n] - values[n + band])
    for end in range(np.uint64(0), last, band):
        first = last - band - end
        for n in range(first, first + band):
            values[n] += a * weight[n] * (values[n + band] - values[n])


@njit(cache=True, nogil=True, error_model="numpy")
def _vote(own, theirs, weights, a):
    """Move values (N,) to those of their neighbours, as far as the weights say."""
    for n in range(own.size):
        own[n] += a * weights[n] * (theirs[n] - own[n])


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_weights(image, sigma, right, down):
    """Fill in the weights to the pixels on the right, (H / BAND, W, BAND), and below, (H, W)."""
    h, w = sigma.shape
    step, weights = np.zeros(3 * w, np.float32), np.zeros(w, np.float32)
    for y in range(h):
        row = image[y].ravel()
        _weigh(row[3:], row[:-3], sigma[y], step, weights[: w - 1])
        for x in range(w - 1):
            right[y // BAND, x, y % BAND] = weights[x]
        if y + 1 < h:
            _weigh(image[y + 1].ravel(), row, sigma[y], step, down[y])


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(colors, others, sigma, step, weights):
    """Fill in weights (N,) that fall with the step from one row of colours (3 N,) uint8 to another; `step` is room."""
    edge, one = np.float32(EDGE), np.float32(1.0)
    for n in range(colors.size):
        difference = np.int32(colors[n]) - np.int32(others[n])
        step[n] = np.float32(np.int32(difference * difference))
    for x in range(weights.size):
        scale = one / (edge * edge * sigma[x] * sigma[x])
        r = one + (step[3 * x] + step[3 * x + 1] + step[3 * x + 2]) * scale
        weights[x] = one / (r * r)
