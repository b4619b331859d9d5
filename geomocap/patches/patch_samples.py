"""The samples of a patch in one camera: which are seen there, their Jacobian, and what the image shows at them.

All that is done for each sample is done for all of them, seen or not, in single precision and in loops that run over
eight at once; those that are not seen count nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.matching.spline import ANY_ORDER
from geomocap.patches.patch_templates import LEAST_SAMPLES, LEAST_VARIANCE

_F4 = np.float32
_ZERO, _HALF, _ONE = _F4(0), _F4(0.5), _F4(1)
_LEAST_FACING_SQUARE = _F4(0.2**2)  # cosine between normal and viewing ray below which a sample is not used, squared
_LEAST_COUNT = 12


@njit(cache=True, nogil=True, error_model="numpy")
def choose_samples(
    N, A, center, shape, index, template, usable, mask, use_mask, with_slopes, room, seen, J, T, moments
):
    """Choose the samples of one camera and form their Jacobian.

    Parameters
    ----------
    N : int
        Samples; arrays may have room for more.
    A : (3, 4) float32
        Projection of the patch's own coordinates.
    center : (3,) float32
        Of the camera, in these coordinates, metres.
    shape, index : (5, N) float32, (N,) int
        Of the samples, see `fill_samples`.
    template, usable : (M, 3) float32, (M,) uint8
        Of the camera.
    mask, use_mask : (H, W) uint8, bool
        Silhouette, and whether samples outside are left out.
    with_slopes : bool
        Whether `J` is wanted.
    room : (5, N) float32
        Overwritten.
    seen : (N,) float32
        Filled: 1 where a sample is seen, else 0.
    J, T : (6, N), (N,) float32
        Filled: Jacobian and grey levels less their mean, 0 where a sample is not seen.
    moments : (14,) float
        Filled: variance and mean of the grey levels; mean of each row of J, and how much of the grey levels is in it.
        Free of offset and gain a row is J − mean − T · that.

    Returns
    -------
    int
        Number of samples that are seen; 0: too few.
    """
    x, y, front, along, across = room[0], room[1], room[2], room[3], room[4]
    H, W = mask.shape
    c0, c1, c2 = center[0], center[1], center[2]
    a00, a01, a02, a03 = A[0, 0], A[0, 1], A[0, 2], A[0, 3]
    a10, a11, a12, a13 = A[1, 0], A[1, 1], A[1, 2], A[1, 3]
    a20, a21, a22, a23 = A[2, 0], A[2, 1], A[2, 2], A[2, 3]
    right, bottom = _F4(W - 2), _F4(H - 2)
    for k in range(N):
        s, t, z, zs, zt = shape[0, k], shape[1, k], shape[2, k], shape[3, k], shape[4, k]
        d0, d1, d2 = s - c0, t - c1, z - c2
        facing = zs * d0 + zt * d1 - d2  # along the outward normal (−z_s, −z_t, 1), towards the camera
        least = _LEAST_FACING_SQUARE * (d0 * d0 + d1 * d1 + d2 * d2) * (_ONE + zs * zs + zt * zt)
        w = a20 * s + a21 * t + a22 * z + a23
        closeness = _ONE / w
        u = (a00 * s + a01 * t + a02 * z + a03) * closeness
        v = (a10 * s + a11 * t + a12 * z + a13) * closeness
        inside = (u >= _ONE) & (v >= _ONE) & (u < right) & (v < bottom) & (w > _ZERO)
        x[k], y[k], front[k] = u, v, facing
        seen[k] = _F4(inside & (facing > _ZERO) & (facing * facing >= least))
    count, offered = np.int64(0), np.int64(0)  # no literal: Numba would compile what is called for it, too
    for k in range(N):
        q = index[k]
        there = q >= 0 and usable[q] != 0
        offered += there
        there = there and seen[k] > _ZERO
        if there and use_mask:
            there = mask[int(y[k] + _HALF), int(x[k] + _HALF)] != 0
        count += there
        if there:
            T[k], along[k], across[k] = template[q, 0], template[q, 1], template[q, 2]
            seen[k] = _ONE
        else:
            T[k], along[k], across[k], seen[k], front[k] = _ZERO, _ZERO, _ZERO, _ZERO, _ONE
    if count < LEAST_SAMPLES * offered or count < _LEAST_COUNT:
        return 0
    moments[1] = sum_of(T, N) / count
    mean = _F4(moments[1])
    for k in range(N):
        T[k] -= mean * seen[k]
    variance = sum_of_products(T, T, N)
    if variance < LEAST_VARIANCE * count:
        return 0
    moments[0] = variance / count
    if not with_slopes:
        return count
    for k in range(N):
        s, t, z, ts, tt = shape[0, k], shape[1, k], shape[2, k], along[k], across[k]
        g2 = (ts * (s - c0) + tt * (t - c1)) / front[k]
        g0, g1 = ts - shape[3, k] * g2, tt - shape[4, k] * g2
        J[0, k], J[1, k], J[2, k] = g0, g1, g2
        J[3, k], J[4, k], J[5, k] = t * g2 - z * g1, z * g0 - s * g2, s * g1 - t * g0
    for r in range(6):
        moments[2 + r] = sum_of(J[r], N) / count
        moments[8 + r] = sum_of_products(J[r], T, N) / variance
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def normal_matrix(N, J, moments, count, H):
    """Lower triangle of the normal matrix of a Jacobian (6, N) free of offset and gain, see `choose_samples`."""
    for r in range(6):
        for k in range(r + 1):
            shared = count * (moments[2 + r] * moments[2 + k] + moments[0] * moments[8 + r] * moments[8 + k])
            H[r, k] = sum_of_products(J[r], J[k], N) - shared


@njit(cache=True, nogil=True, error_model="numpy")
def compare(N, A, shape, seen, image, count, with_slopes, J, T, moments, b, at, room):
    """Sample the image: right side Σ J̃ I into `b`; returns its covariance with T and its variance.

    In three loops, of which only the middle one reads here and there: `at` (N,) and `room` (3, N) get its pixels, the
    fractions of a pixel, and what it found, less the template's mean.
    """
    aside, below, values = room[0], room[1], room[2]
    H, W = image.shape
    a00, a01, a02, a03 = A[0, 0], A[0, 1], A[0, 2], A[0, 3]
    a10, a11, a12, a13 = A[1, 0], A[1, 1], A[1, 2], A[1, 3]
    a20, a21, a22, a23 = A[2, 0], A[2, 1], A[2, 2], A[2, 3]
    right, bottom, width = _F4(W) - _F4(1.001), _F4(H) - _F4(1.001), np.int32(W)
    for k in range(N):
        s, t, z = shape[0, k], shape[1, k], shape[2, k]
        w = _ONE / (a20 * s + a21 * t + a22 * z + a23)
        x = (a00 * s + a01 * t + a02 * z + a03) * w
        y = (a10 * s + a11 * t + a12 * z + a13) * w
        # what isn't a number is 0, too: no pixel outside is read
        x, y = x if x > _ZERO else _ZERO, y if y > _ZERO else _ZERO
        x, y = x if x < right else right, y if y < bottom else bottom
        column, row = np.int32(x), np.int32(y)
        at[k] = row * width + column
        aside[k] = x - _F4(column)
        below[k] = y - _F4(row)
    pixels = image.reshape(-1)
    mean = _F4(moments[1])
    for k in range(N):
        first = np.uint32(at[k])
        second = np.uint32(first + np.uint32(W))
        top = pixels[first] + aside[k] * (pixels[first + np.uint32(1)] - pixels[first])
        low = pixels[second] + aside[k] * (pixels[second + np.uint32(1)] - pixels[second])
        values[k] = seen[k] * (top + below[k] * (low - top) - mean)
    total, square = sum_of(values, N), sum_of_products(values, values, N)
    product = sum_of_products(values, T, N)
    if with_slopes:
        for r in range(6):
            b[r] = sum_of_products(J[r], values, N) - moments[2 + r] * total - moments[8 + r] * product
    return product / count, square / count - (total / count) ** 2


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def sum_of(a, count):
    """Sum of the first `count` of `a` (S,) float32."""
    total = _ZERO
    for i in range(count):
        total += a[i]
    return np.float64(total)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def sum_of_products(a, b, count):
    """Sum of the first `count` products of `a` and `b` (S,) float32."""
    total = _ZERO
    for i in range(count):
        total += a[i] * b[i]
    return np.float64(total)
