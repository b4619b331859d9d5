"""Correlation of one template patch laid on a plane in object space, compiled.

Conventions as in `plane_sweep`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.matching.grow_kernel import plane_start


@njit(cache=True, nogil=True, error_model="numpy")
def _correlate(flat, start, height, width, f, offsets, variance, position, affine, radius):
    """Normalised correlation of the centred template samples `f` at `offsets` with an image under a warp, bilinear."""
    ex = (abs(affine[0]) + abs(affine[1])) * radius
    ey = (abs(affine[2]) + abs(affine[3])) * radius
    px, py = position
    if not (px - ex >= 0 and py - ey >= 0 and px + ex < width - 1 and py + ey < height - 1):
        return -2.0
    s = ss = sf = 0.0
    n = len(f)
    for i in range(n):
        dx, dy = offsets[i]
        x = px + affine[0] * dx + affine[1] * dy
        y = py + affine[2] * dx + affine[3] * dy
        ix = int(x)
        iy = int(y)
        tx = x - ix
        ty = y - iy
        at = start + iy * width + ix
        top = flat[at] + tx * (flat[at + 1] - flat[at])
        bottom = flat[at + width] + tx * (flat[at + width + 1] - flat[at + width])
        g = top + ty * (bottom - top)
        s += g
        ss += g * g
        sf += g * f[i]
    spread = ss - s * s / n
    if not spread > 1e-6 * ss:
        return -2.0
    return sf / math.sqrt(spread * variance)


@njit(cache=True, nogil=True, error_model="numpy")
def on_plane(scene, x, y, plane, patch, work, only):
    """Mean correlation with the template patch laid on a plane, of all images or `only` one; each into `each`.

    `scene` is (transfers, shapes, starts, flat), `patch` what `template_patch` returns with the radius, and `work` the
    buffers (position, affine, point, each).
    """
    transfers, shapes, starts, flat = scene
    f, offsets, variance, radius = patch
    position, affine, point, each = work
    each[:] = -2.0
    if not plane_start(transfers, x, y, plane, position, affine, point):
        return -2.0
    total = 0.0
    count = 0
    for k in range(len(transfers)):
        if only >= 0 and k != only:
            continue
        h, w = shapes[k + 1]
        each[k] = _correlate(flat, starts[k + 1], h, w, f, offsets, variance, position[k], affine[k], radius)
        total += each[k]
        count += 1
    return total / count


@njit(cache=True, nogil=True, error_model="numpy")
def template_patch(flat, seen, height, width, ix, iy, radius):
    """Centred samples of every second template pixel of the subject, their offsets, and the sum of their squares."""
    side = radius + 1
    f = np.empty(side * side)
    offsets = np.empty((side * side, 2))
    n = 0
    mean = 0.0
    if ix >= radius and iy >= radius and ix + radius < width and iy + radius < height:
        for dy in range(-radius, radius + 1, 2):
            for dx in range(-radius, radius + 1, 2):
                at = (iy + dy) * width + ix + dx
                if seen[at]:
                    f[n] = flat[at]
                    offsets[n] = dx, dy
                    mean += f[n]
                    n += 1
    variance = 0.0
    if n >= 0.3 * side * side:
        for i in range(n):
            f[i] -= mean / n
            variance += f[i] * f[i]
    return f[:n], offsets[:n], variance


@njit(cache=True, nogil=True, error_model="numpy")
def refine(scene, x, y, plane, depth_step, slope_step, top, patch, work, trial, only):
    """Improve a plane, one unknown after the other with halved steps; returns its mean correlation."""
    for _ in range(4):
        depth_step *= 0.5
        slope_step *= 0.5
        for unknown in range(3):
            for sign in (-1.0, 1.0):
                trial[:] = plane
                trial[unknown] += sign * (depth_step if unknown == 0 else slope_step)
                total = on_plane(scene, x, y, trial, patch, work, only)
                if total > top:
                    top = total
                    plane[:] = trial
    return top
