"""Visual hull by octree over integral images of the silhouettes, identical bit for bit to testing every voxel.

A voxel's pixel in a camera is (floor u, floor v) of its projected centre. Each camera says *subject*, *background* or,
where it sees nothing, what the setting `outside` says. For a block of voxels the projections of all centres lie in a
rectangle around the projected centre of the block; two integral images tell in constant time whether a camera says the
same everywhere in it. What is decided for a block is not asked again below it.
"""

from __future__ import annotations

import numpy as np

from geomocap.carving.block_kernels import block_count, carve, summed
from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.voxel_grid import Grid
from geomocap.scheduling import spread

_DEFAULT = HullSettings()


def hull(views: PinholeViews, grid: Grid, settings: HullSettings = _DEFAULT) -> Occupancy:
    """Carve the visual hull.

    A voxel stays if at most `tolerance` cameras call it background and, where what is outside some view is unseen, at
    least `min_views` cameras have a say.

    References
    ----------
    Szeliski, Rapid octree construction from image sequences, CVGIP: Image Understanding 58(1), 1993; the integral
    images are Crow's summed-area tables (SIGGRAPH 1984).
    """
    views, unseen, least = heard(views, settings)
    occupancy = Occupancy.empty(grid.shape)
    subject = summed(views.masks)
    seen = summed(views.valid) if unseen.any() else subject
    spread(
        carve,
        block_count(occupancy.bits),
        views.projections,
        rounding_bounds(views, grid),
        views.masks,
        views.valid,
        subject,
        seen,
        unseen,
        settings.tolerance,
        least,
        grid.origin,
        grid.voxel_size,
        grid.shape[2],
        occupancy.bits,
    )
    return occupancy


def heard(views: PinholeViews, settings: HullSettings) -> tuple[PinholeViews, np.ndarray, int]:
    """Tell of what each camera has a say.

    Returns
    -------
    PinholeViews
        With `outside = "auto"` a camera whose silhouette is (nearly) empty sees nothing at all.
    unseen : (C,) bool
        What is outside the camera's view is unseen; for the others it is background.
    least : int
        Cameras that must have a say of a voxel.
    """
    if settings.outside == "empty":
        return views, np.zeros(len(views), bool), 0
    if settings.outside == "unseen":
        return views, np.ones(len(views), bool), settings.views_of(len(views))
    blind = views.blind()
    unseen = views.cut_off() | blind
    if blind.any():
        masks, valid = (np.where(blind[:, None, None], np.uint8(0), m) for m in (views.masks, views.valid))
        views = PinholeViews(views.names, views.projections, masks, valid)
    return views, unseen, settings.views_of(int((~blind).sum())) if unseen.any() else 0


def rounding_bounds(views: PinholeViews, grid: Grid) -> np.ndarray:
    """Largest sums of magnitudes in the projections of a grid's points: (C, 2) float, numerators and depth.

    Rounding errors of the projections are a few units in the last place of these.
    """
    far = np.append(np.maximum(np.abs(grid.low), np.abs(grid.high)), 1.0)
    sums = np.abs(views.projections) @ far
    return np.column_stack([sums[:, :2].max(axis=1), sums[:, 2]])
