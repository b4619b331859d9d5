"""Segmentation as the M3 paper has it: split, merge, match, group by relative paths (sections 5 to 7)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from geomocap.errors import GeometryError
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items
from geomocap.segmentation.body_rotations import body_rotations
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
    executor: Executor | None = None,
    progress: Progress = silent,
) -> Segmentation:
    """Divide a sequence of points into ellipsoids and rigid bodies.

    Parameters
    ----------
    points : callable or sequence
        `points(frame)` gives the (N, 3) points of a frame, metres, world; or a sequence of such arrays.
    frames : int, optional
        Number of frames T; that of the sequence if not given.
    spacing : float, metres
        Voxel size, or the mean distance of a point from its nearest neighbour.
    settings : SegmentationSettings, optional
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
        If there are no frames, the spacing is not positive, or a frame is empty, too small or not finite; the frame
        is named.
    """
    settings = settings or SegmentationSettings()
    if not callable(points):
        frames = len(points) if frames is None else frames
        points = points.__getitem__
    if not frames or frames < 1:
        raise GeometryError("no frames to segment; the capture or the folder of scans is empty")
    if not (np.isfinite(spacing) and spacing > 0):
        raise GeometryError(f"point spacing {spacing}: expected a positive length in metres")

    def run(some: Points, some_progress: Progress = silent) -> EllipsoidPaths:
        return ellipsoid_paths(some, frames, spacing, settings, executor, some_progress)

    # Steps 1 and 2: ellipsoids of every frame, matched from frame to frame
    paths = run(points, progress)
    # Step 3: rigid bodies from relative paths
    integrals = path_integrals(paths.ellipsoids.centers)
    threshold = max(similarity_threshold(integrals, settings.body_deviations), _STILL * spacing)
    if frames == 1:
        grouping = Grouping(np.full(len(integrals), -1, np.int32), np.empty(0, np.int32), integrals, threshold)
    elif settings.iterative:
        paths, grouping = peel_bodies(run, points, paths, threshold, settings.min_points, spacing)
    else:
        first = paths.ellipsoids
        grouping = group_paths(integrals, first.centers[0], first.counts[0], threshold)
    return _result(paths, grouping, spacing)


def ellipsoid_paths(
    points: Points,
    frames: int,
    spacing: float,
    settings: SegmentationSettings,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> EllipsoidPaths:
    """Split every frame into ellipsoids, merge those of the first, and match them in time (sections 5 and 6).

    Parameters and errors as of `segment_m3`.
    """
    return match_frames(_splits(points, frames, spacing, settings, executor, progress), settings)


def _split(points: Points, spacing: float, settings: SegmentationSettings, frame: int) -> SplitFrame:
    return split_frame(points(frame), spacing, settings, frame)


def _splits(
    points: Points,
    frames: int,
    spacing: float,
    settings: SegmentationSettings,
    executor: Executor | None,
    progress: Progress,
) -> Iterator[SplitFrame]:
    work = partial(_split, points, spacing, settings)
    if executor is not None:
        yield from map_items(work, range(frames), executor, "segment", progress)
        return
    progress("segment", 0, frames)
    for frame in range(frames):
        yield work(frame)
        progress("segment", frame + 1, frames)


def _result(paths: EllipsoidPaths, grouping: Grouping, spacing: float) -> Segmentation:
    body = grouping.body
    count = len(grouping.seeds)
    bodies = unite(paths.ellipsoids, body, count)
    member = (body[None] == np.arange(count)[:, None]).astype(float)
    contacts = member @ paths.contacts @ member.T
    np.fill_diagonal(contacts, 0.0)
    return Segmentation(
        paths.ellipsoids,
        body,
        paths.labels,
        bodies,
        body_rotations(paths.ellipsoids, body, bodies),
        contacts,
        _touching(paths.touching, body, count),
        grouping.seeds,
        grouping.integrals,
        grouping.threshold,
        paths.repaired,
        spacing,
    )


def _touching(touching: np.ndarray, body: np.ndarray, count: int) -> np.ndarray:
    """Fraction of the frames in which two bodies touch: that of their pair of ellipsoids that touches most."""
    result = np.zeros((count, count))
    for a in range(count):
        for b in range(a):
            result[a, b] = result[b, a] = touching[np.ix_(body == a, body == b)].max(initial=0.0)
    return result
