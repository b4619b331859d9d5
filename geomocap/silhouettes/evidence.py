"""Evidence of each pixel for the subject: log likelihood ratio of subject against background or its shadow."""

from __future__ import annotations

import numpy as np
from numba import njit

LIMIT = 10.0  # no single pixel counts for more than exp(10) : 1 for the subject,
LIMIT_BACK = 4.0  # nor for more than exp(4) : 1 for the background: subjects have its colours here and there
TEXTURE_WEIGHT = 8.0  # independent samples that the texture of a window counts for: its neighbours vote as well
NO_QUESTION = -3.0  # pixels with less evidence for the subject are background without more ado
HOPELESS = 60.0  # chi-square of a pixel's colour beyond which no shadow explains it
SHADOW_PRIOR = 6.0  # log of how much likelier a matching shadow is than a subject of just that colour
DOUBTFUL = -LIMIT_BACK  # below, no shadow and hardly any noise is left to explain: background


@njit(cache=True, nogil=True)
def background_evidence(image, mean, sigma, known, gain, offset, threshold, unknown):
    """Compare each pixel with the lit background.

    Half the chi-square of the three channels, minus the prior at which it counts as subject (a subject's colours being
    spread evenly), limited to -`LIMIT_BACK` … `LIMIT`.

    Parameters
    ----------
    image : (H, W, 3) uint8
    mean : (H, W, 3) float32
    sigma : (H, W) float32
    known : (H, W) bool
    gain, offset : (3,) float32
    threshold : float
        Difference in sigmas where subject and background are equally likely.
    unknown : float
        Evidence where the background isn't known.

    Returns
    -------
    (H, W) float32
    """
    h, w = known.shape
    evidence = np.empty((h, w), np.float32)
    prior = np.float32(0.5 * threshold * threshold)
    limit, least = np.float32(LIMIT), np.float32(-LIMIT_BACK)
    half = np.float32(0.5)
    for y in range(h):
        for x in range(w):
            if not known[y, x]:
                evidence[y, x] = unknown
                continue
            a = np.float32(image[y, x, 0]) - gain[0] * mean[y, x, 0] - offset[0]
            b = np.float32(image[y, x, 1]) - gain[1] * mean[y, x, 1] - offset[1]
            c = np.float32(image[y, x, 2]) - gain[2] * mean[y, x, 2] - offset[2]
            s = sigma[y, x]
            value = half * (a * a + b * b + c * c) / (s * s) - prior
            evidence[y, x] = min(max(value, least), limit)
    return evidence


@njit(cache=True, nogil=True)
def shadow_evidence(evidence, image, mean, sigma, known, gain, offset, radius, darkest, lightest, color):
    """Lower the evidence where the background under a shadow (or reflection) explains the image as well.

    A window's shadow is a factor on the background that varies linearly in it (penumbra), by least squares. It explains
    a pixel in the window as far as the factor lies within [darkest, lightest], the channels' own factors hardly differ
    (same colour), what is left of the window is noise (same texture), and the pixel itself fits. The best of nine
    windows around and beside the pixel counts, so that windows reaching over the subject's or the shadow's border don't
    spoil the others.

    Parameters
    ----------
    evidence : (H, W) float32
        Evidence against the lit background.
    image, mean, sigma, known, gain, offset
        As in `background_evidence`.
    radius : int
        Half width of the windows, pixels.
    darkest, lightest : float
        Range of the shadow's factor.
    color : float
        Tolerance of the factors, between channels and within a window (ratio).

    Returns
    -------
    (H, W) float32
        Evidence against background and shadow, the smaller of the two.
    """
    h, w = known.shape
    plane = np.zeros((h, w, 3), np.float32)  # factor at the window's centre, its slopes along x and y
    tint = np.zeros((h, w, 3), np.float32)  # channels' own factors, relative
    misfit = np.full((h, w), np.float32(np.inf), np.float32)
    for y in range(h):
        for x in range(w):
            if evidence[y, x] > NO_QUESTION and known[y, x]:
                _fit_window(
                    image, mean, sigma, known, gain, offset, radius, darkest, lightest, color, y, x, plane, tint, misfit
                )
    result = evidence.copy()
    for y in range(h):
        for x in range(w):
            if evidence[y, x] <= NO_QUESTION or not known[y, x]:
                continue
            noise = sigma[y, x] * sigma[y, x]
            least = np.float32(np.inf)
            for v in range(y - radius, y + radius + 1, radius):
                for u in range(x - radius, x + radius + 1, radius):
                    if v < 0 or v >= h or u < 0 or u >= w or misfit[v, u] >= least:
                        continue
                    own = misfit[v, u]
                    factor = plane[v, u, 0] + plane[v, u, 1] * (x - u) + plane[v, u, 2] * (y - v)
                    for c in range(3):
                        shaded = factor * tint[v, u, c] * (gain[c] * mean[y, x, c] + offset[c])
                        left = np.float32(image[y, x, c]) - shaded
                        own += left * left / (noise + color * color * shaded * shaded)
                    least = min(least, own)
            value = max(np.float32(0.5 * least - SHADOW_PRIOR), np.float32(-LIMIT_BACK))
            if value < evidence[y, x]:
                result[y, x] = value
    return result


@njit(cache=True, nogil=True)
def _fit_window(image, mean, sigma, known, gain, offset, radius, darkest, lightest, color, y, x, plane, tint, misfit):
    """Fit the shadow of the window around (y, x); leaves `misfit` infinite where it can't be one."""
    h, w = known.shape
    noise = np.float64(sigma[y, x]) ** 2

    # Can any shadow explain the centre itself?
    ib, bb = 0.0, 1e-6
    for c in range(3):
        b = np.float64(gain[c] * mean[y, x, c] + offset[c])
        ib += image[y, x, c] * b
        bb += b * b
    factor = ib / bb
    if not (0.7 * darkest < factor < 1.3 * lightest):
        return
    left = 0.0
    for c in range(3):
        b = factor * (gain[c] * mean[y, x, c] + offset[c])
        left += (image[y, x, c] - b) ** 2 / (noise + (2.0 * color * b) ** 2)
    if left > HOPELESS:
        return

    # Factor s0 + s1 du + s2 dv, all channels together: normal equations in the moments of B² and I·B
    n = 0
    m00, m10, m01, m20, m11, m02, r0, r1, r2 = 1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6, 0.0, 0.0, 0.0
    top, bottom = max(0, y - radius), min(h, y + radius + 1)
    first, last = max(0, x - radius), min(w, x + radius + 1)
    for v in range(top, bottom):
        for u in range(first, last):
            if known[v, u]:
                n += 1
                ib, bb = 0.0, 0.0
                for c in range(3):
                    b = np.float64(gain[c] * mean[v, u, c] + offset[c])
                    ib += image[v, u, c] * b
                    bb += b * b
                du, dv = u - x, v - y
                m00 += bb
                m10 += bb * du
                m01 += bb * dv
                m20 += bb * du * du
                m11 += bb * du * dv
                m02 += bb * dv * dv
                r0 += ib
                r1 += ib * du
                r2 += ib * dv
    if n < 6:
        return
    c0, c1, c2 = m20 * m02 - m11 * m11, m11 * m01 - m10 * m02, m10 * m11 - m20 * m01
    det = m00 * c0 + m10 * c1 + m01 * c2
    if not det > 1e-9 * m00 * m20 * m02:
        return
    s0 = (c0 * r0 + c1 * r1 + c2 * r2) / det
    s1 = (c1 * r0 + (m00 * m02 - m01 * m01) * r1 + (m10 * m01 - m00 * m11) * r2) / det
    s2 = (c2 * r0 + (m10 * m01 - m00 * m11) * r1 + (m00 * m20 - m10 * m10) * r2) / det
    if not (darkest <= s0 <= lightest):
        return

    # Same colour: the channels' own factors; same texture: what the shadow leaves of the window
    texture, hue = 0.0, 0.0
    for c in range(3):
        ii, ip, pp = 0.0, 0.0, 1e-6
        for v in range(top, bottom):
            for u in range(first, last):
                if known[v, u]:
                    i = np.float64(image[v, u, c])
                    p = (s0 + s1 * (u - x) + s2 * (v - y)) * (gain[c] * mean[v, u, c] + offset[c])
                    ii += i * i
                    ip += i * p
                    pp += p * p
        t = ip / pp
        tint[y, x, c] = t
        texture += max(0.0, ii - t * ip) / (noise + color * color * pp / n)
        hue += (t - 1.0) ** 2 / (noise / pp + color * color)
    plane[y, x, 0], plane[y, x, 1], plane[y, x, 2] = s0, s1, s2
    misfit[y, x] = TEXTURE_WEIGHT * max(0.0, texture / (3 * n) - 1.0) + hue


@njit(cache=True, nogil=True)
def smooth_evidence(evidence, image, sigma, reach, edge):
    """Let neighbours vote, but not across colour edges of the image.

    A recursive filter over rows and columns, forwards and backwards, two rounds with falling reach, as the domain
    transform of Gastal & Oliveira (2011, section 4.2); its weights fall with the colour step in noise sigmas.

    Parameters
    ----------
    evidence : (H, W) float32
    image : (H, W, 3) uint8
    sigma : (H, W) float32
    reach : float
        Standard deviation of the vote where the image is flat, pixels.
    edge : float
        Colour step at which the vote falls off, sigmas.

    Returns
    -------
    (H, W) float32
    """
    h, w = evidence.shape
    out = evidence.copy()
    right = np.empty((h, w), np.float32)
    down = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            scale = np.float32(1.0) / (edge * edge * sigma[y, x] * sigma[y, x])
            r = np.float32(0.0)
            d = np.float32(0.0)
            for c in range(3):
                i = np.float32(image[y, x, c])
                if x + 1 < w:
                    r += (np.float32(image[y, x + 1, c]) - i) ** 2
                if y + 1 < h:
                    d += (np.float32(image[y + 1, x, c]) - i) ** 2
            r = np.float32(1.0) + r * scale
            d = np.float32(1.0) + d * scale
            right[y, x] = np.float32(1.0) / (r * r)
            down[y, x] = np.float32(1.0) / (d * d)
    for k in range(2):
        # Rounds with standard deviations that add up to the reach: sigma sqrt(3) 2^(N-1-k) / sqrt(4^N - 1), N = 2.
        a = np.float32(np.exp(-np.sqrt(2.0) / (reach * np.sqrt(3.0) * 2.0 ** (1 - k) / np.sqrt(15.0))))
        for y in range(h):
            for x in range(1, w):
                out[y, x] += a * right[y, x - 1] * (out[y, x - 1] - out[y, x])
            for x in range(w - 2, -1, -1):
                out[y, x] += a * right[y, x] * (out[y, x + 1] - out[y, x])
        for y in range(1, h):
            for x in range(w):
                out[y, x] += a * down[y - 1, x] * (out[y - 1, x] - out[y, x])
        for y in range(h - 2, -1, -1):
            for x in range(w):
                out[y, x] += a * down[y, x] * (out[y + 1, x] - out[y, x])
    return out
