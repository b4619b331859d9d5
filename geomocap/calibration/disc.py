"""Least squares measurement of a target: a bright disc, seen a little elliptical, blurred, on a sloping background.

    g(x, y) = (1 − D) (b0 + bx (x − x0) + by (y − y0)) + D a,    D = D(ρ; R, s),
    ρ = ‖M (p − p0)‖,  M = [[1 + e1, e2], [e2, 1 − e1]]

D is a disc of radius R convolved with a Gaussian of standard deviation s, a pixel's own area being part of s (a box
one pixel wide has variance 1/12). The ten unknowns are x0, y0, a, R, s, e1, e2, b0, bx, by; the centre's precision
comes from the normal equations and the residuals, as in least squares matching (Gruen 1985).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

N_UNKNOWNS = 10
_NODES, _WEIGHTS = (a.copy() for a in np.polynomial.legendre.leggauss(12))


@njit(cache=True, nogil=True, error_model="numpy")
def blurred_disc(r, R, s):
    """Return a blurred disc's brightness at distance r from its centre, and the derivatives by r, R and s.

    The brightness is an integral over the chords of the disc, the derivatives are integrals of the Gaussian around its
    rim (divergence theorem), and D's being the same for r, R, s multiplied by one factor gives the last of them.

    Parameters
    ----------
    r, R, s : float
        Distance, radius, standard deviation of the blur, pixels.
    """
    half = min(R, 5.0 * s)
    total = 0.0
    c = 1.0 / (math.sqrt(2.0) * s)
    for k in range(len(_NODES)):
        if _NODES[k] < 0:
            continue  # symmetric
        y = _NODES[k] * half
        h = math.sqrt(R * R - y * y)
        total += _WEIGHTS[k] * math.exp(-y * y * c * c) * (math.erf((h + r) * c) + math.erf((h - r) * c))
    value = total * half * c / math.sqrt(math.pi)
    n = int(12 + 3 * (math.sqrt(r * R) / s))
    by_R = 0.0
    by_r = 0.0
    q = 1.0 / (2 * s * s)
    for k in range(n):  # half the rim at mid-points: spectrally exact for a periodic integrand
        cos = math.cos((k + 0.5) * math.pi / n)
        g = math.exp(-(r * r + R * R - 2 * r * R * cos) * q)
        by_R += g
        by_r -= g * cos
    f = R * 2.0 * (math.pi / n) * q / math.pi
    by_R *= f
    by_r *= f
    return value, by_r, by_R, -(r * by_r + R * by_R) / s


@njit(cache=True, nogil=True, error_model="numpy")
def _drop_surroundings(image, u, part, x0, y0):
    """Take pixels out of `part` that lie outside the target and contradict the background; return how many."""
    m0, m1, m2 = 1.0 + u[5], u[6], 1.0 - u[5]
    rows, columns = part.shape
    errors = np.empty(rows * columns)
    count = 0
    for step in range(2):
        limit = 0.0
        if step == 1:
            if count < 12:
                return 0
            limit = 4.0 * 1.4826 * np.median(np.abs(errors[:count]))
        dropped = 0
        for i in range(rows):
            for j in range(columns):
                if not part[i, j]:
                    continue
                dx, dy = x0 + j - u[0], y0 + i - u[1]
                p, q = m0 * dx + m1 * dy, m1 * dx + m2 * dy
                if math.sqrt(p * p + q * q) < u[3] + 3.0 * u[4] + 0.5:
                    continue
                e = image[y0 + i, x0 + j] - (u[7] + u[8] * dx + u[9] * dy)
                if step == 0:
                    errors[count] = e
                    count += 1
                elif abs(e) > limit:
                    part[i, j] = False
                    dropped += 1
    return dropped


@njit(cache=True, nogil=True, error_model="numpy")
def fit_disc(image, x, y, radius, blur, reach, saturation, result):
    """Fit the target model to an image around a first guess (Levenberg–Marquardt).

    Parameters
    ----------
    image : (H, W) float32
        Grey values.
    x, y : float
        First guess, COLMAP pixels.
    radius, blur : float
        First guesses, pixels.
    reach : float
        Pixels up to radius + reach from the centre take part.
    saturation : float
        Grey value from which pixels are cut off and don't take part (they'd pull nothing if they did).
    result : (16,) float
        Set to the ten unknowns (centre in COLMAP pixels), the standard deviation of unit weight (grey levels), the
        standard deviations of x0 and y0 (pixels), the number of pixels, the iterations, and the ratio of the axes.

    Returns
    -------
    fitted : bool
        Whether it converged inside the image.
    """
    H, W = image.shape
    u = np.zeros(10)
    u[0], u[1], u[3], u[4] = x - 0.5, y - 0.5, radius, blur
    x0 = int(max(0, math.floor(u[0] - radius - reach)))
    x1 = int(min(W - 1, math.ceil(u[0] + radius + reach)))
    y0 = int(max(0, math.floor(u[1] - radius - reach)))
    y1 = int(min(H - 1, math.ceil(u[1] + radius + reach)))
    if x1 - x0 < 4 or y1 - y0 < 4:
        return False
    # Pixels that take part: fixed, so that the cost can be compared between iterations
    limit = (radius + reach) * (radius + reach)
    low, high = 1e9, -1e9
    n = 0
    part = np.zeros((y1 - y0 + 1, x1 - x0 + 1), dtype=np.bool_)
    for i in range(y0, y1 + 1):
        for j in range(x0, x1 + 1):
            dx, dy = j - u[0], i - u[1]
            if dx * dx + dy * dy <= limit:
                value = image[i, j]
                low = min(low, value)
                high = max(high, value)
                if value < saturation:
                    part[i - y0, j - x0] = True
                    n += 1
    if n < 14:
        return False
    u[2] = high
    u[7] = low
    N = np.zeros((10, 10))
    b = np.zeros(10)
    a = np.zeros(10)
    trial = u.copy()
    best_N = N.copy()
    best_b = b.copy()
    cost = np.inf
    damping = 1e-2
    iteration = 0
    last_step = 1e9
    cleaned = False
    while iteration < 60:
        iteration += 1
        N[:] = 0.0
        b[:] = 0.0
        total = 0.0
        m0, m1, m2 = 1.0 + trial[5], trial[6], 1.0 - trial[5]
        for i in range(y0, y1 + 1):
            for j in range(x0, x1 + 1):
                if not part[i - y0, j - x0]:
                    continue
                dx, dy = j - trial[0], i - trial[1]
                p, q = m0 * dx + m1 * dy, m1 * dx + m2 * dy
                r = math.sqrt(p * p + q * q)
                D, by_r, by_R, by_s = blurred_disc(r, trial[3], trial[4])
                ir = 1.0 / max(r, 1e-9)
                ground = trial[7] + trial[8] * dx + trial[9] * dy
                amp = trial[2] - ground
                a[0] = -amp * by_r * (p * m0 + q * m1) * ir - (1 - D) * trial[8]
                a[1] = -amp * by_r * (p * m1 + q * m2) * ir - (1 - D) * trial[9]
                a[2] = D
                a[3] = amp * by_R
                a[4] = amp * by_s
                a[5] = amp * by_r * (p * dx - q * dy) * ir
                a[6] = amp * by_r * (p * dy + q * dx) * ir
                a[7] = 1 - D
                a[8] = (1 - D) * dx
                a[9] = (1 - D) * dy
                e = image[i, j] - (ground + amp * D)
                total += e * e
                for k in range(10):
                    b[k] += a[k] * e
                    for m in range(k, 10):
                        N[k, m] += a[k] * a[m]
        for k in range(10):
            for m in range(k):
                N[k, m] = N[m, k]
        if total <= cost:
            gain = (cost - total) / total if total > 0 else 0.0
            cost = total
            u[:] = trial
            best_N[:] = N
            best_b[:] = b
            damping = max(damping * 0.1, 1e-9)
            if last_step < 1e-4 or gain < 1e-9:
                if cleaned:
                    break
                # Once: leave out what is bright or dark beside the target (the bar itself, other lights)
                cleaned = True
                dropped = _drop_surroundings(image, u, part, x0, y0)
                if dropped > 0 and n - dropped >= 14:
                    n -= dropped
                    cost = np.inf
                    damping = 1e-3
                    last_step = 1e9
                    continue
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
        M = best_N.copy()
        for k in range(10):
            M[k, k] += damping * best_N[k, k] + 1e-9
        step = np.linalg.solve(M, best_b)
        trial = u + step
        last_step = max(abs(step[0]), abs(step[1]))
        trial[3] = min(max(trial[3], 0.3), 3 * radius + 2)
        trial[4] = min(max(trial[4], 0.3), 1 + radius)
        trial[5] = min(max(trial[5], -0.6), 0.6)
        trial[6] = min(max(trial[6], -0.6), 0.6)
        dx, dy = trial[0] - (x - 0.5), trial[1] - (y - 0.5)
        if dx * dx + dy * dy > (radius + 1) * (radius + 1):
            return False
    for k in range(10):
        best_N[k, k] += 1e-9
    Q = np.linalg.inv(best_N)
    sigma0 = math.sqrt(cost / (n - 10))
    result[:10] = u
    result[0] += 0.5
    result[1] += 0.5
    result[10] = sigma0
    result[11] = sigma0 * math.sqrt(Q[0, 0])
    result[12] = sigma0 * math.sqrt(Q[1, 1])
    result[13] = n
    result[14] = iteration
    stretch = math.sqrt(u[5] * u[5] + u[6] * u[6])
    result[15] = (1 + stretch) / (1 - stretch)
    return True
