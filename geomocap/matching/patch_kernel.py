"""The inner loops of least squares matching: one template patch against its counterparts, compiled.

`lsm` states the equations; here stand the loops. Positions are array indices. A warp is (x, y) + A (dx, dy) with the
affine matrix A held as (a11, a12, a21, a22). Parameter increments come in the order
(dx, a11, a12, dy, a21, a22) of the template's frame.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.matching.patch_covariance import covariance
from geomocap.matching.patch_sums import normal_equations, sample_and_project, sample_template, template_mask
from geomocap.model.small_systems import cholesky, solve

# What became of a point, in the order of `lsm.REASONS`
MATCHED, OUTSIDE_TEMPLATE, LOW_TEXTURE, OUTSIDE_SEARCH, NOT_CONVERGED, DEGENERATE = range(6)
CORRELATION, SIGMA, PRECISION, SHIFT, EPIPOLAR, UNTRIED = range(6, 12)

STATUS, CORR, ITERATIONS, SIGMA0, CXX, CXY, CYY, GAIN, OFFSET, EPI, INVERSE_DEPTH, COLUMNS = range(12)

ACTIVE, START_X, START_Y, MEAN, VARIANCE = range(5)


@njit(cache=True, nogil=True, error_model="numpy")
def workspace(radius, images):
    """Allocate the buffers of `match_patch` for patches up to `radius` and so many search images."""
    n = 2 * radius + 1
    width = (n + 7) // 8 * 8
    return (
        np.zeros((6, n + 6, width), np.float32),
        np.zeros((6, width), np.float32),
        np.zeros((6, width), np.float32),
        np.zeros(width, np.uint64),
        np.zeros((n, width), np.float32),
        np.zeros((6, 6)),
        np.zeros((5, 6, 6)),
        np.zeros((11, 6)),
        np.zeros((images, 6, 6)),
        np.zeros((images, 4, 6)),
        np.zeros((images, 5)),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def transfer(T, mu, x, y, out):
    """Where the template point (x, y) at inverse depth `mu` is seen, and its derivative by `mu`, into out[0:4]."""
    p0 = T[0] * x + T[1] * y + T[2]
    p1 = T[3] * x + T[4] * y + T[5]
    p2 = T[6] * x + T[7] * y + T[8]
    w = p2 + mu * T[11]
    if not w > 1e-9:
        return False
    out[0] = (p0 + mu * T[9]) / w
    out[1] = (p1 + mu * T[10]) / w
    out[2] = (T[9] - out[0] * T[11]) / w
    out[3] = (T[10] - out[1] * T[11]) / w
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def inverse_depth(transfers, x, y, position, use):
    """Inverse depth whose projections lie nearest to the positions in the images in use (algebraic least squares)."""
    num = den = 0.0
    for k in range(len(use)):
        if use[k]:
            T = transfers[k]
            p0 = T[0] * x + T[1] * y + T[2]
            p1 = T[3] * x + T[4] * y + T[5]
            p2 = T[6] * x + T[7] * y + T[8]
            ax = T[9] - position[k, 0] * T[11]
            ay = T[10] - position[k, 1] * T[11]
            cx = p0 - position[k, 0] * p2
            cy = p1 - position[k, 1] * p2
            num -= ax * cx + ay * cy
            den += ax * ax + ay * ay
    return num / den if den > 0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def match_patch(stack, template, searches, transfers, x, y, radius, control, wanted, position, affine, quality, work):
    """Match the patch around template index position (x, y) in all search images at once.

    Parameters
    ----------
    stack : tuple
        `ImageStack.arrays`.
    template : int
    searches : (K,) int64
        Their numbers in the stack.
    transfers : (K, 12) float
        Epipolar geometry of each search image (see `transfer`).
    radius : int
        Of the patch, pixels.
    control : tuple
        sigma_condition : standard deviation of the condition that the rays meet, pixels; 0: no condition;
        iterations, tolerance : their limit, and the step at which they end, pixels;
        minimum_contrast : least standard deviation of the template's grey levels;
        max_shift : farthest that a position may move from its start, pixels; 0: anywhere;
        patience, hopeless : an image is given up whose correlation is below `hopeless` after `patience` iterations, or
        below half of it after half as many.
    wanted : (K,) uint8
        1 for the search images to match in.
    position : (K, 2) float, affine : (K, 4) float
        Start and result, changed in place.
    quality : (K, COLUMNS) float
        Written.
    work : tuple
        From `workspace`.

    Returns
    -------
    matched : int
        Number of images in which the adjustment converged.
    """
    flat, masks, layout, order = stack
    sigma_condition, iterations, tolerance, minimum_contrast, max_shift, patience, hopeless = control
    patches, wx, wy, index, G, N, small, v, factors, systems, state = work
    q1, qf, b, d, moments, sums, point = v[0], v[1], v[2], v[3], v[8], v[9], v[10]
    L0 = small[4]
    images = len(searches)
    start, stride, height, width = layout[template]
    for k in range(images):
        quality[k, :] = 0
        quality[k, STATUS] = OUTSIDE_TEMPLATE
    if not (x - radius >= 0.5 and y - radius >= 0.5 and x + radius <= width - 1.5 and y + radius <= height - 1.5):
        return 0
    # The patch stands on the pixels around the nearest one; the affine carries its result to the point itself.
    ix = int(x + 0.5)
    iy = int(y + 0.5)
    ox = x - ix
    oy = y - iy
    count = template_mask(masks, start, stride, ix, iy, radius, patches[3])
    if count < 0.4 * (2 * radius + 1) ** 2:
        return 0
    sample_template(flat, start, stride, order, ix, iy, radius, patches)
    ff = normal_equations(patches, radius, count, N, small[0, 0:3], q1, qf, moments)
    for k in range(images):
        quality[k, STATUS] = LOW_TEXTURE
    if ff <= count * minimum_contrast * minimum_contrast or not cholesky(N, L0):
        return 0
    use = state[:, ACTIVE]
    for k in range(images):
        use[k] = wanted[k]
        quality[k, STATUS] = NOT_CONVERGED if wanted[k] else UNTRIED
        position[k, 0] -= affine[k, 0] * ox + affine[k, 1] * oy
        position[k, 1] -= affine[k, 2] * ox + affine[k, 3] * oy
        state[k, START_X] = position[k, 0]
        state[k, START_Y] = position[k, 1]
        state[k, MEAN] = flat[_nearest(layout[searches[k]], position[k, 0], position[k, 1])]
    condition = sigma_condition > 0
    weight = 1.0 / (sigma_condition * sigma_condition) if condition else 0.0
    mu = inverse_depth(transfers, ix, iy, position, use)
    running = images
    for _ in range(iterations):
        for k in range(images):
            if use[k] == 0.0 or (quality[k, STATUS] == MATCHED and not condition):
                continue
            start, stride, height, width = layout[searches[k]]
            A = affine[k]
            px = position[k, 0]
            py = position[k, 1]
            ex = (abs(A[0]) + abs(A[1])) * radius
            ey = (abs(A[2]) + abs(A[3])) * radius
            inside = px - ex >= 0 and py - ey >= 0 and px + ex <= width - 1 and py + ey <= height - 1
            if not inside or ex > 3 * radius or ey > 3 * radius:
                quality[k, STATUS] = DEGENERATE if inside else OUTSIDE_SEARCH
                use[k] = 0.0
                continue
            sums[0] = state[k, MEAN]
            sample_and_project(flat, start, stride, order, px, py, A, radius, patches, wx, wy, index, G, sums, b)
            off = sums[1] / count
            gg = sums[2] - count * off * off
            gain = sums[3] / gg if gg > 0 else 0.0
            correlation = sums[3] / math.sqrt(gg * ff) if gg > 0 else 0.0
            quality[k, ITERATIONS] += 1
            quality[k, CORR] = correlation
            quality[k, GAIN] = gain
            state[k, MEAN] += off
            state[k, VARIANCE] = ff * max(1.0 - correlation * correlation, 1e-8) / (count - 8)
            # What correlates with nothing after some steps will not come right
            done = quality[k, ITERATIONS]
            if not gain > 0 or (
                2 * done >= patience and correlation < (hopeless if done >= patience else hopeless / 2)
            ):
                quality[k, STATUS] = CORRELATION
                use[k] = 0.0
                continue
            # The residual stands on the search image, not on f: its fraction along f goes with the gain
            fraction = correlation * correlation
            for i in range(6):
                systems[k, 0, i] = gain * (b[i] - off * q1[i]) - fraction * qf[i]
        # Solve: each image for itself, or all through the one unknown that they share, the inverse depth.
        step = 0.0
        if condition:
            s = t = 0.0
            for k in range(images):
                if use[k] == 0.0:
                    continue
                if not transfer(transfers[k], mu, ix, iy, point):
                    quality[k, STATUS] = DEGENERATE
                    use[k] = 0.0
                    continue
                A = affine[k]
                inverse = 1.0 / state[k, VARIANCE]
                rx = position[k, 0] - point[0]
                ry = position[k, 1] - point[1]
                for i in range(6):
                    systems[k, 0, i] *= inverse
                    systems[k, 1, i] = 0.0
                    for j in range(6):
                        small[0, i, j] = N[i, j] * inverse
                small[0, 0, 0] += weight * (A[0] * A[0] + A[2] * A[2])
                small[0, 3, 0] += weight * (A[0] * A[1] + A[2] * A[3])
                small[0, 3, 3] += weight * (A[1] * A[1] + A[3] * A[3])
                systems[k, 0, 0] += weight * (A[0] * rx + A[2] * ry)
                systems[k, 0, 3] += weight * (A[1] * rx + A[3] * ry)
                systems[k, 1, 0] = weight * (A[0] * point[2] + A[2] * point[3])
                systems[k, 1, 3] = weight * (A[1] * point[2] + A[3] * point[3])
                cholesky(small[0], factors[k])
                solve(factors[k], systems[k, 0], systems[k, 2])
                solve(factors[k], systems[k, 1], systems[k, 3])
                s += weight * (point[2] * point[2] + point[3] * point[3])
                t += weight * (point[2] * rx + point[3] * ry)
                for i in (0, 3):
                    s -= systems[k, 1, i] * systems[k, 3, i]
                    t -= systems[k, 1, i] * systems[k, 2, i]
            if s > 0:
                step = t / s
            mu += step
        running = 0
        for k in range(images):
            if use[k] == 0.0 or (quality[k, STATUS] == MATCHED and not condition):
                continue
            if condition:
                for i in range(6):
                    d[i] = systems[k, 2, i] - systems[k, 3, i] * step
            else:
                solve(L0, systems[k, 0], d)
            if not _compose(position[k], affine[k], d):
                quality[k, STATUS] = DEGENERATE
                use[k] = 0.0
                continue
            if max_shift > 0:
                dx = position[k, 0] - state[k, START_X]
                dy = position[k, 1] - state[k, START_Y]
                if not dx * dx + dy * dy <= max_shift * max_shift:
                    quality[k, STATUS] = SHIFT
                    use[k] = 0.0
                    continue
            linear = d[1] * d[1] + d[2] * d[2] + d[4] * d[4] + d[5] * d[5]
            moved = d[0] * d[0] + d[3] * d[3] + linear * radius * radius
            if moved <= tolerance * tolerance:
                quality[k, STATUS] = MATCHED
            else:
                quality[k, STATUS] = NOT_CONVERGED
                running += 1
        if running == 0:
            break
    matched = 0
    for k in range(images):
        if quality[k, STATUS] != MATCHED:
            use[k] = 0.0
            continue
        px, py, s2 = position[k, 0], position[k, 1], state[k, VARIANCE]
        quality[k, SIGMA0] = math.sqrt(s2)
        quality[k, OFFSET] = moments[3] - quality[k, GAIN] * state[k, MEAN]
        out = quality[k, CXX : CYY + 1]
        if not covariance(order, ox, oy, radius, N, moments, s2, px, py, affine[k], small, v, out):
            quality[k, STATUS] = LOW_TEXTURE
            use[k] = 0.0
            continue
        position[k, 0] += affine[k, 0] * ox + affine[k, 1] * oy
        position[k, 1] += affine[k, 2] * ox + affine[k, 3] * oy
        matched += 1
    mu = inverse_depth(transfers, x, y, position, use)
    for k in range(images):
        quality[k, INVERSE_DEPTH] = mu
        if use[k] != 0.0 and transfer(transfers[k], mu, x, y, point):
            length = math.sqrt(point[2] * point[2] + point[3] * point[3])
            if length > 0:
                rx = position[k, 0] - point[0]
                ry = position[k, 1] - point[1]
                quality[k, EPI] = abs(rx * point[3] - ry * point[2]) / length
    return matched


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(layout, x, y):
    """Index of the coefficient nearest to (x, y), kept inside the image."""
    ix = min(max(int(x + 0.5), 0), layout[3] - 1)
    iy = min(max(int(y + 0.5), 0), layout[2] - 1)
    return layout[0] + iy * layout[1] + ix


@njit(cache=True, nogil=True, error_model="numpy")
def _compose(position, A, d):
    """Replace the warp W(p) by W(p) ∘ W(d)⁻¹; False if it can't be."""
    d11 = 1.0 + d[1]
    d12 = d[2]
    d21 = d[4]
    d22 = 1.0 + d[5]
    det = d11 * d22 - d12 * d21
    if not (det > 0.1 and abs(d[0]) < 1e3 and abs(d[3]) < 1e3):
        return False
    i11 = d22 / det
    i12 = -d12 / det
    i21 = -d21 / det
    i22 = d11 / det
    tx = -(i11 * d[0] + i12 * d[3])
    ty = -(i21 * d[0] + i22 * d[3])
    position[0] += A[0] * tx + A[1] * ty
    position[1] += A[2] * tx + A[3] * ty
    a, b, c, e = A[0], A[1], A[2], A[3]
    A[0] = a * i11 + b * i21
    A[1] = a * i12 + b * i22
    A[2] = c * i11 + e * i21
    A[3] = c * i12 + e * i22
    return True
