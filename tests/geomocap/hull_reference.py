"""The visual hull by testing every voxel: slow and obvious, what the octree must agree with bit for bit."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.hull import heard
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.voxel_grid import Grid

_DEFAULT = HullSettings()


def visual_hull_numpy(views: PinholeViews, grid: Grid, settings: HullSettings = _DEFAULT) -> np.ndarray:
    """Carve the visual hull with whole arrays: (X, Y, Z) uint8."""
    axes = grid.axes()
    x, y, z = axes[0][:, None, None], axes[1][None, :, None], axes[2][None, None, :]
    H, W = views.masks.shape[1:]
    background = np.zeros(grid.shape, np.int64)
    visible = np.zeros(grid.shape, np.int64)
    views, unseen, least = heard(views, settings)
    for P, mask, valid, is_open in zip(views.projections, views.masks, views.valid, unseen, strict=True):
        n0, n1, w = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in P)
        front = w > 0
        depth = np.where(front, w, 1.0)
        u, v = np.where(front, n0 / depth, -1.0), np.where(front, n1 / depth, -1.0)
        on_canvas = (u >= 0) & (v >= 0) & (u < W) & (v < H)
        column, row = np.where(on_canvas, u, 0).astype(int), np.where(on_canvas, v, 0).astype(int)
        inside = on_canvas & (mask[row, column] != 0)
        seen = on_canvas & (valid[row, column] != 0)
        background += (seen & ~inside) if is_open else ~inside
        visible += seen if is_open else 1
    return ((background <= settings.tolerance) & (visible >= least)).astype(np.uint8)


def visual_hull_brute(views: PinholeViews, grid: Grid) -> np.ndarray:
    """Carve the visual hull voxel by voxel on all cores, outside = "empty" and no tolerance: (X, Y, Z) uint8."""
    return _brute(views.projections, views.masks, grid.origin, grid.voxel_size, grid.shape)


@njit(cache=True, nogil=True, parallel=True)
def _brute(P, masks, origin, edge, shape):
    C, H, W = masks.shape
    X, Y, Z = shape
    out = np.zeros((X, Y, Z), np.uint8)
    for i in prange(X):
        x = origin[0] + (i + 0.5) * edge
        for j in range(Y):
            y = origin[1] + (j + 0.5) * edge
            for k in range(Z):
                z = origin[2] + (k + 0.5) * edge
                inside = True
                for c in range(C):
                    w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
                    u = (P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 2] * z + P[c, 0, 3]) / w
                    v = (P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 2] * z + P[c, 1, 3]) / w
                    if not (w > 0 and u >= 0 and v >= 0 and u < W and v < H) or masks[c, int(v), int(u)] == 0:
                        inside = False
                        break
                if inside:
                    out[i, j, k] = 1
    return out
