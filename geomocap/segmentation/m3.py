"""Segmentation as the M3 paper has it: split, merge, match, group by relative paths (sections 5 to 7)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from geomocap.errors import GeometryError, SettingsError
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items
from geomocap.segmentation.body_rotations import body_rotations, carried_bodies
from geomocap.segmentation.contacts import contacts_of_bodies
from geomocap.segmentation.ellipsoid_matching import EllipsoidPaths, match_frames
from geomocap.segmentation.ellipsoid_splitting import SplitFrame, split_frame
from geomocap.segmentation.iterations import peel_bodies
from geomocap.segmentation.m3_result import Segmentation
from geomocap.segmentation.m3_settings import SegmentationSettings
from geomocap.segmentation.relative_paths import Grouping, group_paths, path_integrals, similarity_threshold, unite

Points = Callable[[int], np.ndarray]
"""Gives the (N, 3) points of a frame, metres, world; called when they are needed, more than once if iterative."""

_STILL = 1.0
"""Relative paths that stay closer than this, spacings, show no motion, whatever the statistics say."""


def segment_m3(
    points: Points | Sequence[np.ndarray],
    frames: int | None = None,
    *,
    spacing: float,
    settings: SegmentationSettings | None = None,
    tracks: np.ndarray | None = None,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> Segmentation:
    """Divide a sequence of points into ellipsoids and rigid bodies.

    The ellipsoids of independently split frames slide on the surface. If points of it were tracked, these carry the
    ellipsoids: matching looks for each where its tracked points lead, and paths and turns are theirs
    (`carried_ellipsoids`). Everything else is the paper's.

    Parameters
    ----------
    points : callable or sequence
        `points(frame)` gives the (N, 3) points of a frame, metres, world; or a sequence of such arrays.
    frames : int, optional
        Number of frames T; that of the sequence if not given.
    spacing : float, metres
        Voxel size, or the mean distance of a point from its nearest neighbour.
    settings : SegmentationSettings, optional
    tracks : (N, T, 3) float, optional
        Points that were tracked on the surface, metres, world; NaN where not seen.
    executor : Executor, optional
        Maps the split stage over the frames; needs picklable `points` if it runs in other processes.
    progress : Progress, optional
        Called as stage "segment" for every frame.

    Returns
    -------
    Segmentation

    Raises
    ------
    GeometryError
        If there are no frames, the spacing is not positive, tracks have other frames, or a frame is empty, too small
        or not finite; the frame is named.
    SettingsError
        If tracks are given for the iterative variant, which takes volumes apart.
    """
    settings = settings or SegmentationSettings()
    points, frames = _checked(points, frames, spacing)
    if tracks is not None and tracks.shape[1:] != (frames, 3):
        raise GeometryError(f"tracks have shape {tracks.shape}, expected (N, {frames}, 3): one position a frame")
    check_variant(settings, tracks is not None)

    def follow(some: Points, some_progress: Progress = silent) -> EllipsoidPaths:
        return ellipsoid_paths(some, frames, spacing, settings, executor, some_progress)

    # Ellipsoids of every frame, and their paths (sections 5 and 6)
    paths = ellipsoid_paths(points, frames, spacing, settings, executor, progress, tracks)
    # Rigid bodies by relative paths (section 7)
    motion = paths.motion
    integrals = path_integrals(paths.ellipsoids.centers) if motion is None else motion.integrals()
    threshold = max(similarity_threshold(integrals), _STILL * spacing)
    if frames == 1:
        grouping = Grouping.without_motion(integrals, threshold)
    elif settings.iterative:
        # The largest body is taken out and the rest done again (section 9)
        paths, grouping = peel_bodies(follow, points, paths, threshold, settings.min_points, spacing)
    else:
        grouping = group_paths(integrals, paths.ellipsoids.centers[0], paths.ellipsoids.counts[0], threshold)
    # One ellipsoid for each body and frame (section 7, end), and its turns
    body, count = grouping.body, len(grouping.seeds)
    bodies = unite(paths.ellipsoids, body, count)
    if motion is None:
        rotations, positions = body_rotations(paths.ellipsoids, body, bodies), bodies.centers
    else:
        rotations, positions = carried_bodies(paths.ellipsoids, body, motion, count)
    contacts, touching = contacts_of_bodies(paths.contacts, paths.touching, body, count)
    return Segmentation(
        paths.ellipsoids,
        body,
        paths.labels,
        bodies,
        rotations,
        positions,
        motion is not None,
        contacts,
        touching,
        grouping.seeds,
        grouping.integrals,
        grouping.threshold,
        paths.repaired,
        spacing,
    )


def check_variant(settings: SegmentationSettings, carried: bool | None = None) -> None:
    """Refuse the iterative variant with tracks; whether there are some is what the settings say, if not given.

    Raises
    ------
    SettingsError
    """
    if carried is None:
        carried = settings.method == "m3" and settings.paths in ("patches", "points")
    if carried and settings.iterative:
        raise SettingsError(
            "segmentation.iterative takes volumes apart and follows no tracks; set segmentation.paths = auto, or "
            "segmentation.iterative = false"
        )


def ellipsoid_paths(
    points: Points,
    frames: int,
    spacing: float,
    settings: SegmentationSettings,
    executor: Executor | None = None,
    progress: Progress = silent,
    tracks: np.ndarray | None = None,
) -> EllipsoidPaths:
    """Split every frame into ellipsoids, merge those of the first, and match them in time (sections 5 and 6).

    Parameters and errors as of `segment_m3`.
    """
    split = partial(_split, points, spacing, settings)
    # Split every frame (section 5.2.1)
    splits = map_items(split, range(frames), executor, "segment", progress)
    # Merge those of the first (section 5.2.2), and match them from frame to frame (section 6)
    return match_frames(splits, settings, tracks)


def _checked(points: Points | Sequence[np.ndarray], frames: int | None, spacing: float) -> tuple[Points, int]:
    """What gives the points of a frame, and the number of frames."""
    if not callable(points):
        frames = len(points) if frames is None else frames
        points = points.__getitem__
    if not frames or frames < 1:
        raise GeometryError("no frames to segment; the capture or the folder of scans is empty")
    if not (np.isfinite(spacing) and spacing > 0):
        raise GeometryError(f"point spacing {spacing}: expected a positive length in metres")
    return points, frames


def _split(points: Points, spacing: float, settings: SegmentationSettings, frame: int) -> SplitFrame:
    return split_frame(points(frame), spacing, settings, frame)
