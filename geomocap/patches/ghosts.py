"""Where a hull may be a ghost: a part of it that the silhouettes allow and nothing needs."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.ndimage import label

from geomocap.patches.frame_views import FrameViews
from geomocap.scheduling import spread

_STEP = 0.7  # voxels
_GAP = 4  # steps outside; narrower gaps are between the stairs of a surface seen at a flat angle


def nothing_behind(view: FrameViews, points: np.ndarray) -> np.ndarray:
    """Whether a ray ends in the very part of the volume that a point of its surface is on.

    Few silhouettes allow more than there is: limbs that cross in several views leave further limbs beside them. What a
    camera sees is then a part behind those. Of a ray through a single part it is certain that it ends in it
    (the "safe" part of a hull: Bogomjakov, Gotsman, "Reduced depth and visual hulls of complex 3D scenes", 2008).

    Parameters
    ----------
    view : FrameViews
    points : (N, 3) float, metres, world

    Returns
    -------
    (N, C) bool
    """
    size = view.voxel_size
    origin = view.surface.min(axis=0) - 1.5 * size  # corner of a grid with an empty voxel all round
    surface = np.floor((view.surface - origin) / size).astype(np.int64)
    filled = np.zeros(surface.max(axis=0) + 2, bool)
    filled[tuple(surface.T)] = True
    empty, _ = label(~filled)
    filled = empty != empty[0, 0, 0]  # what isn't joined with the border, a third of the time of `binary_fill_holes`
    steps = _STEP * size * np.arange(int(np.ceil(np.linalg.norm(filled.shape) / _STEP)))
    result = np.empty((len(points), view.count), bool)
    places, centers = np.ascontiguousarray(points, float), np.ascontiguousarray(view.centers, float)
    spread(_nothing_behind, len(places), places, centers, filled, origin, size, steps, result)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _nothing_behind(begin, end, points, centers, filled, origin, size, steps, result):
    direction, cell = np.empty(3), np.empty(3, np.int64)
    for n in range(begin, end):
        for c in range(result.shape[1]):
            length = 0.0
            for i in range(3):
                direction[i] = points[n, i] - centers[c, i]
                length += direction[i] * direction[i]
            length = np.sqrt(length)
            for i in range(3):
                direction[i] /= length
            empty = 0
            result[n, c] = True
            for step in steps:
                for i in range(3):
                    at = int(np.floor((points[n, i] + step * direction[i] - origin[i]) / size))
                    cell[i] = min(max(at, 0), filled.shape[i] - 1)  # the outermost voxels are empty
                if not filled[cell[0], cell[1], cell[2]]:
                    empty += 1
                elif empty >= _GAP:
                    result[n, c] = False
                    break
                else:
                    empty = 0
