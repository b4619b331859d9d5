"""From the silhouettes of one frame to its coloured surface voxels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomocap.carving.agreement import check_agreement, check_inside, check_silhouettes
from geomocap.carving.carving_settings import CarvingSettings
from geomocap.carving.coloring import GREY, voxel_colors
from geomocap.carving.consistency import carve_inconsistent
from geomocap.carving.hull import hull
from geomocap.carving.phantoms import without_phantoms
from geomocap.carving.silhouette_views import PinholeViews, Undistortion
from geomocap.carving.volume import working_volume
from geomocap.carving.voxel_grid import Grid
from geomocap.model.frame_geometry import Voxels
from geomocap.model.rig import Rig

_DEFAULT = CarvingSettings()


def carve(
    masks: Sequence[np.ndarray],
    rig: Rig,
    *,
    images: Sequence[np.ndarray] | None = None,
    grid: Grid | None = None,
    settings: CarvingSettings = _DEFAULT,
) -> Voxels:
    """Carve the surface voxels of one frame from its silhouettes.

    Parameters
    ----------
    masks : sequence of C arrays (H, W)
        Silhouettes as the cameras saw them, lens distortion and all; not 0 on the subject.
    rig : Rig
        The C cameras.
    images : sequence of C arrays (H, W, 3) uint8, RGB, optional
        For the voxels' colours.
    grid : Grid, optional
        The block of voxels, the same for all frames of a sequence; found from this frame if not given.
    settings : CarvingSettings

    Returns
    -------
    Voxels
        `points` (N, 3) m, `colors` (N, 3), `to_open3d()`.

    Raises
    ------
    GeometryError
        If silhouettes are empty or contradict each other.
    """
    undistortion = Undistortion.of(rig)
    views = undistortion.views(masks)
    straight = undistortion.images(images) if images is not None and needs_images(settings) else None
    return carve_frame(views, grid or working_volume([views], settings), settings, straight)


def carve_frame(
    views: PinholeViews,
    grid: Grid,
    settings: CarvingSettings = _DEFAULT,
    images: np.ndarray | None = None,
    frame: int = 0,
) -> Voxels:
    """Carve one frame.

    Parameters
    ----------
    views : PinholeViews
        Undistorted silhouettes.
    grid : Grid
        The working volume.
    settings : CarvingSettings
    images : (C, H, W, 3) uint8, optional
        Undistorted images on the canvas of the views, from `Undistortion.images`; without them there are no colours
        and no colour consistency. `needs_images` says whether the settings want them.
    frame : int
        For messages.

    Returns
    -------
    Voxels
        Surface voxels, sorted by x, y, z index.

    Raises
    ------
    GeometryError
        If a silhouette is empty, the silhouettes contradict each other, or the subject is outside the volume.
    """
    check_silhouettes(views, frame, settings.hull)

    # Shape from silhouette
    occupancy = hull(views, grid, settings.hull)
    if settings.hull.phantoms:
        occupancy = without_phantoms(views, grid, occupancy)
    surface = occupancy.surface_indices()
    if len(surface) == 0:
        check_agreement(views, frame, settings.hull)
    check_inside(surface, grid, frame, settings.max_cut)

    # Colour consistency over the cameras that see a surface voxel
    if images is not None and settings.consistency.enabled:
        occupancy = carve_inconsistent(views, images, grid, occupancy, settings.consistency)
        surface = occupancy.surface_indices()

    if images is not None and settings.colors == "visible":
        colors = voxel_colors(views, images, grid, occupancy)
    else:
        colors = np.full((len(surface), 3), GREY, np.uint8)
    return Voxels(surface, colors, grid.origin, grid.voxel_size)


def needs_images(settings: CarvingSettings) -> bool:
    """Whether these settings use the images, not only the silhouettes."""
    return settings.consistency.enabled or settings.colors == "visible"
