"""Matching many points of one template image, each from the plane expected there; compiled.

What a point hands to its neighbours is a plane: inverse depth μ and its slope in the template image. The start of the
neighbour in every search image, position and affine matrix, follows from it (`plane_start`), also in images
in which the point itself was not seen.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from geomocap.matching import patch_kernel as pk
from geomocap.matching.patch_kernel import inverse_depth, match_patch, transfer, workspace

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
_PATIENCE = 4
_SHORT = 0.1  # what the correlation may lack of its limit after so many iterations


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def match_point(stack, template, searches, transfers, limits, x, y, radius, plane, position, affine, quality, work):
    """Match one point from the plane expected there, in as many images as pass the thresholds.

    `plane` (PLANE,) is replaced by the plane found. Returns the number of images (0: rejected; the reasons then stand
    in `quality`).
    """
    _, masks, layout, _ = stack
    kernel, wanted, point, first = work
    images = len(searches)
    wanted[:] = 1
    control = (
        limits[SIGMA_CONDITION],
        int(limits[ITERATIONS]),
        limits[TOLERANCE],
        limits[CONTRAST],
        limits[MAX_SHIFT],
        _PATIENCE,
        limits[MIN_CORRELATION] - _SHORT,
    )
    for attempt in range(2):
        if not plane_start(transfers, x, y, plane, position, affine, point):
            return 0
        survived = match_patch(
            stack, template, searches, transfers, x, y, radius, control, wanted, position, affine, quality, kernel
        )
        # A view alone with the template has nothing to contradict it: it has to be the better.
        floor = limits[MIN_CORRELATION] if survived > 1 else limits[PAIR_CORRELATION]
        passed = _gate(masks, layout, searches, limits, floor, wanted, position, quality)
        if attempt == 0:
            for k in range(images):
                first[k] = quality[k, pk.STATUS]
        # Images that fell out on the way had no say in the end; those that failed the thresholds had
        if passed == survived and passed >= limits[MIN_IMAGES]:
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


@njit(cache=True, nogil=True, error_model="numpy")
def carry(plane, dx, dy, out):
    """Carry a plane (PLANE,) along a template offset."""
    out[:] = plane
    out[MU] += plane[SLOPE_X] * dx + plane[SLOPE_Y] * dy
    out[IMAGES] = 0


@njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def match_cells(
    stack, template, searches, transfers, limits, points, cells, origins, starts, radii, half, planes, found
):
    """Match cells, each once, from planes that hold near them, adapting where the quality is poor.

    Parameters
    ----------
    stack, template, searches, transfers
        As in `match_patch`.
    limits : (LIMITS,) float
        Thresholds.
    points : (N, 2) float
        Template positions of all cells, array indices.
    cells : (M,) int
        The cells to match.
    origins : (M, 2) float
        Where the planes hold, array indices.
    starts : (M, PLANE) float
        Planes.
    radii : (3,) int
        Patch radius; the one where texture is short; the one where the surface is not plane enough.
    half : bool
        Whether a point half way is matched first where nothing else helps.
    planes : (N, PLANE) float
    found : position (N, K, 2), affine (N, K, 4), quality (N, K, COLUMNS)
        Both written for the cells; IMAGES = 0 where none matched, the reasons then those of the first try.
    """
    position, affine, quality = found
    images = len(searches)
    count = len(cells)
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        work = workspace(max(radii), images), np.zeros(images, np.uint8), np.zeros(6), np.zeros(images)
        p, a, q = np.zeros((images, 2)), np.zeros((images, 4)), np.zeros((images, pk.COLUMNS))
        plane, between = np.zeros(PLANE), np.zeros(PLANE)
        for n in range(chunk * _CHUNK, min(count, (chunk + 1) * _CHUNK)):
            cell = cells[n]
            x, y = points[cell]
            dx = x - origins[n, 0]
            dy = y - origins[n, 1]
            planes[cell, IMAGES] = 0
            radius = radii[0]
            for attempt in range(3):
                if attempt == 1 and radius == radii[0]:
                    continue
                if attempt < 2:
                    carry(starts[n], dx, dy, plane)
                else:
                    # A smaller shift: a point half way hands its own plane on
                    if not half or max(abs(dx), abs(dy)) <= 0.5:
                        break
                    radius = radii[0]
                    mx = x - 0.5 * dx
                    my = y - 0.5 * dy
                    carry(starts[n], 0.5 * dx, 0.5 * dy, between)
                    args = (stack, template, searches, transfers, limits, mx, my, radius, between, p, a, q, work)
                    if match_point(*args) == 0:
                        break
                    carry(between, 0.5 * dx, 0.5 * dy, plane)
                args = (stack, template, searches, transfers, limits, x, y, radius, plane, p, a, q, work)
                passed = match_point(*args)
                if passed > 0 or attempt == 0:
                    quality[cell] = q
                if passed > 0:
                    position[cell], affine[cell], planes[cell] = p, a, plane
                    break
                if attempt == 0:
                    # A larger patch where texture is short, a smaller one where the surface is not plane enough
                    radius = radii[2]
                    for k in range(images):
                        if q[k, pk.STATUS] == pk.LOW_TEXTURE or q[k, pk.STATUS] == pk.PRECISION:
                            radius = radii[1]


@njit(cache=True, nogil=True, error_model="numpy")
def best_neighbours(neighbours, planes, tries, attempts, last, source, key):
    """For every cell still to be tried, find the matched one of its four neighbours with the best key; else -1.

    A cell is not tried again from `last` (N,), nor after `attempts` tries. Writes `source` and `key` (N,).
    """
    for n in range(len(source)):
        source[n] = -1
        if planes[n, IMAGES] > 0 or tries[n] >= attempts:
            continue
        top = -np.inf
        for d in range(4):
            m = neighbours[n, d]
            if m >= 0 and planes[m, IMAGES] > 0 and planes[m, KEY] > top:
                top = planes[m, KEY]
                source[n] = m
        if source[n] == last[n]:
            source[n] = -1
        key[n] = top
