"""The working volume of a sequence: given, or found from the cameras and the silhouettes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import count

import numpy as np

from geomocap.carving.agreement import check_agreement, check_silhouettes
from geomocap.carving.carving_settings import CarvingSettings
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.subject_bounds import subject_box
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import GeometryError

# One bit each: 128 MB. A longer way than this is carved more coarsely; finer voxels that were asked for are refused.
MOST_VOXELS = 1 << 30
MOST_STRETCHED = 1.5  # times its median length: the longest that a subject is taken for

_DEFAULT = CarvingSettings()


def working_volume(
    frames: Iterable[PinholeViews], settings: CarvingSettings = _DEFAULT, numbers: Iterable[int] | None = None
) -> Grid:
    """Find the grid that holds the subject in all these frames, or make the one that the settings give.

    A found grid has `resolution` voxels along the longest side that the subject (with margin) has in any frame; it is
    longer where the subject moves on.

    Parameters
    ----------
    frames : iterable of PinholeViews
        All frames or a sample spread over the sequence; read one by one.
    settings : CarvingSettings
    numbers : iterable of int, optional
        Frame numbers for messages; 0, 1 … if not given.

    Raises
    ------
    GeometryError
        If silhouettes are empty or have no common volume (the camera that contradicts the others is named), if
        the cameras, all on one side, don't bound the subject, or if more than `MOST_VOXELS` voxels are asked for.
    """
    if settings.volume is not None:
        low, high = (np.array(corner, dtype=np.float64) for corner in settings.volume)
        _check_count(high - low, settings)
        return Grid.of_box(low, high, resolution=settings.resolution, voxel_size=settings.voxel_size)
    box: tuple[np.ndarray, np.ndarray] | None = None
    lengths: list[float] = []
    looked_at = 0
    blind: dict[str, int] = {}
    for number, views in zip(count() if numbers is None else numbers, frames, strict=False):
        check_silhouettes(views, number, settings.hull)
        looked_at += 1
        for c in np.flatnonzero(views.blind()):
            blind[views.names[c]] = blind.get(views.names[c], 0) + 1
        found = subject_box(views, settings.hull)
        if box is None or found is None:
            check_agreement(views, number, settings.hull)
        if found is None:
            continue
        lengths.append(float((found[1] - found[0]).max()))
        box = found if box is None else (np.minimum(box[0], found[0]), np.maximum(box[1], found[1]))
    if box is None:
        raise GeometryError("no frames to find the working volume from; give `carving.volume`")
    for name, frames_without in blind.items():
        if frames_without == looked_at > settings.hull.tolerance:
            raise GeometryError(
                f"camera {name}: its silhouettes are empty, or nearly so, in all {looked_at} frames looked at; check "
                "its images and background, or its masks, and its pose (what no other camera confirms is left out), or "
                "name only the other cameras in capture.toml"
            )
    # A frame in which cameras see little leaves room for more than the subject
    longest = min(max(lengths), MOST_STRETCHED * float(np.median(lengths)))
    # The subject counts, not how far it goes: a runner is measured as finely as somebody who stands
    edge = settings.voxel_size or (1 + 2 * settings.margin) * longest / settings.resolution
    margin = settings.margin * longest
    low, high = box[0] - margin, box[1] + margin
    if settings.voxel_size is None:
        edge = max(edge, float(np.cbrt(np.prod(high - low) / MOST_VOXELS)))
    else:
        _check_count(high - low, settings)
    return Grid.of_box(low, high, voxel_size=edge)


def _check_count(size: np.ndarray, settings: CarvingSettings) -> None:
    """Refuse more voxels than `MOST_VOXELS` in a box of sides (3,), metres; what is empty is not looked at."""
    if not (np.isfinite(size).all() and (size > 0).all()):
        return
    edge = settings.voxel_size or float(size.max()) / settings.resolution
    if (count := _count(size, edge)) <= MOST_VOXELS:
        return
    least = float(np.cbrt(np.prod(size) / MOST_VOXELS))
    while _count(size, least) > MOST_VOXELS:
        least *= 1.001
    least = float(f"{1.006 * least:.3g}")  # no less when rounded
    asked, possible = f"carving.voxel_size = {settings.voxel_size} m", f"set {least:g} m or more"
    if settings.voxel_size is None:
        asked, possible = f"carving.resolution = {settings.resolution}", f"set {int(size.max() / least)} or less"
    sides = " × ".join(f"{side:.3g}" for side in size)
    raise GeometryError(
        f"{asked} makes {count:.2g} voxels in the volume of {sides} m, at most {MOST_VOXELS:.2g} are possible; "
        f"{possible}, or a smaller carving.volume"
    )


def _count(size: np.ndarray, edge: float) -> float:
    return math.prod(np.ceil(size / max(edge, 1e-90)).tolist())
