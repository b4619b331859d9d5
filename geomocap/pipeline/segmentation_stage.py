"""Stage: frame geometry → ellipsoids, rigid bodies and skeleton: `ellipsoids.npz`, `bodies/`, `skeleton.npz`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from geomocap.errors import GeometryError, SettingsError
from geomocap.files.results import (
    WARNINGS,
    read_warnings,
    write_diagnostics,
    write_ellipsoids,
    write_points,
    write_skeleton,
    write_warnings,
)
from geomocap.files.run import Run, stage_key
from geomocap.files.scan_checks import scan_doubts
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.frame_geometry import BodyPoints, Geometry
from geomocap.pipeline.cloud_stage import bounds_of
from geomocap.pipeline.derived import FROM_BODIES
from geomocap.pipeline.following_stage import segment_with_model
from geomocap.pipeline.job import Job
from geomocap.pipeline.motion_stage import segment_by_motion
from geomocap.pipeline.path_choice import carrying_tracks
from geomocap.pipeline.sources import Source, geometry_of
from geomocap.pipeline.track_stage import tracks
from geomocap.pipeline.window_stage import segment_windows
from geomocap.scheduling import map_items
from geomocap.segmentation.m3 import check_variant, segment_m3
from geomocap.segmentation.m3_result import Segmentation
from geomocap.skeleton.m3_skeleton import skeleton_m3
from geomocap.subject.subject_model import MODEL_FILE


def segment(job: Job, source: Source) -> str:
    """Find ellipsoids, bodies and skeleton; return the stage's key."""
    config = job.config
    if job.capture is not None and config.segmentation.paths == "points":
        raise SettingsError("segmentation.paths = points is for scans; of a capture take auto, patches or nodes")
    check_variant(config.segmentation)
    geometry, source_key = geometry_of(job, source)
    if job.model is not None:
        return segment_with_model(job, geometry, source_key)
    by_motion = config.segmentation.method == "motion" and len(geometry) > 1
    carried = config.segmentation.paths == "patches" and len(geometry) > 1  # ellipsoids of M3, by patches
    has_tracks = (by_motion or carried) and _is_tracked(job, source)
    has_silhouettes = by_motion and _has_silhouettes(job, source)
    tables = ("nodes", "motion_bodies", "motion_skeleton", "refinement", "following") if by_motion else ("skeleton",)
    settings = {name: getattr(config, name).model_dump() for name in ("segmentation", *tables)}
    outputs, optional = ["ellipsoids.npz", "bodies", "diagnostics.npz"], [MODEL_FILE, WARNINGS]
    # a single frame has no motion to tell bodies and joints by
    (outputs if len(geometry) > 1 else optional).append("skeleton.npz")
    windows = job.windows if by_motion else []
    work: Callable[[Job, Geometry], int] = partial(segment_as_m3, has_tracks=has_tracks)
    if by_motion:
        work = partial(segment_by_motion, has_tracks=has_tracks, has_silhouettes=has_silhouettes)
    if len(windows) > 1:
        work = partial(segment_windows, windows=windows, has_tracks=has_tracks, has_silhouettes=has_silhouettes)
    key = stage_key(
        __name__, "segmentation", source_key, tracks(job) if has_tracks else None, settings, job.fps, windows
    )
    return job.stage(
        "segmentation", key, outputs, lambda: _doubting(job, lambda: work(job, geometry)), optional, FROM_BODIES
    )


def _doubting(job: Job, work: Callable[[], int]) -> int:
    """Do the work, of scans after these have been compared; what is doubtful about them is written with the results."""
    if job.scans is None or len(job.scans) == 1:
        return work()
    try:
        doubts = (*job.scans.doubts, *scan_doubts(job.scans.points, job.scans.names, job.progress))
    except GeometryError as error:
        raise job.scans.with_order(error) from None
    frames = work()
    if doubts:
        write_warnings(job.run, [*doubts, *read_warnings(job.run)])
    return frames


def _is_tracked(job: Job, source: Source) -> bool:
    """Whether the surface is to be tracked in the images, which takes a volume."""
    if (
        job.capture is None
        or not job.capture.has_images
        or job.config.segmentation.paths in ("nodes", "points", "ellipsoids")
    ):
        return False
    return source != "cloud" or bounds_of(job.capture, job.config.cloud) == "hull"


def _has_silhouettes(job: Job, source: Source) -> bool:
    """Whether silhouettes were made for the geometry: of clouds only where they bound the search."""
    if job.capture is None:
        return False
    return source != "cloud" or bounds_of(job.capture, job.config.cloud) != "none"


def segment_as_m3(job: Job, geometry: Geometry, has_tracks: bool = False) -> int:
    """Follow the paper: ellipsoids, bodies from their paths, joints by growing samples; return the frames' number.

    Ellipsoids are carried by tracks where `segmentation.paths` names some (`carrying_tracks`).
    """
    frames = len(geometry)
    found = segment_m3(
        geometry.points,
        frames,
        spacing=geometry.spacing,
        settings=job.config.segmentation,
        tracks=carrying_tracks(job, geometry, has_tracks) if frames > 1 else None,
        executor=job.executor,
        progress=job.progress,
    )
    write = _WriteBodies(geometry, job.run, found)
    for _ in map_items(write, range(frames), job.executor, "bodies", job.progress):
        pass
    job.run.note("segmentation", [job.run.frame_file("bodies", k) for k in range(frames)])
    write_ellipsoids(job.run, replace(found.ellipsoids, body=found.body))
    if frames > 1:
        with job.run.timed("skeleton") as count:
            skeleton = skeleton_m3(found, job.fps, job.config.skeleton)
            write_skeleton(job.run, skeleton)
            count["items"] = frames
    made = Diagnostics(
        integrals=found.integrals,
        threshold=found.threshold,
        seeds=found.seeds,
        repaired=found.repaired,
        touching=found.touching,
        body=found.body,
    )
    write_diagnostics(job.run, made)
    return frames


@dataclass(frozen=True)
class _WriteBodies:
    """Points of one frame with their bodies, written to the run."""

    geometry: Geometry
    run: Run
    found: Segmentation

    def __call__(self, frame: int) -> None:
        points = BodyPoints(self.geometry.points(frame), self.found.body_labels(frame))
        write_points(self.run.frame_file("bodies", frame), points)
