"""Matching many points of one template image, each from the plane expected there; compiled.

What a point hands to its neighbours is a plane: inverse depth μ and its slope in the template image. The start of the
neighbour in every search image, position and affine matrix, follows from it (`epipolar.plane_affine`), also in images
in which the point itself was not seen.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from geomocap.matching import patch_kernel as pk
from geomocap.matching.patch_kernel import inverse_depth, match_patch, transfer, workspace
from geomocap.matching.spline import FAST

(
    ITERATIONS,
    TOLERANCE,
    CONTRAST,
    MAX_SHIFT,
    SIGMA_CONDITION,
    MIN_CORRELATION,
    PAIR_CORRELATION,
    MAX_SIGMA0,
    MAX_DEVIATION,
    MAX_EPIPOLAR,
    MIN_IMAGES,
    LIMITS,
) = range(12)

MU, SLOPE_X, SLOPE_Y, KEY, IMAGES, PLANE = range(6)

_CHUNK = 16


@njit(cache=True, nogil=True, fastmath=FAST)
def plane_start(transfers, x, y, plane, position, affine, point):
    """Put the warps that a plane induces around template index (x, y) into position and affine; False if behind."""
    for k in range(len(transfers)):
        T = transfers[k]
        if not transfer(T, plane[MU], x, y, point):
            return False
        w = T[6] * x + T[7] * y + T[8] + plane[MU] * T[11]
        position[k, 0] = point[0]
        position[k, 1] = point[1]
        for j in range(2):
            s = plane[SLOPE_X + j]
            down = T[6 + j] + T[11] * s
            affine[k, j] = (T[j] + T[9] * s - point[0] * down) / w
            affine[k, 2 + j] = (T[3 + j] + T[10] * s - point[1] * down) / w
    return True


@njit(cache=True, nogil=True, fastmath=FAST)
def plane_of(transfers, x, y, position, affine, use, plane, point):
    """Fit inverse depth and slope to the warps of the images in use."""
    plane[MU] = inverse_depth(transfers, x, y, position, use)
    sx = sy = weight = 0.0
    for k in range(len(transfers)):
        T = transfers[k]
        if use[k] == 0 or not transfer(T, plane[MU], x, y, point):
            continue
        w = T[6] * x + T[7] * y + T[8] + plane[MU] * T[11]
        ux, uy = point[2], point[3]
        # affine = base + π' slopeᵀ, with base the warp of slope 0
        b11 = (T[0] - point[0] * T[6]) / w
        b12 = (T[1] - point[0] * T[7]) / w
        b21 = (T[3] - point[1] * T[6]) / w
        b22 = (T[4] - point[1] * T[7]) / w
        sx += ux * (affine[k, 0] - b11) + uy * (affine[k, 2] - b21)
        sy += ux * (affine[k, 1] - b12) + uy * (affine[k, 3] - b22)
        weight += ux * ux + uy * uy
    plane[SLOPE_X] = sx / weight if weight > 0 else 0.0
    plane[SLOPE_Y] = sy / weight if weight > 0 else 0.0


@njit(cache=True, nogil=True, fastmath=FAST)
def _gate(masks, layout, searches, limits, floor, wanted, position, quality):
    """Apply the thresholds: failing images lose their place in `wanted`; return the number left."""
    count = 0
    for k in range(len(searches)):
        if not wanted[k]:
            continue
        q = quality[k]
        if q[pk.STATUS] == pk.MATCHED:
            start, stride, _height, _width = layout[searches[k]]
            at = start + int(position[k, 1] + 0.5) * stride + int(position[k, 0] + 0.5)
            limit = limits[MAX_DEVIATION] * limits[MAX_DEVIATION]
            if masks[at] == 0:
                q[pk.STATUS] = pk.OUTSIDE_SEARCH
            elif not q[pk.CORR] >= floor:
                q[pk.STATUS] = pk.CORRELATION
            elif not q[pk.SIGMA0] <= limits[MAX_SIGMA0]:
                q[pk.STATUS] = pk.SIGMA
            elif not (q[pk.CXX] <= limit and q[pk.CYY] <= limit):
                q[pk.STATUS] = pk.PRECISION
            elif not q[pk.EPI] <= limits[MAX_EPIPOLAR]:
                q[pk.STATUS] = pk.EPIPOLAR
        if q[pk.STATUS] == pk.MATCHED:
            count += 1
        else:
            wanted[k] = 0
    return count


@njit(cache=True, nogil=True, fastmath=FAST)
def match_point(stack, template, searches, transfers, limits, x, y, radius, plane, position, affine, quality, work):
    """Match one point from the plane expected there, in as many images as pass the thresholds.

    `plane` (PLANE,) is replaced by the plane found. Returns the number of images (0: rejected; the reasons then stand
    in `quality`).
    """
    flat, masks, layout, order = stack
    kernel, wanted, point, first = work
    images = len(searches)
    wanted[:] = 1
    for attempt in range(2):
        if not plane_start(transfers, x, y, plane, position, affine, point):
            return 0
        match_patch(
            flat,
            masks,
            layout,
            order,
            template,
            searches,
            transfers,
            limits[SIGMA_CONDITION],
            x,
            y,
            radius,
            int(limits[ITERATIONS]),
            limits[TOLERANCE],
            limits[CONTRAST],
            limits[MAX_SHIFT],
            wanted,
            position,
            affine,
            quality,
            kernel,
        )
        if attempt == 0:
            for k in range(images):
                first[k] = quality[k, pk.STATUS]
        tried = 0
        for k in range(images):
            tried += wanted[k]
        # A view alone with the template has nothing to contradict it: it has to be the better.
        floor = limits[MIN_CORRELATION] if tried > 1 else limits[PAIR_CORRELATION]
        passed = _gate(masks, layout, searches, limits, floor, wanted, position, quality)
        if attempt == 0:
            for k in range(images):
                if wanted[k] == 0:
                    first[k] = quality[k, pk.STATUS]
        if passed == tried and passed >= limits[MIN_IMAGES]:
            plane_of(transfers, x, y, position, affine, wanted, plane, point)
            plane[IMAGES] = passed
            key = 0.0
            for k in range(images):
                if wanted[k]:
                    key += quality[k, pk.CORR]
                elif first[k] != pk.MATCHED:
                    quality[k, pk.STATUS] = first[k]
            plane[KEY] = key / images
            return passed
        if passed < limits[MIN_IMAGES] or attempt == 1:
            for k in range(images):
                if first[k] != pk.MATCHED:
                    quality[k, pk.STATUS] = first[k]
                elif quality[k, pk.STATUS] == pk.MATCHED:
                    quality[k, pk.STATUS] = pk.CORRELATION
            return 0
    return 0


@njit(cache=True, nogil=True, parallel=True)
def match_points(
    flat,
    masks,
    layout,
    order,
    template,
    searches,
    transfers,
    limits,
    points,
    radius,
    planes,
    position,
    affine,
    quality,
):
    """Match points, each for itself.

    Parameters
    ----------
    flat, masks, layout, order, template, searches, transfers
        As in `match_patch`.
    limits : (LIMITS,) float
        Thresholds.
    points : (N, 2) float
        Template positions, array indices.
    radius : int
    planes : (N, PLANE) float
        Planes expected; replaced by those found, with IMAGES = 0 where none was.
    position, affine, quality : (N, K, 2), (N, K, 4), (N, K, COLUMNS) float
        Written.
    """
    stack = (flat, masks, layout, order)
    images = len(searches)
    count = len(points)
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        work = workspace(radius, images), np.zeros(images, np.uint8), np.zeros(6), np.zeros(images)
        for n in range(chunk * _CHUNK, min(count, (chunk + 1) * _CHUNK)):
            x, y = points[n]
            planes[n, IMAGES] = 0
            match_point(
                stack,
                template,
                searches,
                transfers,
                limits,
                x,
                y,
                radius,
                planes[n],
                position[n],
                affine[n],
                quality[n],
                work,
            )
