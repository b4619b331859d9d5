"""Stage: images and volumes → trajectories of surface points, `tracks.npz`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from geomocap.carving.carving_settings import ENCLOSING
from geomocap.carving.silhouette_views import Undistortion
from geomocap.errors import CaptureError
from geomocap.files.capture import Capture
from geomocap.files.frame_files import read_points, read_voxels
from geomocap.files.results import read_silhouette, write_tracks
from geomocap.files.run import Run, stage_key
from geomocap.files.scans import point_spacing
from geomocap.model.frame_geometry import Voxels
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.point_tracking import track_points
from geomocap.patches.seeding import image_reduction
from geomocap.pipeline.cloud_stage import clouds
from geomocap.pipeline.derived import KEYPOINT_FILES
from geomocap.pipeline.job import Job
from geomocap.pipeline.voxel_stage import voxels

_CLOSED = 1.8  # edge of the voxels of a cloud, as a multiple of its spacing: without holes


def tracks(job: Job) -> str:
    """Follow the surface through all frames, and return the stage's key.

    The surface is that of the voxels; where cameras are too few for a hull, the measured cloud. It is made first if
    need be.
    """
    capture = job.capture
    if capture is None:
        raise CaptureError("tracks need a capture")
    pictures = capture.fingerprint("images", "videos", "sparse")
    tables = ("tracking", "filters", "smoothing")
    settings = {name: getattr(job.config, name).model_dump() for name in tables}
    surface = voxels(job) if _has_hull(capture) else clouds(job)
    key = stage_key(__name__, "tracks", surface, pictures, settings, job.fps)
    job.write_record(*tables)
    return job.stage("tracks", key, ["tracks.npz"], lambda: _track(job, capture), derived=KEYPOINT_FILES)


def _track(job: Job, capture: Capture) -> int:
    config, read = job.config, frame_reader(capture, job.run, job.config.tracking)
    parts = (config.tracking, config.filters, config.smoothing)
    write_tracks(job.run, track_points(read, capture.n_frames, job.fps, *parts, job.progress, job.executor))
    return capture.n_frames


def frame_reader(capture: Capture, run: Run, settings: TrackingSettings) -> Callable[[int], FrameViews]:
    """Return what reads the frames of a run for tracking; the first one tells how far images may be reduced."""
    spacing = None if _has_hull(capture) else _CLOSED * point_spacing(read_points(run.frame_file("cloud", 0)).positions)
    read = _ReadFrame(capture, run, settings, Undistortion.of(capture.rig), settings.reduction or 1, spacing)
    return read if settings.reduction else replace(read, reduction=image_reduction(read(0), settings))


def _has_hull(capture: Capture) -> bool:
    return len(capture.rig) >= ENCLOSING


def surface_voxels(points: np.ndarray, size: float) -> Voxels:
    """Return the voxels of `size` (m) that hold points (N, 3): a cloud as a surface that hides what is behind it."""
    origin = points.min(axis=0) if len(points) else np.zeros(3)
    indices = np.unique(np.floor((points - origin) / size).astype(np.int32), axis=0)
    return Voxels(indices, np.zeros((len(indices), 3), np.uint8), origin, size)


@dataclass(frozen=True)
class _ReadFrame:
    """Images, silhouettes and voxels of a frame as tracking wants them."""

    capture: Capture
    run: Run
    settings: TrackingSettings
    undistortion: Undistortion
    reduction: int
    cloud_spacing: float | None

    def __call__(self, frame: int) -> FrameViews:
        cameras = self.capture.cameras
        images = self.undistortion.images([self.capture.frame(c, frame) for c in cameras])
        masks = [read_silhouette(self.run, c, frame) for c in cameras]
        if self.cloud_spacing is None:
            surface = read_voxels(self.run.frame_file("voxels", frame))
        else:
            surface = surface_voxels(read_points(self.run.frame_file("cloud", frame)).positions, self.cloud_spacing)
        return FrameViews.of(self.undistortion.views(masks), images, surface, self.settings.blurs_px, self.reduction)
