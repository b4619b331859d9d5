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
Cameras are weighted with their own residuals, and with how well the place was known at which their templates were
taken: the variance of the place by one camera is that of its image, 2 / (w tr JₛᵀJₛ) along the surface, and that of
its template's. So first templates hold a patch while others come and go. Standard deviations come from the inverse of
the normal matrix. What residuals have beyond the noise of the images is what the model of a rigid piece of surface with
a fixed texture misses, and that goes together over much of a patch: it counts as if only a few of the samples were
independent.

Noise lowers the correlation of two images, most where their texture is weak. What counts is the correlation of what
they show, corrected for attenuation: the noise is taken from both variances (Spearman 1904, "The proof and measurement
of association between two things", American Journal of Psychology 15).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.model.small_systems import cholesky, inverse_diagonal, solve
from geomocap.patches.patch_samples import choose_samples, compare, normal_matrix
from geomocap.patches.patch_templates import LANES, fill_samples, local_camera, set_place, turn_by

_FLOOR = 1.0  # noise of an image that even a perfect fit is granted, grey levels
COHERENT = 0.15  # fraction of the samples over which residuals beyond that go together
_LEAST_SHOWN = 0.5  # fraction of a variance that counts as no noise, at least; no other value was tried
_GAIN = 3.0  # most contrast that an image may lose or win against the template


@njit(cache=True, nogil=True, error_model="numpy")
def align_patches(
    begin,
    end,
    which,
    X,
    Q,
    patches,
    use,
    views,
    level,
    stride,
    use_mask,
    prior,
    iterations,
    least_correlation,
    correlation,
    covariance,
):
    """Align patches with one level of a frame, in place.

    Parameters
    ----------
    begin, end : int
        The part of `which` to align.
    which : (A,) int
        Patches to align.
    X, Q : (N, 3), (N, 3, 3) float
        Places at the start; replaced by those found.
    patches : curvature (N, 3), size, radius (N,), slots (N, C), templates (S, L, M, 3), usable (S, M), doubt (N, C)
        Arrays of `Patches` and of their store. Steps are limited in units of size.
    use : (N, C) uint8
        Cameras to align with.
    views : images (C, H, W) float32, masks (C, H, W) uint8, projections (C, 3, 4), centers (C, 3), noise (C,)
        Arrays of `FrameViews`; the images' noise as a variance.
    level : int
        Level of the templates.
    stride : int
        Use every so many of the samples; 2 is a chequerboard, enough for blurred images.
    use_mask : bool
        Whether samples outside the silhouettes are left out.
    prior : X (N, 3), Q (N, 3, 3), shift (N,), turn (N,)
        Where the patches are expected, and standard deviations of that, metres and radians.
    iterations : int
        At most; 0 only compares.
    least_correlation : float
        Cameras below it are left out while better ones are there.
    correlation : (N, C) float
        Filled: correlation in each camera, free of noise, −1 where it has no part.
    covariance : (N, 6) float
        Filled: variances of shift (m²) and turn (rad²) along the patch's own axes; NaN without solution.
    """
    curvature, size, radius, slots, templates, usable, doubt = patches
    images, masks, P, centers, noise = views
    prior_X, prior_Q, prior_shift, prior_turn = prior
    M = templates.shape[2]
    C, side = use.shape[1], int(math.sqrt(M) + 0.5)
    most = (M + stride - 1) // stride + LANES
    laid_out, index = np.empty((5, most)), np.empty(most, np.int64)
    shape, room, at = np.empty((5, most), np.float32), np.empty((5, most), np.float32), np.empty(most, np.int32)
    shown, T = np.empty((C, most), np.float32), np.empty((C, most), np.float32)
    J = np.empty((C, 6, most), np.float32)
    A, local = np.empty((C, 3, 4), np.float32), np.empty(3, np.float32)
    counts = np.empty(C, np.int64)
    moments = np.empty((C, 14))
    H = np.empty((C, 6, 6))
    b = np.empty((C, 6))
    weights, gains, now = np.empty(C), np.empty(C), np.empty(C)
    N6, L6 = np.zeros((6, 6)), np.zeros((6, 6))
    r6, x6 = np.empty(6), np.empty(6)
    x_n, q_n, q_new = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    best_x, best_q = np.empty(3), np.empty((3, 3))
    for n in which[begin:end]:
        N = fill_samples(curvature[n], size[n], radius[n], side, stride, laid_out, index)
        for r in range(5):
            for k in range(N):
                shape[r, k] = laid_out[r, k]
        set_place(x_n, q_n, X[n], Q[n])
        set_place(best_x, best_q, x_n, q_n)
        best = -2.0
        seen, last, solved = 0, False, False
        for c in range(C):
            correlation[n, c] = now[c] = -1.0
            counts[c] = 0
            if not use[n, c]:
                continue
            local_camera(P[c], x_n, q_n, A[c])
            for r in range(3):
                to = 0.0
                for k in range(3):
                    to += q_n[k, r] * (centers[c, k] - x_n[k])
                local[r] = to
            slot = slots[n, c]
            seen_by = templates[slot, level], usable[slot], masks[c], use_mask, iterations > 0
            filled = room, shown[c], J[c], T[c], moments[c]
            counts[c] = choose_samples(N, A[c], local, shape, index, *seen_by, *filled)
            if counts[c] == 0:
                continue
            seen += 1
            if iterations > 0:
                normal_matrix(N, J[c], moments[c], counts[c], H[c])
        for r in range(6):
            covariance[n, r] = np.nan
        if seen == 0:
            continue
        for step in range(iterations + 1):
            top, score, fraction = -1.0, 0.0, 0.0
            for c in range(C):
                if counts[c] == 0:
                    continue
                if step > 0:
                    local_camera(P[c], x_n, q_n, A[c])
                known = J[c], T[c], moments[c]
                product, variance = compare(
                    N, A[c], shape, shown[c], images[c], counts[c], iterations > 0, *known, b[c], at, room
                )
                variance_t = moments[c, 0]
                now[c] = product / math.sqrt(max(variance, 1e-3) * variance_t)
                gains[c] = min(max(product / max(variance, 1e-3), 1 / _GAIN), _GAIN)
                residual = max(variance_t * (1 - now[c] * abs(now[c])), 0.0)
                misfit = residual * counts[c] / max(counts[c] - 8, 1)
                weights[c] = 1 / (misfit * max(COHERENT * counts[c], 1.0) + _FLOOR**2)
                if iterations > 0:
                    # no camera says more of the place than was known when its template was taken
                    along = 0.5 * weights[c] * (H[c, 0, 0] + H[c, 1, 1] + H[c, 2, 2])
                    weights[c] /= 1 + along * doubt[n, c] ** 2
                shown_t = max(variance_t - noise[c], _LEAST_SHOWN * variance_t)
                shown_now = max(variance - noise[c], _LEAST_SHOWN * variance, 1e-3)
                now[c] = min(max(product / math.sqrt(shown_now * shown_t), -1.0), 1.0)
                top = max(top, now[c])
            for c in range(C):
                if counts[c] == 0:
                    continue
                if now[c] < least_correlation and now[c] < top - 0.05:
                    weights[c] = 0.0
                score += counts[c] * now[c]
                fraction += counts[c]
            score /= fraction
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
            solved = cholesky(N6, L6, 1e-12)
            if not solved:
                break
            solve(L6, r6, x6)
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
        if solved:
            inverse_diagonal(L6, covariance[n])
