"""A-posteriori covariance of a matched position, compiled; `lsm` states the equations."""

from __future__ import annotations

import math

from numba import njit

from geomocap.matching.spline import NOISE_SLOPE, NOISE_VALUE
from geomocap.model.small_systems import cholesky, solve

_TWO_PI = 2 * math.pi


@njit(cache=True, nogil=True, error_model="numpy")
def noise_kept(order, x, y, a11, a12, a21, a22, radius):
    """Fraction of white noise that spline values of a warped patch keep on average (product of two `NOISE_VALUE`).

    The mean of cos 2π(x + u i + v j) over the square patch is cos 2πx D(u) D(v) with D the Dirichlet kernel.
    """
    row = 0 if order == 3 else 1
    a0 = NOISE_VALUE[row, 0]
    a1 = NOISE_VALUE[row, 1]
    n = 2 * radius + 1
    dx = _dirichlet(a11, n) * _dirichlet(a12, n)
    dy = _dirichlet(a21, n) * _dirichlet(a22, n)
    both = _dirichlet(a11 + a21, n) * _dirichlet(a12 + a22, n)
    minus = _dirichlet(a11 - a21, n) * _dirichlet(a12 - a22, n)
    cx = math.cos(_TWO_PI * x) * dx
    cy = math.cos(_TWO_PI * y) * dy
    product = 0.5 * (math.cos(_TWO_PI * (x + y)) * both + math.cos(_TWO_PI * (x - y)) * minus)
    return a0 * a0 + a0 * a1 * (cx + cy) + a1 * a1 * product


@njit(cache=True, nogil=True, error_model="numpy")
def _dirichlet(u, n):
    u -= math.floor(u + 0.5)
    s = math.sin(math.pi * u)
    if abs(s) < 1e-9:
        return 1.0
    return math.sin(math.pi * n * u) / (n * s)


@njit(cache=True, nogil=True, error_model="numpy")
def covariance(order, ox, oy, radius, H, moments, s2, px, py, warp, M, v, out):
    """A-posteriori covariance of a position in the search image, with noise in both images.

    The position is the counterpart of the template point (ox, oy) off the patch's central pixel; (px, py) is that of
    the central pixel. Returns False where the slopes are mere noise.
    """
    variance = s2 / (1.0 + noise_kept(order, px, py, warp[0], warp[1], warp[2], warp[3], radius))
    slope_noise = variance * NOISE_SLOPE[order // 4]
    # Noise in the template's slopes adds to the normal matrix what no signal backs.
    slopes, clean, L, half = M[0], M[1], M[2], M[3]
    slopes[:] = 0
    for k in range(3):
        slopes[k, k] = slopes[3 + k, 3 + k] = slope_noise * moments[k]
    for i in range(6):
        for j in range(6):
            clean[i, j] = H[i, j] - slopes[i, j]
            half[i, j] = H[i, j] - 0.5 * slopes[i, j]
    if not cholesky(clean, L):
        return False
    e, gx, gy, tx = v[4], v[5], v[6], v[7]
    e[:] = 0
    e[0], e[1], e[2] = 1.0, ox, oy
    solve(L, e, gx)
    e[:] = 0
    e[3], e[4], e[5] = 1.0, ox, oy
    solve(L, e, gy)
    for i in range(6):
        tx[i] = 0.0
        e[i] = 0.0
        for j in range(6):
            tx[i] += half[i, j] * gx[j]
            e[i] += half[i, j] * gy[j]
    cxx = cxy = cyy = 0.0
    for i in range(6):
        cxx += gx[i] * tx[i]
        cxy += gy[i] * tx[i]
        cyy += gy[i] * e[i]
    scale = 2 * variance
    a, b, c, d = warp[0], warp[1], warp[2], warp[3]
    out[0] = scale * (a * a * cxx + 2 * a * b * cxy + b * b * cyy)
    out[1] = scale * (a * c * cxx + (a * d + b * c) * cxy + b * d * cyy)
    out[2] = scale * (c * c * cxx + 2 * c * d * cxy + d * d * cyy)
    return True
