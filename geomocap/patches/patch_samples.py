"""The samples of a patch in one camera: which are seen there, their Jacobian, and what the image shows at them."""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.matching.spline import ANY_ORDER
from geomocap.patches.patch_templates import LEAST_SAMPLES, LEAST_VARIANCE

_LEAST_FACING = 0.2  # cosine between normal and viewing ray below which a sample is not used


@njit(cache=True, nogil=True, error_model="numpy")
def choose_samples(A, center, shape, template, usable, mask, use_mask, with_slopes, stride, places, J, T, moments):
    """Choose the samples of one camera and form their Jacobian, free of offset and gain.

    Returns the number of samples; 0 if too few are seen. Filled are the samples' `places` (3, M) in the patch, their
    Jacobian `J` (6, M), grey levels `T` (M,) and, in `moments`, the variance of these.
    """
    M = len(shape)
    H, W = mask.shape
    count, offered = np.int64(0), 0  # no literal: Numba would compile what is called for it, too
    mean_t = 0.0
    for q in range(0, M, stride):
        if not usable[q]:
            continue
        offered += 1
        s, t, z, zs, zt = shape[q, 0], shape[q, 1], shape[q, 2], shape[q, 3], shape[q, 4]
        d0, d1, d2 = s - center[0], t - center[1], z - center[2]
        facing = zs * d0 + zt * d1 - d2  # along the outward normal (−z_s, −z_t, 1), towards the camera
        if facing * facing < _LEAST_FACING**2 * (d0 * d0 + d1 * d1 + d2 * d2) * (1 + zs * zs + zt * zt) or facing <= 0:
            continue
        w = A[2, 0] * s + A[2, 1] * t + A[2, 2] * z + A[2, 3]
        if w <= 0:
            continue
        closeness = 1.0 / w
        x = (A[0, 0] * s + A[0, 1] * t + A[0, 2] * z + A[0, 3]) * closeness
        y = (A[1, 0] * s + A[1, 1] * t + A[1, 2] * z + A[1, 3]) * closeness
        if not (x >= 1 and y >= 1 and x < W - 2 and y < H - 2):
            continue
        if use_mask and mask[int(y + 0.5), int(x + 0.5)] == 0:
            continue
        places[0, count], places[1, count], places[2, count] = s, t, z
        T[count] = template[q, 0]
        mean_t += template[q, 0]
        if with_slopes:
            ts, tt = template[q, 1], template[q, 2]
            g2 = (ts * d0 + tt * d1) / facing
            g0, g1 = ts - zs * g2, tt - zt * g2
            J[0, count], J[1, count], J[2, count] = g0, g1, g2
            J[3, count], J[4, count], J[5, count] = t * g2 - z * g1, z * g0 - s * g2, s * g1 - t * g0
        count += 1
    if count < LEAST_SAMPLES * offered or count < 12:
        return 0
    mean_t /= count
    for i in range(count):
        T[i] -= mean_t
    variance = sum_of_products(T, T, count)
    if variance < LEAST_VARIANCE * count:
        return 0
    moments[0] = variance / count
    if not with_slopes:
        return count
    for r in range(6):
        mean = sum_of(J[r], count) / count
        along = sum_of_products(J[r], T, count) / variance
        for i in range(count):
            J[r, i] -= mean + T[i] * along
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def compare(A, places, image, count, with_slopes, J, T, b, at, aside, below, values):
    """Sample the image: right side Σ J̃ I into `b`; returns its covariance with T and its variance.

    In three loops, of which only the middle one reads here and there: `at`, `aside`, `below`, `values` (M,) are its
    pixels, the fractions of a pixel, and what it found.
    """
    H, W = image.shape
    a00, a01, a02, a03 = A[0, 0], A[0, 1], A[0, 2], A[0, 3]
    a10, a11, a12, a13 = A[1, 0], A[1, 1], A[1, 2], A[1, 3]
    a20, a21, a22, a23 = A[2, 0], A[2, 1], A[2, 2], A[2, 3]
    for i in range(count):
        s, t, z = places[0, i], places[1, i], places[2, i]
        w = 1.0 / (a20 * s + a21 * t + a22 * z + a23)
        x = (a00 * s + a01 * t + a02 * z + a03) * w
        y = (a10 * s + a11 * t + a12 * z + a13) * w
        x = min(max(x, 0.0), W - 1.001)
        y = min(max(y, 0.0), H - 1.001)
        column, row = np.int32(x), np.int32(y)
        at[i] = row * np.int32(W) + column
        aside[i] = x - column
        below[i] = y - row
    pixels = image.reshape(-1)
    for i in range(count):
        first = np.uint32(at[i])
        second = np.uint32(first + np.uint32(W))
        top = pixels[first] + aside[i] * (pixels[first + np.uint32(1)] - pixels[first])
        low = pixels[second] + aside[i] * (pixels[second + np.uint32(1)] - pixels[second])
        values[i] = top + below[i] * (low - top)
    total, square = sum_of(values, count), sum_of_products(values, values, count)
    product = sum_of_products(values, T, count)
    if with_slopes:
        for r in range(6):
            b[r] = sum_of_products(J[r], values, count)
    return product / count, square / count - (total / count) ** 2


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def sum_of(a, count):
    """Sum of the first `count` of `a` (S,) float32, in double precision."""
    total = 0.0
    for i in range(count):
        total += np.float64(a[i])
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def sum_of_products(a, b, count):
    """Sum of the first `count` products of `a` and `b` (S,) float32, in double precision."""
    total = 0.0
    for i in range(count):
        total += np.float64(a[i]) * np.float64(b[i])
    return total
