"""Taking templates of curved patches: grey levels and their slopes along the surface; sampling and poses in kernels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

LEAST_SAMPLES = 0.6
"""Fraction of a template's samples that a camera must show for it to count."""

LEAST_VARIANCE = 0.5
"""Least variance of the grey levels under a patch."""

LANES = 32
"""Samples that are worked on at once, in vectors of eight."""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def bilinear(image, x, y):
    """Interpolate an image at array indices x, y that must lie inside."""
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = image[j, i] * (1 - a) + image[j, i + 1] * a
    low = image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a
    return top * (1 - b) + low * b


@njit(cache=True, nogil=True, error_model="numpy")
def fill_samples(curvature, size, radius, side, stride, samples, index):
    """Lay out a patch on a square grid; returns the number of samples, a multiple of `LANES`.

    Parameters
    ----------
    curvature : (3,) float
        a, b, c of z = a s² + b s t + c t², per metre.
    size : float, metres
        Of a step.
    radius : int
        Steps from the middle to each side.
    side : int
        Of the grid that templates are on; it has as many columns.
    stride : int
        Every so many places of the grid are samples; of two, a chequerboard.
    samples : (5, N) float
        Filled: s, t, z (m), ∂z/∂s, ∂z/∂t.
    index : (N,) int
        Filled: places in the template; −1: no sample, but one in the middle that nobody sees.
    """
    a, b, c = curvature
    count, width = 0, 2 * radius + 1
    for k in range(0, width * width, stride):
        i, j = k % width - radius, k // width - radius
        s, t = size * i, size * j
        samples[0, count], samples[1, count], samples[2, count] = s, t, a * s * s + b * s * t + c * t * t
        samples[3, count], samples[4, count] = 2 * a * s + b * t, b * s + 2 * c * t
        index[count] = (j + side // 2) * side + i + side // 2
        count += 1
    while count % LANES:
        samples[:, count] = 0.0
        index[count] = -1
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def local_camera(P, X, Q, A):
    """Projection of the patch's own coordinates: P [Q X; 0 1] into `A` (3, 4)."""
    for i in range(3):
        for j in range(3):
            A[i, j] = P[i, 0] * Q[0, j] + P[i, 1] * Q[1, j] + P[i, 2] * Q[2, j]
        A[i, 3] = P[i, 0] * X[0] + P[i, 1] * X[1] + P[i, 2] * X[2] + P[i, 3]


@njit(cache=True, nogil=True, error_model="numpy")
def set_place(X, Q, new_X, new_Q):
    """Overwrite X (3,) and Q (3, 3)."""
    for i in range(3):
        X[i] = new_X[i]
        for j in range(3):
            Q[i, j] = new_Q[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def turn_by(Q, w0, w1, w2, out):
    """Q · exp([w]×) into `out`."""
    angle = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    if angle < 1e-12:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / (angle * angle)
    e00, e11, e22 = 1 - b * (w1 * w1 + w2 * w2), 1 - b * (w0 * w0 + w2 * w2), 1 - b * (w0 * w0 + w1 * w1)
    e01, e10 = b * w0 * w1 - a * w2, b * w0 * w1 + a * w2
    e02, e20 = b * w0 * w2 + a * w1, b * w0 * w2 - a * w1
    e12, e21 = b * w1 * w2 - a * w0, b * w1 * w2 + a * w0
    for i in range(3):
        q0, q1, q2 = Q[i, 0], Q[i, 1], Q[i, 2]
        out[i, 0] = q0 * e00 + q1 * e10 + q2 * e20
        out[i, 1] = q0 * e01 + q1 * e11 + q2 * e21
        out[i, 2] = q0 * e02 + q1 * e12 + q2 * e22


@njit(cache=True, nogil=True, error_model="numpy")
def take_templates(begin, end, X, Q, form, slots, want, levels, masks, P, templates, usable):
    """Take templates of patches in the cameras where `want` is 1.

    Parameters
    ----------
    X, Q : (N, 3), (N, 3, 3) float
        Places of the patches.
    form : curvature (N, 3), size (N,), radius (N,)
        Of the patches, see `fill_samples`.
    slots : (N, C) int
        Where the templates are to be.
    want : (N, C) uint8
        Set to 0 where too little is seen or the texture is too weak.
    levels : (L, C, H, W) float32
    masks : (C, H, W) uint8
    P : (C, 3, 4) float
    templates : (S, L, M, 3) float32
        Filled with grey level and its slopes along s and t, per metre.
    usable : (S, M) uint8
        Filled with 1 where the sample was seen.
    """
    C = want.shape[1]
    L = levels.shape[0]
    H, W = masks.shape[1:]
    M = templates.shape[2]
    side = int(math.sqrt(M) + 0.5)
    A, shape, index = np.empty((3, 4)), np.empty((5, M + LANES)), np.empty(M + LANES, np.int64)
    curvature, size, radius = form
    for n in range(begin, end):
        samples = fill_samples(curvature[n], size[n], radius[n], side, 1, shape, index)
        for c in range(C):
            if not want[n, c]:
                continue
            slot = slots[n, c]
            local_camera(P[c], X[n], Q[n], A)
            count, offered, total, square = 0, 0, 0.0, 0.0
            usable[slot] = 0
            for k in range(samples):
                q = index[k]
                if q < 0:
                    continue
                offered += 1
                s, t, z, zs, zt = shape[0, k], shape[1, k], shape[2, k], shape[3, k], shape[4, k]
                w = A[2, 0] * s + A[2, 1] * t + A[2, 2] * z + A[2, 3]
                if w <= 0:
                    continue
                x = (A[0, 0] * s + A[0, 1] * t + A[0, 2] * z + A[0, 3]) / w
                y = (A[1, 0] * s + A[1, 1] * t + A[1, 2] * z + A[1, 3]) / w
                if not (x >= 1 and y >= 1 and x < W - 2 and y < H - 2):
                    continue
                if masks[c, int(y + 0.5), int(x + 0.5)] == 0:
                    continue
                usable[slot, q] = 1
                count += 1
                # derivatives of the pixel by s, t, z
                xs, ys = (A[0, 0] - x * A[2, 0]) / w, (A[1, 0] - y * A[2, 0]) / w
                xt, yt = (A[0, 1] - x * A[2, 1]) / w, (A[1, 1] - y * A[2, 1]) / w
                xz, yz = (A[0, 2] - x * A[2, 2]) / w, (A[1, 2] - y * A[2, 2]) / w
                for level in range(L):
                    image = levels[level, c]
                    value = bilinear(image, x, y)
                    gx = bilinear(image, x + 0.5, y) - bilinear(image, x - 0.5, y)
                    gy = bilinear(image, x, y + 0.5) - bilinear(image, x, y - 0.5)
                    templates[slot, level, q, 0] = value
                    templates[slot, level, q, 1] = gx * (xs + zs * xz) + gy * (ys + zs * yz)
                    templates[slot, level, q, 2] = gx * (xt + zt * xz) + gy * (yt + zt * yz)
                value = templates[slot, L - 1, q, 0]
                total += value
                square += value * value
            if count < max(LEAST_SAMPLES * offered, 1) or square / count - (total / count) ** 2 < LEAST_VARIANCE:
                want[n, c] = 0
