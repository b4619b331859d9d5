"""Inner loops of the visual hull: what do the cameras say of a whole block?

All kernels that share `classify` stand in this file: Numba's cache notices changes of a kernel's own file only.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.scheduling import spread

BLOCK = 32  # edge of the blocks that are handed to threads: one word of the occupancy, so that no two share any
LEVELS = 5  # blocks of 32, 16, 8, 4 and 2 voxels
BACKGROUND, SUBJECT, UNSEEN, MIXED = 0, 1, 2, 3


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_up(c, masks, out):
    """Fill the table of camera c, which holds zeros."""
    H, W = masks.shape[1:]
    for v in range(H):
        total = np.int32(0)
        for u in range(W):
            total += np.int32(masks[c, v, u])
            out[c, v + 1, u + 1] = total
        for u in range(1, W + 1):
            out[c, v + 1, u] += out[c, v, u]


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_all(begin, end, masks, out):
    for c in range(begin, end):
        _sum_up(c, masks, out)


def summed(masks: np.ndarray) -> np.ndarray:
    """Summed-area tables (C, H + 1, W + 1) int32 of masks (C, H, W) of 0 and 1."""
    C, H, W = masks.shape
    out = np.zeros((C, H + 1, W + 1), np.int32)
    spread(_sum_all, C, masks, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def classify(P, size, subject, seen, unseen, c, x, y, z, dx, dy, dz):
    """Say what camera c says of all points within ±(dx, dy, dz) of (x, y, z), or MIXED if it can't be told.

    `unseen` (C,) tells for which cameras what is outside their view is unseen; for the others it is background.
    For the point X0 in the middle, n(X) − u0 w(X) is linear and 0 at X0, so |u(X) − u0| is at most its largest value
    in the box over the smallest depth there. `size` (C, 2) bounds the sums in numerators and depth: rounding errors
    scale with it.
    """
    H, W = subject.shape[1] - 1, subject.shape[2] - 1
    outside = UNSEEN if unseen[c] else BACKGROUND
    w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
    reach = dx * abs(P[c, 2, 0]) + dy * abs(P[c, 2, 1]) + dz * abs(P[c, 2, 2])
    error = 1e-14 * size[c, 1]
    if w + reach < -error:
        return outside  # behind the camera
    near = w - reach
    if near <= 1e6 * error:
        # the camera's own plane cuts the box: u < 0 where n < 0, and u >= W where n − W w >= 0, linear functions
        for a in range(2):
            n = P[c, a, 0] * x + P[c, a, 1] * y + P[c, a, 2] * z + P[c, a, 3]
            limit = W if a == 0 else H
            low = dx * abs(P[c, a, 0]) + dy * abs(P[c, a, 1]) + dz * abs(P[c, a, 2])
            high = dx * abs(P[c, a, 0] - limit * P[c, 2, 0]) + dy * abs(P[c, a, 1] - limit * P[c, 2, 1])
            high += dz * abs(P[c, a, 2] - limit * P[c, 2, 2])
            slack = 1e-14 * size[c, 0] + limit * error
            if n + low < -slack or n - limit * w - high > slack:
                return outside
        return MIXED
    u = (P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 2] * z + P[c, 0, 3]) / w
    v = (P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 2] * z + P[c, 1, 3]) / w
    inverse = 1.0 / near
    du = dx * abs(P[c, 0, 0] - u * P[c, 2, 0]) + dy * abs(P[c, 0, 1] - u * P[c, 2, 1])
    du = (du + dz * abs(P[c, 0, 2] - u * P[c, 2, 2])) * inverse
    dv = dx * abs(P[c, 1, 0] - v * P[c, 2, 0]) + dy * abs(P[c, 1, 1] - v * P[c, 2, 1])
    dv = (dv + dz * abs(P[c, 1, 2] - v * P[c, 2, 2])) * inverse
    du += 1e-6 + (1e-14 * size[c, 0] + error * (abs(u) + du)) * inverse
    dv += 1e-6 + (1e-14 * size[c, 0] + error * (abs(v) + dv)) * inverse
    left, right, top, bottom = u - du, u + du, v - dv, v + dv
    if right < 0.0 or bottom < 0.0 or left >= W or top >= H:
        return outside
    inside = left >= 0.0 and top >= 0.0 and right < W and bottom < H
    u0, v0 = int(max(left, 0.0)), int(max(top, 0.0))
    u1, v1 = int(min(right, W - 1.0)) + 1, int(min(bottom, H - 1.0)) + 1
    area = (u1 - u0) * (v1 - v0)
    filled = subject[c, v1, u1] - subject[c, v0, u1] - subject[c, v1, u0] + subject[c, v0, u0]
    if inside and filled == area:
        return SUBJECT
    if filled > 0:
        return MIXED
    if not unseen[c]:
        return BACKGROUND
    visible = seen[c, v1, u1] - seen[c, v0, u1] - seen[c, v1, u0] + seen[c, v0, u0]
    if visible == 0:
        return UNSEEN
    return BACKGROUND if inside and visible == area else MIXED


@njit(cache=True, nogil=True, error_model="numpy")
def _carve_block(
    corner_i,
    corner_j,
    corner_k,
    P,
    size,
    masks,
    valid,
    subject,
    seen,
    unseen,
    tolerance,
    min_views,
    origin,
    edge,
    Z,
    bits,
):
    """Carve the block with this corner, depth first; further parameters as of `carve`.

    A node of the stack is (x, y, z index of its corner, level, cameras undecided about its parent, subject votes,
    background votes); `cameras[level]` lists the undecided ones for all children of one parent, which follow each
    other on the stack.
    """
    C = P.shape[0]
    H, W = masks.shape[1], masks.shape[2]
    X, Y = bits.shape[:2]
    cameras = np.empty((LEVELS + 1, C), np.int64)
    stack = np.empty((7 * LEVELS + 1, 7), np.int64)
    for c in range(C):
        cameras[0, c] = c
    stack[0, 0] = corner_i
    stack[0, 1] = corner_j
    stack[0, 2] = corner_k
    stack[0, 3] = 0
    stack[0, 4] = C
    stack[0, 5] = 0
    stack[0, 6] = 0
    top = 1
    while top > 0:
        top -= 1
        i0, j0, k0, level = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        n, n_subject, n_background = stack[top, 4], stack[top, 5], stack[top, 6]
        step = BLOCK >> level
        i1, j1, k1 = min(i0 + step, X), min(j0 + step, Y), min(k0 + step, Z)
        # what do the undecided cameras say of the whole block?
        x = origin[0] + (i0 + i1) * 0.5 * edge
        y = origin[1] + (j0 + j1) * 0.5 * edge
        z = origin[2] + (k0 + k1) * 0.5 * edge
        dx, dy, dz = (i1 - i0 - 1) * 0.5 * edge, (j1 - j0 - 1) * 0.5 * edge, (k1 - k0 - 1) * 0.5 * edge
        mixed = 0
        for q in range(n):
            c = cameras[level, q]
            answer = classify(P, size, subject, seen, unseen, c, x, y, z, dx, dy, dz)
            if answer == MIXED:
                cameras[level + 1, mixed] = c
                mixed += 1
            elif answer == SUBJECT:
                n_subject += 1
            elif answer == BACKGROUND:
                n_background += 1
                if n_background > tolerance:
                    break
        views = n_subject + n_background
        if n_background > tolerance or views + mixed < min_views:
            continue
        if n_background + mixed <= tolerance and views >= min_views:
            word = np.uint32(((1 << (k1 - k0)) - 1) << (k0 & 31))
            for i in range(i0, i1):
                for j in range(j0, j1):
                    bits[i, j, k0 >> 5] |= word
            continue
        if step > 2:
            step //= 2
            for part in range(8):
                i, j, k = i0 + step * (part & 1), j0 + step * ((part >> 1) & 1), k0 + step * (part >> 2)
                if i < i1 and j < j1 and k < k1:
                    stack[top, 0] = i
                    stack[top, 1] = j
                    stack[top, 2] = k
                    stack[top, 3] = level + 1
                    stack[top, 4] = mixed
                    stack[top, 5] = n_subject
                    stack[top, 6] = n_background
                    top += 1
            continue
        # too small to divide: every voxel by itself, in the cameras that are undecided
        for i in range(i0, i1):
            x = origin[0] + (i + 0.5) * edge
            for j in range(j0, j1):
                y = origin[1] + (j + 0.5) * edge
                for k in range(k0, k1):
                    z = origin[2] + (k + 0.5) * edge
                    against, views = n_background, n_subject + n_background
                    for q in range(mixed):
                        c = cameras[level + 1, q]
                        w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
                        u = v = -1.0
                        if w > 0.0:
                            u = (P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 2] * z + P[c, 0, 3]) / w
                            v = (P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 2] * z + P[c, 1, 3]) / w
                        on_canvas = u >= 0.0 and v >= 0.0 and u < W and v < H
                        if on_canvas and masks[c, int(v), int(u)]:
                            views += 1
                        elif not unseen[c] or (on_canvas and valid[c, int(v), int(u)]):
                            against += 1
                            views += 1
                        if against > tolerance:
                            break
                    if against <= tolerance and views >= min_views:
                        bits[i, j, k >> 5] |= np.uint32(1 << (k & 31))


def block_count(bits: np.ndarray) -> int:
    """Count the blocks of an occupancy (X, Y, Z / 32)."""
    X, Y, nz = bits.shape
    return ((X + BLOCK - 1) // BLOCK) * ((Y + BLOCK - 1) // BLOCK) * nz


@njit(cache=True, nogil=True, error_model="numpy")
def carve(begin, end, P, size, masks, valid, subject, seen, unseen, tolerance, min_views, origin, edge, Z, bits):
    """Carve the blocks from `begin` to `end`, counted along z first."""
    nz = bits.shape[2]
    ny = (bits.shape[1] + BLOCK - 1) // BLOCK
    for b in range(begin, end):
        i, j, k = b // (ny * nz) * BLOCK, b // nz % ny * BLOCK, b % nz * BLOCK
        _carve_block(i, j, k, P, size, masks, valid, subject, seen, unseen, tolerance, min_views, origin, edge, Z, bits)


@njit(cache=True, nogil=True, error_model="numpy")
def possible_parts(P, size, subject, seen, unseen, tolerance, min_views, origin, edge, cells):
    """Divide cells into eight each, of size `edge`, and list those parts that may hold a point of the hull.

    Every camera either may see the subject there, or can't tell. Of each cell the parts are in the order of x, y, z.
    """
    half = 0.5 * edge
    parts = np.empty((8 * len(cells), 3), np.int64)
    count = 0
    for n in range(len(cells)):
        for part in range(8):
            i, j, k = 2 * cells[n, 0] + (part >> 2), 2 * cells[n, 1] + ((part >> 1) & 1), 2 * cells[n, 2] + (part & 1)
            x, y, z = origin[0] + (i + 0.5) * edge, origin[1] + (j + 0.5) * edge, origin[2] + (k + 0.5) * edge
            against, views = 0, 0
            for c in range(P.shape[0]):
                answer = classify(P, size, subject, seen, unseen, c, x, y, z, half, half, half)
                views += answer != UNSEEN
                against += answer == BACKGROUND
                if against > tolerance:
                    break
            if against <= tolerance and views >= min_views:
                parts[count, 0], parts[count, 1], parts[count, 2] = i, j, k
                count += 1
    return parts[:count].copy()
