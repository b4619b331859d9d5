"""Phantom volumes: pieces of the visual hull that the silhouettes allow and none of them needs.

Limbs that cross in several views leave room for further limbs beside them, the more the fewer cameras there are. Such a
room lies behind or before something else in every view: without it each silhouette is still explained. A true limb
alone explains some part of some silhouette.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.visibility import camera_centers, voxel_boxes
from geomocap.carving.voxel_grid import Grid

# Cells along the longest side of the subject; voxels may be finer.
_CELLS = 128
# Cells that are taken away from the surface to part what hangs together by a thin neck. With 4 true arms went, too,
# that the trunk and a phantom hid from all of four cameras.
_NECKS = (0, 1, 2)
# Fraction of a piece, in some view, that nothing else explains. Of a man before four cameras and a dancing machine,
# pieces of less were 33 to 185 mm off the true surface, those of more than 0.34 2 to 8 mm; between there were none.
_NEEDED = 0.05
# Part of a piece's surface by which it may hang on others. Of 66 needless pieces below 0.33 61 lay outside of the
# subject and 5 were its own, of 79 above 46 and 27: there they are hollows of bulky hulls (37 frames of 8 captures).
_HANGING = 0.33
_PIXELS = 1.0  # width of a cell in the images in which is looked


def without_phantoms(views: PinholeViews, grid: Grid, occupancy: Occupancy) -> Occupancy:
    """Take away the pieces of a hull without which all silhouettes are still explained, smallest first.

    Pieces are what hangs together, and what does once one or two cells (of 128 along the subject) are taken from the
    whole surface: a phantom often touches the limb that it comes from.

    Parameters
    ----------
    views : PinholeViews
    grid : Grid
    occupancy : Occupancy
        The visual hull.

    References
    ----------
    Michoud, Guillou, Bouakaz, Briceño, "Largest silhouette-equivalent volume for 3D shapes modeling without ghost
    object", 2008: a connected component without "safe" rays is a ghost.
    """
    span = _span(occupancy.bits)
    if (span < 0).any():
        return occupancy
    edge = max(1, math.ceil((span[1] - span[0] + 1).max() / _CELLS))
    cells = _cells(occupancy.bits, span, edge)
    shape = np.array(cells.shape)
    block = Grid(grid.origin + (span[0] - edge) * grid.voxel_size, grid.voxel_size * edge, tuple(shape.tolist()))
    views = _looked_at(views, block)
    changed = False
    for neck in _NECKS:
        piece, count = _pieces(cells, neck)
        if count < 2:
            continue
        surface, faces, hanging = _outside(cells, piece, count)
        gone = _needless(views, block, surface, faces, piece, hanging < _HANGING)
        if gone.any():
            changed = True
            cells[gone[piece]] = 0
    if not changed:
        return occupancy
    bits = occupancy.bits.copy()
    _clear(bits, cells, span[0], edge)
    return Occupancy(bits, occupancy.shape)


def _looked_at(views: PinholeViews, block: Grid) -> PinholeViews:
    """The same views with pixels about as wide as cells, or with their own if these are wider."""
    P = views.projections
    middle = np.append((block.low + block.high) / 2, 1.0)
    depth = np.maximum(P[:, 2] @ middle, block.voxel_size)
    width = block.voxel_size * np.linalg.norm(P[:, 0, :3], axis=1) / depth
    step = max(1, int(width.min() / _PIXELS))
    if step == 1:
        return views
    smaller = np.diag([1.0 / step, 1.0 / step, 1.0]) @ P
    start = step // 2
    masks, valid = (np.ascontiguousarray(m[:, start::step, start::step]) for m in (views.masks, views.valid))
    return PinholeViews(views.names, smaller, masks, valid)


def _needless(
    views: PinholeViews, block: Grid, surface: np.ndarray, faces: np.ndarray, piece: np.ndarray, asked: np.ndarray
) -> np.ndarray:
    """Which of the pieces `asked` (K + 1,) bool no silhouette needs, (K + 1,) bool; piece 0 is none."""
    count = len(asked) - 1
    of = piece[tuple(surface.T)]
    sizes = np.bincount(piece.ravel(), minlength=count + 1)
    sizes[0] = 0
    rank = np.empty(count + 1, np.int64)  # no piece first, then the smallest
    rank[np.argsort(sizes, kind="stable")] = np.arange(count + 1)
    order = np.argsort(rank[of], kind="stable")
    begin = np.searchsorted(rank[of][order], np.arange(count + 2))
    surface, faces = surface[order], faces[order]
    boxes = np.empty((len(views), 4, len(order)), np.int32)
    for c, (P, center) in enumerate(zip(views.projections, camera_centers(views.projections), strict=True)):
        cube = block.origin, block.voxel_size
        voxel_boxes(P, center, surface, faces, *cube, views.masks.shape[1:], boxes[c])
    return _judge(boxes, begin, asked[np.argsort(rank)], views.masks, _NEEDED)[rank]


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(boxes, begin, asked, masks, needed):
    """Which of the pieces asked go, in the order of `begin`; the last one, the largest, never."""
    C, H, W = masks.shape
    count = len(begin) - 1
    covers, drawn = np.zeros((C, H, W), np.int16), np.full((C, H, W), -1, np.int32)
    gone = np.zeros(count, np.bool_)
    for p in range(count):
        for c in range(C):
            _paint(boxes[c], begin[p], begin[p + 1], masks[c], covers[c], drawn[c], p, 1)
    for p in range(count - 1):
        if not asked[p]:
            continue
        need = 0.0
        for c in range(C):
            own, alone = _paint(boxes[c], begin[p], begin[p + 1], masks[c], covers[c], drawn[c], count + p, 0)
            need = max(need, alone / max(own, 1))
        if need < needed:
            gone[p] = True
            for c in range(C):
                _paint(boxes[c], begin[p], begin[p + 1], masks[c], covers[c], drawn[c], 2 * count + p, -1)
    return gone


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(box, begin, end, mask, covers, drawn, mark, change):
    """Change by how many pieces the subject's pixels are covered; of one piece each counts once.

    Returns how many pixels the piece covers, and how many of them no other one does.
    """
    own, alone = 0, 0
    for n in range(begin, end):
        for row in range(box[2, n], box[3, n] + 1):
            for column in range(box[0, n], box[1, n] + 1):
                if mask[row, column] == 0 or drawn[row, column] == mark:
                    continue
                drawn[row, column] = mark
                own += 1
                alone += covers[row, column] == 1
                covers[row, column] += change
    return own, alone


@njit(cache=True, nogil=True, error_model="numpy")
def _span(bits):
    """Lowest and highest index of what is occupied, (2, 3) int64; -1: nothing is."""
    X, Y, K = bits.shape
    span = np.full((2, 3), -1)
    for i in range(X):
        for j in range(Y):
            for k in range(K):
                word = bits[i, j, k]
                if word == 0:
                    continue
                low, high = 32 * k, 32 * k + 31
                while not (word >> np.uint32(low & 31)) & np.uint32(1):
                    low += 1
                while not (word >> np.uint32(high & 31)) & np.uint32(1):
                    high -= 1
                if span[0, 0] < 0:
                    span[0, 0], span[0, 1], span[0, 2] = i, j, low
                span[0, 1], span[0, 2] = min(span[0, 1], j), min(span[0, 2], low)
                span[1, 0], span[1, 1], span[1, 2] = i, max(span[1, 1], j), max(span[1, 2], high)
    return span


@njit(cache=True, nogil=True, error_model="numpy")
def _cells(bits, span, edge):
    """Cells of `edge` voxels in which some voxel is occupied, uint8, with empty ones all round."""
    low = span[0]
    X, Y, Z = (span[1] - low) // edge + 3
    cells = np.zeros((X, Y, Z), np.uint8)
    for i in range(low[0], span[1, 0] + 1):
        for j in range(low[1], span[1, 1] + 1):
            line = cells[(i - low[0]) // edge + 1, (j - low[1]) // edge + 1]
            for w in range(bits.shape[2]):
                word, k = bits[i, j, w], 32 * w
                while word != 0:
                    if word & np.uint32(1):
                        line[(k - low[2]) // edge + 1] = 1
                    word >>= np.uint32(1)
                    k += 1
    return cells


@njit(cache=True, nogil=True, error_model="numpy")
def _clear(bits, cells, low, edge):
    """Clear the voxels of empty cells."""
    X, Y, K = bits.shape
    for i in range(X):
        for j in range(Y):
            for w in range(K):
                word, k = bits[i, j, w], 32 * w
                while word != 0:
                    if word & np.uint32(1):
                        if cells[(i - low[0]) // edge + 1, (j - low[1]) // edge + 1, (k - low[2]) // edge + 1] == 0:
                            bits[i, j, w] &= ~np.uint32(1 << (k & 31))
                    word >>= np.uint32(1)
                    k += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _pieces(cells, neck):
    """Part what hangs together once `neck` cells are taken from the surface; the rest comes to what is nearest within.

    Returns the piece of each cell, int32, 0: none; and how many there are. Neighbours are those over faces.
    """
    X, Y, Z = cells.shape
    piece = np.zeros((X, Y, Z), np.int32)
    flat, own = cells.ravel(), piece.ravel()
    steps = np.array([Y * Z, -Y * Z, Z, -Z, 1, -1])
    # steps to what is empty, at most neck + 1
    depth, filled = np.empty_like(flat), 0
    for n in range(len(flat)):
        depth[n] = neck + 1 if flat[n] else 0
        filled += flat[n] != 0
    for n in range(Y * Z, len(flat)):
        if depth[n]:
            depth[n] = min(depth[n], depth[n - Y * Z] + 1, depth[n - Z] + 1, depth[n - 1] + 1)
    for n in range(len(flat) - Y * Z - 1, -1, -1):
        if depth[n]:
            depth[n] = min(depth[n], depth[n + Y * Z] + 1, depth[n + Z] + 1, depth[n + 1] + 1)
    # fill core after core; then grow all, step by step
    queue = np.empty(filled, np.int64)
    count, begin, end = 0, 0, 0
    for start in range(len(flat)):
        if depth[start] <= neck or own[start]:
            continue
        count += 1
        own[start] = count
        queue[end] = start
        end += 1
        while begin < end:
            n = queue[begin]
            begin += 1
            for step in steps:
                if depth[n + step] > neck and own[n + step] == 0:
                    own[n + step] = count
                    queue[end] = n + step
                    end += 1
    begin = 0
    while begin < end:
        n = queue[begin]
        begin += 1
        for step in steps:
            if flat[n + step] and own[n + step] == 0:
                own[n + step] = own[n]
                queue[end] = n + step
                end += 1
    return piece, count


@njit(cache=True, nogil=True, error_model="numpy")
def _outside(cells, piece, count):
    """Surfaces of all pieces, as if each were alone.

    Returns indices (N, 3) int32, faces (N,) uint8 as those of `SurfaceVoxels`, and which part of each piece's surface
    others touch, (K + 1,) float.
    """
    Y, Z = cells.shape[1:]
    flat, own = cells.ravel(), piece.ravel()
    steps = np.array([-Y * Z, Y * Z, -Z, Z, -1, 1])
    filled, found = 0, 0
    for n in range(len(flat)):
        filled += flat[n] != 0
    surface, faces = np.empty((filled, 3), np.int32), np.empty(filled, np.uint8)
    touched, whole = np.zeros(count + 1), np.zeros(count + 1)
    for n in range(len(flat)):
        if flat[n] == 0:
            continue
        bits = 0
        for f in range(6):
            if flat[n + steps[f]] == 0 or own[n + steps[f]] != own[n]:
                bits |= 1 << f
                whole[own[n]] += 1
                touched[own[n]] += flat[n + steps[f]]
        if bits:
            surface[found, 0], surface[found, 1], surface[found, 2] = n // (Y * Z), n // Z % Y, n % Z
            faces[found] = bits
            found += 1
    touched[0], whole[0] = np.inf, 1.0  # what is of no piece is not asked
    for k in range(count + 1):
        touched[k] /= max(whole[k], 1.0)
    return surface[:found].copy(), faces[:found].copy(), touched
