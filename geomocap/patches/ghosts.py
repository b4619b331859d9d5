"""Where a hull may be a ghost: a part of it that the silhouettes allow and nothing needs."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_fill_holes

from geomocap.patches.frame_views import FrameViews

_STEP = 0.7  # voxels
_GAP = 4  # steps outside; narrower gaps are between the stairs of a surface seen at a flat angle
_CHUNK = 2000  # points at once


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
    filled = binary_fill_holes(filled)
    last = np.array(filled.shape) - 1
    steps = _STEP * size * np.arange(int(np.ceil(np.linalg.norm(filled.shape) / _STEP)))
    result = np.empty((len(points), view.count), bool)
    for low in range(0, len(points), _CHUNK):
        some = points[low : low + _CHUNK]
        for c, center in enumerate(view.centers):
            direction = some - center
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            at = np.floor((some[:, None] + steps[:, None] * direction[:, None] - origin) / size).astype(np.int64)
            at = at.clip(0, last)  # the outermost voxels are empty
            inside = filled[at[:, :, 0], at[:, :, 1], at[:, :, 2]]
            gap = ~sliding_window_view(inside[:, :-1], _GAP, axis=1).any(axis=2)
            result[low : low + _CHUNK, c] = ~(inside[:, _GAP:] & gap).any(axis=1)
    return result
