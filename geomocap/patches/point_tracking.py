"""Points of the surface through all frames: followed, filtered, with velocities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor

import numpy as np

from geomocap.carving.silhouette_views import Undistortion
from geomocap.errors import GeometryError
from geomocap.model.frame_geometry import Voxels
from geomocap.model.rig import Rig
from geomocap.model.trajectories import Tracks
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.patch_tracking import track_surface
from geomocap.patches.seeding import image_reduction
from geomocap.progress import Progress, silent
from geomocap.settings import check_fps
from geomocap.trajectories.filters import filter_trajectories
from geomocap.trajectories.smoothing import smooth_motion
from geomocap.trajectories.trajectory_settings import FilterSettings, SmoothingSettings


def track_points(
    frames: Callable[[int], FrameViews],
    n_frames: int,
    fps: float,
    settings: TrackingSettings | None = None,
    filters: FilterSettings | None = None,
    smoothing: SmoothingSettings | None = None,
    progress: Progress = silent,
    executor: Executor | None = None,
) -> Tracks:
    """Follow the surface, cut what can't be true, and estimate velocities and accelerations.

    Parameters
    ----------
    frames : callable
        `frames(frame)`: images, silhouettes and surface of a frame.
    n_frames : int
    fps : float
        Frames per second.
    settings, filters, smoothing : optional
    progress : Progress
    executor : Executor, optional
        See `track_surface`.
    """
    found = track_surface(frames, n_frames, settings, progress, executor)
    unfiltered = found.positions.astype(np.float32)
    # nothing is held longer than it is needed: long recordings have many trajectories
    filtered = filter_trajectories(found, smooth_motion(found.positions, fps, found.sigma, smoothing), filters)
    del found
    kept = filtered.trajectories
    return Tracks(kept, smooth_motion(kept.positions, fps, kept.sigma, smoothing), unfiltered, filtered.kept)


def track(
    images: Sequence[Sequence[np.ndarray]],
    masks: Sequence[Sequence[np.ndarray]],
    volumes: Sequence[Voxels],
    rig: Rig,
    *,
    fps: float,
    settings: TrackingSettings | None = None,
    progress: Progress = silent,
) -> Tracks:
    """Follow points of the surface through the images of all cameras.

    Parameters
    ----------
    images : sequence of T sequences of C arrays (H, W, 3) uint8, RGB
    masks : sequence of T sequences of C arrays (H, W)
        Silhouettes, not 0 on the subject.
    volumes : sequence of T Voxels
        Surface voxels of each frame, as from `carve`.
    rig : Rig
        The C cameras.
    fps : float
        Frames per second.
    settings : TrackingSettings, optional
    progress : Progress

    Returns
    -------
    Tracks
        `trajectories.positions` (N, T, 3) m, NaN where not measured, with `sigma`; `motion` has velocities.

    Raises
    ------
    GeometryError
        If the numbers of frames differ, or a frame can't be tracked.
    SettingsError
        If `fps` is none.
    """
    check_fps(fps)
    settings = settings or TrackingSettings()
    if not len(images) == len(masks) == len(volumes):
        raise GeometryError(
            f"tracking: {len(images)} frames of images, {len(masks)} of masks, {len(volumes)} of voxels"
        )
    undistortion = Undistortion.of(rig)

    def read(frame: int, reduction: int) -> FrameViews:
        views = undistortion.views(masks[frame])
        straight = undistortion.images(images[frame], views)
        return FrameViews.of(views, straight, volumes[frame], settings.blurs_px, reduction)

    reduction = settings.reduction or image_reduction(read(0, 1), settings)
    return track_points(lambda k: read(k, reduction), len(images), fps, settings, progress=progress)
