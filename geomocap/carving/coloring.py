"""Colours of surface voxels from the cameras that see them."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.visibility import SurfaceVoxels, depth_buffers, normals, observations
from geomocap.carving.voxel_grid import Grid

GREY = 160


def voxel_colors(views: PinholeViews, images: np.ndarray, grid: Grid, occupancy: Occupancy) -> np.ndarray:
    """Colour the surface voxels of an occupancy, (N, 3) uint8 RGB, by the weighted median of what sees them.

    A camera weighs with the squared cosine between its ray and the surface's normal. Voxels that no camera sees take
    the colour of the nearest one that is seen; if none is seen at all they are grey.
    """
    voxels = SurfaceVoxels.of(occupancy)
    surface = voxels.indices
    seen = observations(views, images, grid, voxels, depth_buffers(views, grid, voxels))
    centers = -np.linalg.solve(views.projections[:, :, :3], views.projections[:, :, 3:])[:, :, 0]
    colors = np.full((len(surface), 3), GREY, np.uint8)
    has_color = np.zeros(len(surface), np.bool_)
    positions = grid.centers(surface)
    _blend(seen.seen, seen.colors, positions, normals(occupancy, surface), centers, colors, has_color)
    if has_color.any() and not has_color.all():
        nearest = cKDTree(positions[has_color], balanced_tree=False, compact_nodes=False).query(positions[~has_color])[
            1
        ]
        colors[~has_color] = colors[has_color][nearest]
    return colors


@njit(cache=True, nogil=True, error_model="numpy")
def _blend(seen, samples, positions, normal, centers, colors, has_color):
    N, C = seen.shape
    weights, values, order = np.empty(C, np.float64), np.empty(C, np.float64), np.empty(C, np.int64)
    for n in range(N):
        total = 0.0
        for c in range(C):
            if seen[n, c]:
                x, y, z = (
                    centers[c, 0] - positions[n, 0],
                    centers[c, 1] - positions[n, 1],
                    centers[c, 2] - positions[n, 2],
                )
                cosine = x * normal[n, 0] + y * normal[n, 1] + z * normal[n, 2]
                cosine = max(cosine / np.sqrt(x * x + y * y + z * z), 0.05)
                weights[c] = cosine * cosine
                total += weights[c]
        if total == 0.0:
            continue
        has_color[n] = True
        for a in range(3):
            count = 0
            for c in range(C):
                if seen[n, c]:
                    at = count
                    while at > 0 and values[at - 1] > samples[n, c, a]:
                        values[at] = values[at - 1]
                        order[at] = order[at - 1]
                        at -= 1
                    values[at] = samples[n, c, a]
                    order[at] = c
                    count += 1
            part = 0.0
            for q in range(count):
                part += weights[order[q]]
                if part >= 0.5 * total:
                    colors[n, a] = np.uint8(values[q] + 0.5)
                    break
