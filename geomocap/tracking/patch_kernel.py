"""Aligning a curved patch of the surface with all the images that see it: six degrees of freedom, all cameras at once.

A patch is a small piece of surface in a frame of its own, p = (s, t, z(s, t)), placed in the world by x = X + Q p. In
camera c it has a template T_c(p), taken where that camera saw it well. Under a rigid motion of the patch each image
must show its template again, up to gain and offset:

    T_c(p) + e = k_c I_c(π_c(X + Q p)) + o_c

Unknown are three shifts and three turns *shared by all cameras*, written in the patch's own frame: p → p + δ + ω × p.
The texture lies in the surface: its slopes along it, (∂T/∂s, ∂T/∂t), are taken once with the template, and the gradient
in space that a camera sees now is the one vector g with these slopes that is orthogonal to the viewing ray d,

    g·(1, 0, z_s) = T_s,   g·(0, 1, z_t) = T_t,   g·d = 0,     J = (g, p × g).

The Jacobian is thus formed once an alignment and not once an iteration (inverse composition: Baker, Matthews 2004,
"Lucas–Kanade 20 years on"), and an iteration costs one interpolation a sample. Offset and gain are projected out of J.
Cameras are weighted with their own residuals; standard deviations come from the inverse of the normal matrix. What
residuals have beyond the noise of the images is what the model of a rigid piece of surface with a fixed texture misses,
and that goes together over much of a patch: it counts as if only a few of the samples were independent.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from geomocap.matching.spline import FAST
from geomocap.tracking.patch_templates import (
    LEAST_SAMPLES,
    LEAST_VARIANCE,
    bilinear,
    local_camera,
    set_place,
    solve_normal,
    turn_by,
)

LEAST_FACING = 0.2
"""Cosine between normal and viewing ray below which a sample is not used."""

_FLOOR = 2.0  # noise of an image that even a perfect fit is granted, grey levels
COHERENT = 0.15  # share of the samples over which residuals beyond that go together
_GAIN = 3.0  # most contrast that an image may lose or win against the template


@njit(cache=True, nogil=True, fastmath=FAST)
def _prepare(A, center, shape, template, usable, mask, use_mask, with_slopes, stride, samples, J, T, moments):
    """Choose the samples of one camera and form their Jacobian, free of offset and gain.

    Returns the number of samples; 0 if too few are seen. `moments`: variance of the template.
    """
    M = len(shape)
    H, W = mask.shape
    count, offered = 0, 0
    mean_t = 0.0
    mean_j = np.zeros(6)
    for q in range(0, M, stride):
        if not usable[q]:
            continue
        offered += 1
        s, t, z, zs, zt = shape[q, 0], shape[q, 1], shape[q, 2], shape[q, 3], shape[q, 4]
        d0, d1, d2 = s - center[0], t - center[1], z - center[2]
        facing = zs * d0 + zt * d1 - d2  # along the outward normal (−z_s, −z_t, 1), towards the camera
        if facing * facing < LEAST_FACING**2 * (d0 * d0 + d1 * d1 + d2 * d2) * (1 + zs * zs + zt * zt) or facing <= 0:
            continue
        w = A[2, 0] * s + A[2, 1] * t + A[2, 2] * z + A[2, 3]
        if w <= 0:
            continue
        x = (A[0, 0] * s + A[0, 1] * t + A[0, 2] * z + A[0, 3]) / w
        y = (A[1, 0] * s + A[1, 1] * t + A[1, 2] * z + A[1, 3]) / w
        if not (x >= 1 and y >= 1 and x < W - 2 and y < H - 2):
            continue
        if use_mask and mask[int(y + 0.5), int(x + 0.5)] == 0:
            continue
        samples[count] = q
        T[count] = template[q, 0]
        mean_t += template[q, 0]
        count += 1
        if not with_slopes:
            continue
        ts, tt = template[q, 1], template[q, 2]
        g2 = (ts * d0 + tt * d1) / facing
        g0, g1 = ts - zs * g2, tt - zt * g2
        i = count - 1
        J[i, 0], J[i, 1], J[i, 2] = g0, g1, g2
        J[i, 3], J[i, 4], J[i, 5] = t * g2 - z * g1, z * g0 - s * g2, s * g1 - t * g0
        for r in range(6):
            mean_j[r] += J[i, r]
    if count < LEAST_SAMPLES * offered or count < 12:
        return 0
    mean_t /= count
    variance = 0.0
    along = np.zeros(6)
    for r in range(6):
        mean_j[r] /= count
    for i in range(count):
        T[i] -= mean_t
        variance += T[i] * T[i]
        if with_slopes:
            for r in range(6):
                J[i, r] -= mean_j[r]
                along[r] += J[i, r] * T[i]
    if variance < LEAST_VARIANCE * count:
        return 0
    if with_slopes:
        for i in range(count):
            for r in range(6):
                J[i, r] -= T[i] * along[r] / variance
    moments[0] = variance / count
    return count


@njit(cache=True, nogil=True, fastmath=FAST)
def _compare(A, shape, image, samples, count, with_slopes, J, T, b):
    """Sample the image: right side Σ J̃ I into `b`; returns its covariance with T and its variance."""
    H, W = image.shape
    total, square, product = 0.0, 0.0, 0.0
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(count):
        q = samples[i]
        s, t, z = shape[q, 0], shape[q, 1], shape[q, 2]
        w = 1.0 / (A[2, 0] * s + A[2, 1] * t + A[2, 2] * z + A[2, 3])
        x = (A[0, 0] * s + A[0, 1] * t + A[0, 2] * z + A[0, 3]) * w
        y = (A[1, 0] * s + A[1, 1] * t + A[1, 2] * z + A[1, 3]) * w
        x = min(max(x, 0.0), W - 1.001)
        y = min(max(y, 0.0), H - 1.001)
        value = bilinear(image, x, y)
        total += value
        square += value * value
        product += value * T[i]
        if not with_slopes:
            continue
        b0 += J[i, 0] * value
        b1 += J[i, 1] * value
        b2 += J[i, 2] * value
        b3 += J[i, 3] * value
        b4 += J[i, 4] * value
        b5 += J[i, 5] * value
    b[0], b[1], b[2], b[3], b[4], b[5] = b0, b1, b2, b3, b4, b5
    return product / count, square / count - (total / count) ** 2


@njit(cache=True, nogil=True, fastmath=FAST)
def _align_one(
    n,
    X,
    Q,
    shape,
    size,
    rows,
    templates,
    usable,
    use,
    images,
    level,
    stride,
    masks,
    use_mask,
    P,
    centers,
    prior_X,
    prior_Q,
    prior_shift,
    prior_turn,
    iterations,
    least_correlation,
    correlation,
    covariance,
):
    """Align patch `n`; parameters as of `align_patches`."""
    M = shape.shape[1]
    C = use.shape[1]
    A = np.empty((C, 3, 4))
    J = np.zeros((C, M, 6), np.float32)
    T = np.empty((C, M), np.float32)
    samples = np.empty((C, M), np.int64)
    counts = np.zeros(C, np.int64)
    variance_t = np.zeros(C)
    H = np.zeros((C, 6, 6))
    b = np.zeros((C, 6))
    moments = np.zeros(1)
    weights = np.zeros(C)
    gains = np.zeros(C)
    N6, L6 = np.zeros((6, 6)), np.zeros((6, 6))
    r6, x6, local = np.zeros(6), np.zeros(6), np.zeros(3)
    x_n, q_n, q_new = X[n].copy(), Q[n].copy(), np.zeros((3, 3))
    best_x, best_q, best = x_n.copy(), q_n.copy(), -2.0
    seen, last = 0, False
    for c in range(C):
        correlation[n, c] = -1.0
        if not use[n, c]:
            continue
        local_camera(P[c], x_n, q_n, A[c])
        for r in range(3):
            local[r] = 0.0
            for k in range(3):
                local[r] += q_n[k, r] * (centers[c, k] - x_n[k])
        counts[c] = _prepare(
            A[c],
            local,
            shape[n],
            templates[rows[n], c, level],
            usable[rows[n], c],
            masks[c],
            use_mask,
            iterations > 0,
            stride,
            samples[c],
            J[c],
            T[c],
            moments,
        )
        if counts[c] == 0:
            continue
        seen += 1
        variance_t[c] = moments[0]
        if iterations > 0:
            for i in range(counts[c]):
                for r in range(6):
                    for k in range(r + 1):
                        H[c, r, k] += J[c, i, r] * J[c, i, k]
    for r in range(6):
        covariance[n, r] = np.nan
    if seen == 0:
        return
    now = np.full(C, -1.0)
    for step in range(iterations + 1):
        top, score, share = -1.0, 0.0, 0.0
        for c in range(C):
            if counts[c] == 0:
                continue
            if step > 0:
                local_camera(P[c], x_n, q_n, A[c])
            product, variance = _compare(
                A[c], shape[n], images[c], samples[c], counts[c], iterations > 0, J[c], T[c], b[c]
            )
            now[c] = product / math.sqrt(max(variance, 1e-3) * variance_t[c])
            gains[c] = min(max(product / max(variance, 1e-3), 1 / _GAIN), _GAIN)
            residual = max(variance_t[c] * (1 - now[c] * abs(now[c])), 0.0)
            misfit = residual * counts[c] / max(counts[c] - 8, 1)
            weights[c] = 1 / (misfit * max(COHERENT * counts[c], 1.0) + _FLOOR**2)
            top = max(top, now[c])
        for c in range(C):
            if counts[c] == 0:
                continue
            if now[c] < least_correlation and now[c] < top - 0.05:
                weights[c] = 0.0
            score += counts[c] * now[c]
            share += counts[c]
        score /= share
        if score > best:
            best = score
            set_place(best_x, best_q, x_n, q_n)
            for c in range(C):
                correlation[n, c] = now[c]
        elif step > 2 and score < best - 0.1:
            break
        if iterations == 0:
            break
        # shared normal equations of all cameras, with the expected place as an observation
        for r in range(6):
            sd = prior_shift[n] if r < 3 else prior_turn[n]
            r6[r] = 0.0
            for k in range(r + 1):
                N6[r, k] = 0.0
            for c in range(C):
                if counts[c] == 0:
                    continue
                for k in range(r + 1):
                    N6[r, k] += weights[c] * H[c, r, k]
                r6[r] -= weights[c] * gains[c] * b[c, r]
            if r < 3:
                away = 0.0
                for k in range(3):
                    away += q_n[k, r] * (prior_X[n, k] - x_n[k])
            else:
                i, j = (r - 2) % 3, (r - 1) % 3  # ω_r = (R_ji − R_ij) / 2 of R = Qᵀ Q_prior
                away = 0.0
                for k in range(3):
                    away += 0.5 * (q_n[k, j] * prior_Q[n, k, i] - q_n[k, i] * prior_Q[n, k, j])
            N6[r, r] += 1 / (sd * sd)
            r6[r] += away / (sd * sd)
        if not solve_normal(N6, r6, L6, x6):
            break
        if last or step == iterations:
            break
        shift = math.sqrt(x6[0] ** 2 + x6[1] ** 2 + x6[2] ** 2)
        turn = math.sqrt(x6[3] ** 2 + x6[4] ** 2 + x6[5] ** 2)
        scale = min(1.0, 4 * size[n] / max(shift, 1e-12), 0.3 / max(turn, 1e-12))
        for r in range(3):
            x_n[r] += scale * (q_n[r, 0] * x6[0] + q_n[r, 1] * x6[1] + q_n[r, 2] * x6[2])
        turn_by(q_n, scale * x6[3], scale * x6[4], scale * x6[5], q_new)
        set_place(x_n, q_n, x_n, q_new)
        last = shift < 0.01 * size[n] and turn < 1e-3
    set_place(X[n], Q[n], best_x, best_q)
    if iterations > 0 and L6[5, 5] > 0:
        for r in range(6):
            for k in range(6):
                r6[k] = 1.0 if k == r else 0.0
            if solve_normal(N6, r6, L6, x6):
                covariance[n, r] = x6[r]


@njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def align_patches(
    which,
    X,
    Q,
    shape,
    size,
    rows,
    templates,
    usable,
    use,
    images,
    level,
    stride,
    masks,
    use_mask,
    P,
    centers,
    prior_X,
    prior_Q,
    prior_shift,
    prior_turn,
    iterations,
    least_correlation,
    correlation,
    covariance,
):
    """Align patches with one level of a frame, in place.

    Parameters
    ----------
    which : (A,) int
        Patches to align.
    X, Q : (N, 3), (N, 3, 3) float
        Places at the start; replaced by those found.
    shape : (N, M, 5) float
    size : (N,) float
        What a pixel covers on the patch, metres: the unit in which steps are limited.
    rows : (N,) int
        Where the patches have their templates.
    templates : (R, C, L, M, 3) float32
    usable : (R, C, M) uint8
    use : (N, C) uint8
        Cameras to align with.
    images : (C, H, W) float32
    level : int
        Level of the templates.
    stride : int
        Use every so many of the samples; 2 is a chequerboard, enough for blurred images.
    masks : (C, H, W) uint8
    use_mask : bool
        Whether samples outside the silhouettes are left out.
    P, centers : (C, 3, 4), (C, 3) float
    prior_X, prior_Q : (N, 3), (N, 3, 3) float
        Where the patches are expected.
    prior_shift, prior_turn : (N,) float
        Standard deviations of that, metres and radians.
    iterations : int
        At most; 0 only compares.
    least_correlation : float
        Cameras below it are left out while better ones are there.
    correlation : (N, C) float
        Filled: correlation in each camera, −1 where it has no part.
    covariance : (N, 6) float
        Filled: variances of shift (m²) and turn (rad²) along the patch's own axes; NaN without solution.
    """
    for a in prange(len(which)):
        _align_one(
            which[a],
            X,
            Q,
            shape,
            size,
            rows,
            templates,
            usable,
            use,
            images,
            level,
            stride,
            masks,
            use_mask,
            P,
            centers,
            prior_X,
            prior_Q,
            prior_shift,
            prior_turn,
            iterations,
            least_correlation,
            correlation,
            covariance,
        )
