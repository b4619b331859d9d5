"""Evidence of each pixel: its misfit against background or shadow, and the vote of its neighbours."""

from __future__ import annotations

import numpy as np
from numba import njit

TEXTURE_WEIGHT = 8.0  # independent samples that the texture of a window counts for: its neighbours vote as well
NO_QUESTION = 5.0  # pixels with less misfit are background without more ado
HOPELESS = 25.0  # chi-square of a pixel's colour beyond which no shadow explains it
SHADOW_RADIUS = 2  # half width of the windows that compare texture, pixels
SHADOW_LIGHTEST = 1.1  # brightness of the strongest reflection on the background (ratio)
SHADOW_COLOR = 0.03  # how much a shadow may change colour, and brightness within the window (ratio)
SMOOTHING = 3.0  # reach of the vote, pixels
EDGE = 12.0  # colour step that stops it, noise sigmas


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def shadow_misfit(direct, image, mean, sigma, known, gain, offset, darkest):
    """Compare each pixel with the background under a shadow or reflection, where the lit background doesn't explain it.

    A window's shadow is a factor on the background that varies linearly in it (penumbra), by least squares. It explains
    a pixel in the window as far as the factor lies within [darkest, lightest], the channels' own factors hardly differ
    (same colour), what is left of the window is noise (same texture), and the pixel itself fits. The best of nine
    windows around and beside the pixel counts, so that windows reaching over the subject's or the shadow's border don't
    spoil the others.

    Parameters
    ----------
    direct : (H, W) float32
        Misfit of the lit background.
    image, mean, sigma, known, gain, offset
        As in `background_misfit`.
    darkest : float
        Least factor of a shadow.

    Returns
    -------
    (H, W) float32
        Half the chi-square of colour, texture and hue; infinite where no shadow is possible or asked for.
    """
    h, w = known.shape
    darkest = np.float64(darkest)
    radius, lightest, color = SHADOW_RADIUS, SHADOW_LIGHTEST, SHADOW_COLOR
    picture = np.zeros((h, w, 3), np.float32)  # 0 where unknown, as the next three
    lit = np.zeros((h, w, 3), np.float32)
    ib, bb = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32)  # sums over the channels of I·B and B²
    for y in range(h):
        for x in range(w):
            if known[y, x]:
                for c in range(3):
                    i = np.float32(image[y, x, c])
                    b = gain[c] * mean[y, x, c] + offset[c]
                    picture[y, x, c], lit[y, x, c] = i, b
                    ib[y, x] += i * b
                    bb[y, x] += b * b
    plane = np.zeros((h, w, 3), np.float32)  # factor at the window's centre, its slopes along x and y
    tint = np.zeros((h, w, 3), np.float32)  # channels' own factors, relative
    misfit = np.full((h, w), np.float32(np.inf), np.float32)
    possible = np.zeros((h, w), np.bool_)
    for y in range(h):
        for x in range(w):
            if direct[y, x] > NO_QUESTION and known[y, x]:
                noise = sigma[y, x] * sigma[y, x]
                possible[y, x] = _may_be_shadow(picture, lit, ib, bb, noise, darkest, lightest, color, y, x)
                if possible[y, x]:
                    _fit_window(
                        picture, lit, ib, bb, noise, radius, darkest, lightest, color, y, x, plane, tint, misfit
                    )
    result = np.full((h, w), np.float32(np.inf), np.float32)
    for y in range(h):
        for x in range(w):
            if not possible[y, x]:
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
                        shaded = factor * tint[v, u, c] * lit[y, x, c]
                        left = picture[y, x, c] - shaded
                        own += left * left / (noise + color * color * shaded * shaded)
                    least = min(least, own)
            result[y, x] = np.float32(0.5) * least
    return result


@njit(cache=True, nogil=True)
def _may_be_shadow(picture, lit, ib, bb, noise, darkest, lightest, color, y, x):
    """Whether any factor at all explains this pixel."""
    factor = ib[y, x] / (bb[y, x] + np.float32(1e-6))
    if not (0.7 * darkest < factor < 1.3 * lightest):
        return False
    left = np.float32(0.0)
    for c in range(3):
        b = factor * lit[y, x, c]
        left += (picture[y, x, c] - b) ** 2 / (noise + 4.0 * color * color * b * b)
    return left <= HOPELESS


@njit(cache=True, nogil=True)
def _fit_window(picture, lit, ib, bb, noise, radius, darkest, lightest, color, y, x, plane, tint, misfit):
    """Fit the shadow of the window around (y, x); leaves `misfit` infinite where it can't be one."""
    h, w = ib.shape
    top, bottom = max(0, y - radius), min(h, y + radius + 1)
    first, last = max(0, x - radius), min(w, x + radius + 1)

    # Factor s0 + s1 du + s2 dv, all channels together: normal equations in the moments of B² and I·B
    m00, m10, m01, m20, m11, m02, r0, r1, r2 = 1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6, 0.0, 0.0, 0.0
    for v in range(top, bottom):
        n0, n1, n2, q0, q1 = 0.0, 0.0, 0.0, 0.0, 0.0
        for u in range(first, last):
            du = np.float64(u - x)
            b, r = np.float64(bb[v, u]), np.float64(ib[v, u])
            n0 += b
            n1 += b * du
            n2 += b * du * du
            q0 += r
            q1 += r * du
        dv = np.float64(v - y)
        m00 += n0
        m10 += n1
        m20 += n2
        m01 += n0 * dv
        m11 += n1 * dv
        m02 += n0 * dv * dv
        r0 += q0
        r1 += q1
        r2 += q0 * dv
    c0, c1, c2 = m20 * m02 - m11 * m11, m11 * m01 - m10 * m02, m10 * m11 - m20 * m01
    det = m00 * c0 + m10 * c1 + m01 * c2
    if not det > 1e-9 * m00 * m20 * m02:
        return
    s0 = np.float32((c0 * r0 + c1 * r1 + c2 * r2) / det)
    s1 = np.float32((c1 * r0 + (m00 * m02 - m01 * m01) * r1 + (m10 * m01 - m00 * m11) * r2) / det)
    s2 = np.float32((c2 * r0 + (m10 * m01 - m00 * m11) * r1 + (m00 * m20 - m10 * m10) * r2) / det)
    if not (darkest <= s0 <= lightest):
        return

    # Same colour: the channels' own factors; same texture: what the shadow leaves of the window
    n = 0
    i0, i1, i2, j0, j1, j2, p0, p1, p2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-6, 1e-6, 1e-6
    for v in range(top, bottom):
        for u in range(first, last):
            factor = s0 + s1 * np.float32(u - x) + s2 * np.float32(v - y)
            n += bb[v, u] > 0
            a, p = np.float64(picture[v, u, 0]), np.float64(factor * lit[v, u, 0])
            i0 += a * a
            j0 += a * p
            p0 += p * p
            a, p = np.float64(picture[v, u, 1]), np.float64(factor * lit[v, u, 1])
            i1 += a * a
            j1 += a * p
            p1 += p * p
            a, p = np.float64(picture[v, u, 2]), np.float64(factor * lit[v, u, 2])
            i2 += a * a
            j2 += a * p
            p2 += p * p
    if n < 6:
        return
    t0, t1, t2 = j0 / p0, j1 / p1, j2 / p2
    slack = color * color
    texture = (
        max(0.0, i0 - t0 * j0) / (noise + slack * p0 / n)
        + max(0.0, i1 - t1 * j1) / (noise + slack * p1 / n)
        + max(0.0, i2 - t2 * j2) / (noise + slack * p2 / n)
    )
    hue = (
        (t0 - 1.0) ** 2 / (noise / p0 + slack)
        + (t1 - 1.0) ** 2 / (noise / p1 + slack)
        + (t2 - 1.0) ** 2 / (noise / p2 + slack)
    )
    plane[y, x, 0], plane[y, x, 1], plane[y, x, 2] = s0, s1, s2
    tint[y, x, 0], tint[y, x, 1], tint[y, x, 2] = t0, t1, t2
    misfit[y, x] = TEXTURE_WEIGHT * max(0.0, texture / (3 * n) - 1.0) + hue


@njit(cache=True, nogil=True)
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
    out = evidence.copy()
    edge = np.float32(EDGE)
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
        a = np.float32(np.exp(-np.sqrt(2.0) / (SMOOTHING * np.sqrt(3.0) * 2.0 ** (1 - k) / np.sqrt(15.0))))
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
