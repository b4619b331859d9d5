"""Sums over a patch: template values and slopes, normal equations, and the search image under a warp, compiled.

Positions are array indices. Parameters come in the order (dx, a11, a12, dy, a21, a22) of the template's frame.
"""
# mypy: disable-error-code="assignment"

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.matching.spline import ANY_ORDER, cubic_weights, quintic_weights

_F4 = np.float32
_ZERO = _F4(0)
_U1, _U2, _U3, _U4, _U5 = (np.uint64(v) for v in (1, 2, 3, 4, 5))


_VALUE = np.array([[1 / 6, 4 / 6, 1 / 6, 0, 0], [1 / 120, 26 / 120, 66 / 120, 26 / 120, 1 / 120]], np.float32)
_SLOPE = np.array([[-1 / 2, 0, 1 / 2, 0, 0], [-1 / 24, -10 / 24, 0, 10 / 24, 1 / 24]], np.float32)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def padded(n):
    """Length of a row of `n` values in whole vectors; what is beyond has weight 0."""
    return (n + 7) // 8 * 8


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def sample_template(flat, start, stride, order, ix, iy, radius, patches):
    """Fill patches[0:3] with value and slopes of the spline at the pixels around pixel (ix, iy), by separable sums."""
    n = 2 * radius + 1
    wide = padded(n)
    base = start + (iy - radius - order // 2) * stride + ix - radius - order // 2
    w = _VALUE[order // 4]
    d = _SLOPE[order // 4]
    value = patches[4]
    slope = patches[5]
    for i in range(n + order - 1):
        row = base + i * stride
        if order == 3:
            for j in range(wide):
                p = flat[row + j]
                c = flat[row + j + 1]
                q = flat[row + j + 2]
                value[i, j] = w[0] * (p + q) + w[1] * c
                slope[i, j] = d[2] * (q - p)
        else:
            for j in range(wide):
                p = flat[row + j]
                q = flat[row + j + 1]
                c = flat[row + j + 2]
                s = flat[row + j + 3]
                t = flat[row + j + 4]
                value[i, j] = w[0] * (p + t) + w[1] * (q + s) + w[2] * c
                slope[i, j] = d[4] * (t - p) + d[3] * (s - q)
    F, GX, GY = patches[0], patches[1], patches[2]
    for i in range(n):
        if order == 3:
            for j in range(wide):
                F[i, j] = w[0] * (value[i, j] + value[i + 2, j]) + w[1] * value[i + 1, j]
                GX[i, j] = w[0] * (slope[i, j] + slope[i + 2, j]) + w[1] * slope[i + 1, j]
                GY[i, j] = d[2] * (value[i + 2, j] - value[i, j])
        else:
            for j in range(wide):
                outer = value[i, j] + value[i + 4, j]
                inner = value[i + 1, j] + value[i + 3, j]
                F[i, j] = w[0] * outer + w[1] * inner + w[2] * value[i + 2, j]
                outer = slope[i, j] + slope[i + 4, j]
                inner = slope[i + 1, j] + slope[i + 3, j]
                GX[i, j] = w[0] * outer + w[1] * inner + w[2] * slope[i + 2, j]
                GY[i, j] = d[4] * (value[i + 4, j] - value[i, j]) + d[3] * (value[i + 3, j] - value[i + 1, j])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def template_mask(masks, start, stride, ix, iy, radius, W):
    """Fill W with 1 where the template may be used; return their number."""
    n = 2 * radius + 1
    base = start + (iy - radius) * stride + ix - radius
    count = 0
    for i in range(n):
        for j in range(n):
            m = masks[base + i * stride + j]
            W[i, j] = _F4(m)
            count += m
        for j in range(n, padded(n)):
            W[i, j] = _ZERO
    return count


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER, inline="always")
def _add_first_moments(sums, gx, gx_x, gy, gy_x, y):
    """Add a row's sums of ∇F and x ∇F, in the order of the parameters."""
    sums[0] += gx
    sums[1] += gx_x
    sums[2] += gx * y
    sums[3] += gy
    sums[4] += gy_x
    sums[5] += gy * y


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER, inline="always")
def _add_second_moments(sums, g, g_x, g_xx, y):
    """Add a row's sums of a product of slopes times 1, x and x² to those times 1, x, y, x², x y and y²."""
    sums[0] += g
    sums[1] += g_x
    sums[2] += g * y
    sums[3] += g_xx
    sums[4] += g_x * y
    sums[5] += g * y * y


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def normal_equations(patches, radius, count, H, S, q1, qf, moments):
    """Centre F, form the 6×6 normal matrix from row moments and eliminate offset and gain; return Σ F²."""
    n = 2 * radius + 1
    wide = padded(n)
    F, GX, GY, W = patches[0], patches[1], patches[2], patches[3]
    total = 0.0
    for i in range(n):
        row = _ZERO
        for j in range(wide):
            row += F[i, j] * W[i, j]
        total += row
    mean = _F4(total / count)
    S[:] = 0
    q1[:] = 0
    qf[:] = 0
    moments[:] = 0
    moments[3] = mean
    ff = 0.0
    for i in range(n):
        y = float(i - radius)
        a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = _ZERO
        u0 = u1 = v0 = v1 = s0 = s1 = t0 = t1 = fr = m0 = m2 = _ZERO
        for j in range(wide):
            x = _F4(j - radius)
            w = W[i, j]
            X = GX[i, j] * w
            Y = GY[i, j] * w
            f = (F[i, j] - mean) * w
            GX[i, j] = X
            GY[i, j] = Y
            F[i, j] = f
            xx = X * X
            a0 += xx
            xx *= x
            a1 += xx
            a2 += xx * x
            xy = X * Y
            b0 += xy
            xy *= x
            b1 += xy
            b2 += xy * x
            yy = Y * Y
            c0 += yy
            yy *= x
            c1 += yy
            c2 += yy * x
            u0 += X
            u1 += X * x
            v0 += Y
            v1 += Y * x
            xf = X * f
            s0 += xf
            s1 += xf * x
            yf = Y * f
            t0 += yf
            t1 += yf * x
            fr += f * f
            m0 += w
            m2 += w * x * x
        _add_second_moments(S[0], a0, a1, a2, y)
        _add_second_moments(S[1], b0, b1, b2, y)
        _add_second_moments(S[2], c0, c1, c2, y)
        _add_first_moments(q1, u0, u1, v0, v1, y)
        _add_first_moments(qf, s0, s1, t0, t1, y)
        moments[0] += m0
        moments[1] += m2
        moments[2] += m0 * y * y
        ff += fr
    if ff <= 0.0:
        return ff
    for k in range(3):
        i = 0 if k < 2 else 3
        j = 0 if k == 0 else 3
        H[i, j] = S[k, 0]
        H[i, j + 1] = H[i + 1, j] = S[k, 1]
        H[i, j + 2] = H[i + 2, j] = S[k, 2]
        H[i + 1, j + 1] = S[k, 3]
        H[i + 1, j + 2] = H[i + 2, j + 1] = S[k, 4]
        H[i + 2, j + 2] = S[k, 5]
    for i in range(3):
        for j in range(3):
            H[3 + i, j] = H[j, 3 + i]
    for i in range(6):
        for j in range(6):
            H[i, j] -= q1[i] * q1[j] / count + qf[i] * qf[j] / ff
    return ff


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def sample_and_project(flat, start, stride, order, px, py, warp, radius, patches, wx, wy, index, G, sums, b):
    """Sample the search image under the warp and sum what the right side needs, in one pass.

    `sums` receives Σ W G, Σ G², Σ G F of G minus `sums[0]` (a value near the mean); `b` receives Σ G ∇F of the same.
    """
    n = 2 * radius + 1
    wide = padded(n)
    F, GX, GY, W = patches[0], patches[1], patches[2], patches[3]
    ix0 = math.floor(px)
    iy0 = math.floor(py)
    bias = 4 * radius + 8
    x0 = _F4(px - ix0 + bias)
    y0 = _F4(py - iy0 + bias)
    half = order // 2
    origin = start + (iy0 - bias - half) * stride + ix0 - bias - half
    a11 = _F4(warp[0])
    a12 = _F4(warp[1])
    a21 = _F4(warp[2])
    a22 = _F4(warp[3])
    step = np.uint64(stride)
    centre = _F4(sums[0])
    t0 = t1 = t2 = 0.0
    b[:] = 0
    for i in range(n):
        yl = _F4(i - radius)
        bx = x0 + a12 * yl
        by = y0 + a22 * yl
        if order == 3:
            for j in range(wide):
                xl = _F4(min(j, n - 1) - radius)
                X = bx + a11 * xl
                Y = by + a21 * xl
                ix = np.int32(X)
                iy = np.int32(Y)
                index[j] = np.uint64(origin + iy * stride + ix)
                cubic_weights(X - _F4(ix), wx, j)
                cubic_weights(Y - _F4(iy), wy, j)
            for j in range(n):
                # Column sums first: the taps of a row lie side by side in memory
                q = index[j]
                c0 = c1 = c2 = c3 = _ZERO
                for k in range(4):
                    w = wy[k, j]
                    c0 += w * flat[q]
                    c1 += w * flat[q + _U1]
                    c2 += w * flat[q + _U2]
                    c3 += w * flat[q + _U3]
                    q += step
                G[i, j] = wx[0, j] * c0 + wx[1, j] * c1 + wx[2, j] * c2 + wx[3, j] * c3
        else:
            for j in range(wide):
                xl = _F4(min(j, n - 1) - radius)
                X = bx + a11 * xl
                Y = by + a21 * xl
                ix = np.int32(X)
                iy = np.int32(Y)
                index[j] = np.uint64(origin + iy * stride + ix)
                quintic_weights(X - _F4(ix), wx, j)
                quintic_weights(Y - _F4(iy), wy, j)
            for j in range(n):
                q = index[j]
                c0 = c1 = c2 = c3 = c4 = c5 = _ZERO
                for k in range(6):
                    w = wy[k, j]
                    c0 += w * flat[q]
                    c1 += w * flat[q + _U1]
                    c2 += w * flat[q + _U2]
                    c3 += w * flat[q + _U3]
                    c4 += w * flat[q + _U4]
                    c5 += w * flat[q + _U5]
                    q += step
                row = wx[0, j] * c0 + wx[1, j] * c1 + wx[2, j] * c2
                G[i, j] = row + wx[3, j] * c3 + wx[4, j] * c4 + wx[5, j] * c5
        s0 = s1 = s2 = e0 = e1 = e2 = e3 = _ZERO
        for j in range(wide):
            xl = _F4(j - radius)
            g = (G[i, j] - centre) * W[i, j]
            s0 += g
            s1 += g * g
            s2 += g * F[i, j]
            gx = g * GX[i, j]
            e0 += gx
            e1 += gx * xl
            gy = g * GY[i, j]
            e2 += gy
            e3 += gy * xl
        t0 += s0
        t1 += s1
        t2 += s2
        y = float(i - radius)
        _add_first_moments(b, e0, e1, e2, e3, y)
    sums[1] = t0
    sums[2] = t1
    sums[3] = t2
