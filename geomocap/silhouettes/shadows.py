"""Shadows: how well the background under a shadow or reflection explains a pixel."""

from __future__ import annotations

import numpy as np
from numba import njit

TEXTURE_WEIGHT = 8.0  # independent samples that the texture of a window counts for: its neighbours vote as well
NO_QUESTION = 5.0  # pixels with less misfit are background without more ado
HOPELESS = 25.0  # chi-square of a pixel's colour beyond which no shadow explains it
SHADOW_RADIUS = 2  # half width of the windows that compare texture, pixels
SHADOW_LIGHTEST = 1.1  # brightness of the strongest reflection on the background (ratio)
SHADOW_COLOR = 0.03  # how much a shadow may change colour, and brightness within the window (ratio)
RING = 8  # rows that are kept at once; a power of two beyond the height of two windows


@njit(cache=True, nogil=True, error_model="numpy")
def shadow_misfit(direct, image, mean, sigma, known, gain, offset, darkest, limit):
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
    limit : float
        Misfit from which a shadow explains nothing.

    Returns
    -------
    (H, W) float32
        Half the chi-square of colour, texture and hue; infinite from the limit on and where no shadow is possible or
        asked for.
    """
    h, w = known.shape
    darkest, most = np.float64(darkest), np.float32(2.0 * limit)
    radius, lightest, color = SHADOW_RADIUS, SHADOW_LIGHTEST, SHADOW_COLOR
    result = np.full((h, w), np.float32(np.inf), np.float32)
    # Row y of the image is kept in row y modulo RING of these, between borders of zeros, until no window needs it
    wide = w + 2 * radius
    picture = np.zeros((RING, 3, wide))  # 0 where unknown, as the next three
    lit = np.zeros((RING, 3, wide), np.float32)
    ib, bb = np.empty((RING, wide), np.float32), np.empty((RING, wide), np.float32)  # sums over channels of I·B and B²
    # Of each window's row: sums of B², B² u, B² u², I·B, I·B u; of the squares of the channels, and what is known
    moments, squares = np.empty((RING, 5, w)), np.empty((RING, 4, w), np.int32)
    values, spare = np.zeros((4, wide), np.int32), np.empty(w)
    possible = np.empty((RING, w), np.bool_)
    count = np.empty(RING, np.int64)  # of what is possible in a row
    plane = np.empty((RING, w, 3), np.float32)  # factor at the window's centre, its slopes along x and y
    tint = np.empty((RING, w, 3), np.float32)  # channels' own factors, relative
    misfit = np.empty((RING, w), np.float32)
    for step in range(h + 2 * radius):
        if step < h:
            k = step & (RING - 1)
            inner = slice(radius, radius + w)
            _light_row(image[step], mean[step], known[step], gain, offset, picture[k], lit[k], inner, values)
            _sum_products(picture[k], lit[k], ib[k], bb[k])
            _sum_moments(bb[k], moments[k, 0], moments[k, 1], moments[k, 2])
            _sum_moments(ib[k], moments[k, 3], moments[k, 4], spare)
            for c in range(4):
                _sum_five(values[c], squares[k, c])
            count[k] = 0
            for x in range(w):
                misfit[k, x] = np.inf
                possible[k, x] = False
                if direct[step, x] > NO_QUESTION and known[step, x]:
                    noise = sigma[step, x] * sigma[step, x]
                    possible[k, x] = _may_be_shadow(
                        picture, lit, ib, bb, noise, darkest, lightest, color, k, x + radius
                    )
                    count[k] += possible[k, x]
        y = step - radius
        if 0 <= y < h and count[y & (RING - 1)] > 0:
            for x in range(w):
                if possible[y & (RING - 1), x]:
                    noise = sigma[y, x] * sigma[y, x]
                    _fit_window(
                        picture, lit, moments, squares, noise, radius, darkest, lightest, color, y, x, h, plane, tint,
                        misfit,
                    )  # fmt: skip
        y = step - 2 * radius
        if y < 0 or count[y & (RING - 1)] == 0:
            continue
        for x in range(w):
            if not possible[y & (RING - 1), x]:
                continue
            noise = sigma[y, x] * sigma[y, x]
            least = most
            for v in range(y - radius, y + radius + 1, radius):
                q = v & (RING - 1)
                for u in range(x - radius, x + radius + 1, radius):
                    if v < 0 or v >= h or u < 0 or u >= w or misfit[q, u] >= least:
                        continue
                    own = misfit[q, u]
                    factor = plane[q, u, 0] + plane[q, u, 1] * (x - u) + plane[q, u, 2] * (y - v)
                    for c in range(3):
                        shaded = factor * tint[q, u, c] * lit[y & (RING - 1), c, x + radius]
                        left = np.float32(picture[y & (RING - 1), c, x + radius]) - shaded
                        own += left * left / (noise + color * color * shaded * shaded)
                    least = min(least, own)
            if least < most:
                result[y, x] = np.float32(0.5) * least
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _light_row(image, mean, known, gain, offset, picture, lit, inner, values):
    """Fill in a row of the picture, of the lit background, of the channels' squares and of what is known, else 0."""
    for c in range(3):
        i, b, square = picture[c, inner], lit[c, inner], values[c, inner]
        g, o = gain[c], offset[c]
        for x in range(known.size):
            i[x] = np.float64(image[x, c]) if known[x] else 0.0
            b[x] = g * mean[x, c] + o if known[x] else np.float32(0.0)
            square[x] = np.int32(image[x, c]) * np.int32(image[x, c]) if known[x] else 0
    seen = values[3, inner]
    for x in range(known.size):
        seen[x] = known[x]


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_products(picture, lit, ib, bb):
    """Sum I·B and B² of a row over the channels."""
    i0, i1, i2 = picture[0], picture[1], picture[2]
    b0, b1, b2 = lit[0], lit[1], lit[2]
    for x in range(ib.size):
        ib[x] = np.float32(i0[x]) * b0[x] + np.float32(i1[x]) * b1[x] + np.float32(i2[x]) * b2[x]
        bb[x] = b0[x] * b0[x] + b1[x] * b1[x] + b2[x] * b2[x]


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_moments(b, n0, n1, n2):
    """Moments of a row of values (N + 4,) about each place: sums of b, b u and b u² over u = -2 … 2."""
    for x in range(n0.size):
        a0, a1, a2 = np.float64(b[x]), np.float64(b[x + 1]), np.float64(b[x + 2])
        a3, a4 = np.float64(b[x + 3]), np.float64(b[x + 4])
        n0[x] = a0 + a1 + a2 + a3 + a4
        n1[x] = -2.0 * a0 - a1 + a3 + 2.0 * a4
        n2[x] = 4.0 * a0 + a1 + a3 + 4.0 * a4


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_five(values, sums):
    """Sum each five values (N + 4,) of a row, (N,)."""
    for x in range(sums.size):
        sums[x] = values[x] + values[x + 1] + values[x + 2] + values[x + 3] + values[x + 4]


@njit(cache=True, nogil=True, error_model="numpy")
def _may_be_shadow(picture, lit, ib, bb, noise, darkest, lightest, color, k, x):
    """Whether any factor at all explains this pixel."""
    factor = ib[k, x] / (bb[k, x] + np.float32(1e-6))
    if not (0.7 * darkest < factor < 1.3 * lightest):
        return False
    left = np.float32(0.0)
    for c in range(3):
        b = factor * lit[k, c, x]
        left += (np.float32(picture[k, c, x]) - b) ** 2 / (noise + 4.0 * color * color * b * b)
    return left <= HOPELESS


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_window(picture, lit, moments, squares, noise, radius, darkest, lightest, color, y, x, h, plane, tint, misfit):
    """Fit the shadow of the window around (y, x); leaves `misfit` infinite where it can't be one."""
    top, bottom = max(0, y - radius), min(h, y + radius + 1)

    # Factor s0 + s1 du + s2 dv, all channels together: normal equations in the moments of B² and I·B
    m00, m10, m01, m20, m11, m02, r0, r1, r2 = 1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6, 0.0, 0.0, 0.0
    i0, i1, i2, n = 0, 0, 0, 0
    for v in range(top, bottom):
        k = v & (RING - 1)
        dv = np.float64(v - y)
        m00 += moments[k, 0, x]
        m10 += moments[k, 1, x]
        m20 += moments[k, 2, x]
        m01 += moments[k, 0, x] * dv
        m11 += moments[k, 1, x] * dv
        m02 += moments[k, 0, x] * dv * dv
        r0 += moments[k, 3, x]
        r1 += moments[k, 4, x]
        r2 += moments[k, 3, x] * dv
        i0 += squares[k, 0, x]
        i1 += squares[k, 1, x]
        i2 += squares[k, 2, x]
        n += squares[k, 3, x]
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
    if n < 6:
        return
    j0, j1, j2, p0, p1, p2 = 0.0, 0.0, 0.0, 1e-6, 1e-6, 1e-6
    for v in range(top, bottom):
        k = v & (RING - 1)
        for u in range(2 * SHADOW_RADIUS + 1):
            factor = s0 + s1 * np.float32(u - SHADOW_RADIUS) + s2 * np.float32(v - y)
            p = np.float64(factor * lit[k, 0, x + u])
            j0 += picture[k, 0, x + u] * p
            p0 += p * p
            p = np.float64(factor * lit[k, 1, x + u])
            j1 += picture[k, 1, x + u] * p
            p1 += p * p
            p = np.float64(factor * lit[k, 2, x + u])
            j2 += picture[k, 2, x + u] * p
            p2 += p * p
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
    k = y & (RING - 1)
    plane[k, x, 0], plane[k, x, 1], plane[k, x, 2] = s0, s1, s2
    tint[k, x, 0], tint[k, x, 1], tint[k, x, 2] = t0, t1, t2
    misfit[k, x] = TEXTURE_WEIGHT * max(0.0, texture / (3 * n) - 1.0) + hue
