"""Taking templates of curved patches: grey levels and their slopes along the surface; sampling and poses in kernels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

LEAST_SAMPLES = 0.6
"""Fraction of a template's samples that a camera must show for it to count."""

LEAST_VARIANCE = 0.5
"""Least variance of the grey levels under a patch."""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def bilinear(image, x, y):
    """Interpolate an image at array indices x, y that must lie inside."""
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = image[j, i] * (1 - a) + image[j, i + 1] * a
    low = image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a
    return top * (1 - b) + low * b


@njit(cache=True, nogil=True, error_model="numpy")
def fill_samples(curvature, size, radius, samples):
    """Lay out a patch on a square grid: `samples` (M, 5) s, t, z (m), ∂z/∂s, ∂z/∂t; NaN beyond `radius` steps.

    curvature : (3,) float
        a, b, c of z = a s² + b s t + c t², per metre.
    size : float, metres
        Of a step.
    """
    side = int(math.sqrt(len(samples)) + 0.5)
    a, b, c = curvature
    for q in range(len(samples)):
        i, j = q % side - side // 2, q // side - side // 2
        if abs(i) > radius or abs(j) > radius:
            samples[q] = np.nan
            continue
        s, t = size * i, size * j
        samples[q, 0], samples[q, 1], samples[q, 2] = s, t, a * s * s + b * s * t + c * t * t
        samples[q, 3], samples[q, 4] = 2 * a * s + b * t, b * s + 2 * c * t


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
    A, shape = np.empty((3, 4)), np.empty((M, 5))
    curvature, size, radius = form
    for n in range(begin, end):
        fill_samples(curvature[n], size[n], radius[n], shape)
        for c in range(C):
            if not want[n, c]:
                continue
            slot = slots[n, c]
            local_camera(P[c], X[n], Q[n], A)
            count, offered, total, square = 0, 0, 0.0, 0.0
            for q in range(M):
                usable[slot, q] = 0
                if np.isnan(shape[q, 0]):
                    continue
                offered += 1
                s, t, z, zs, zt = shape[q, 0], shape[q, 1], shape[q, 2], shape[q, 3], shape[q, 4]
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
