"""Stage: images and volumes → trajectories of surface points, `tracks.npz`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from geomocap.carving.carving_settings import ENCLOSING
from geomocap.carving.silhouette_views import Undistortion
from geomocap.dense.dense_settings import CloudSettings
from geomocap.dense.match_groups import too_far_apart
from geomocap.errors import CaptureError
from geomocap.files.capture import Capture
from geomocap.files.frame_files import read_points, read_voxels
from geomocap.files.results import TRACKS, join_tracks, read_silhouette, write_tracks
from geomocap.files.run import Run, stage_key
from geomocap.files.run_window import RunWindow
from geomocap.model.frame_geometry import Voxels
from geomocap.model.surface import point_spacing
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.point_tracking import track_points
from geomocap.patches.seeding import image_reduction
from geomocap.pipeline.cloud_stage import check_images, clouds
from geomocap.pipeline.correction_stage import with_cameras
from geomocap.pipeline.derived import KEYPOINT_FILES
from geomocap.pipeline.job import Job
from geomocap.pipeline.voxel_stage import voxels
from geomocap.scheduling import map_items
from geomocap.trajectories.trajectory_settings import FilterSettings, SmoothingSettings

# Three cameras, 120° apart, of a machine on legs: 12 bodies for 9, core index 0.71, 5 of 8 joints within 5 % of the
# height; two that faced each other: core index 0.49, no joint.
_AROUND = 3
_CLOSED = 1.8  # edge of the voxels of a cloud, as a multiple of its spacing: without holes


def tracks(job: Job) -> str:
    """Follow the surface through all frames, and return the stage's key.

    The surface is that of the voxels; where cameras are too few to enclose the subject, the measured cloud, unless
    three are around it, too far apart to be matched. It is made first if need be.
    """
    job, _ = with_cameras(job)
    capture = job.capture
    if capture is None:
        raise CaptureError("tracks need a capture")
    check_images(capture)
    pictures = capture.fingerprint("images", "videos", "sparse")
    tables = ("tracking", "filters", "smoothing")
    settings = {name: getattr(job.config, name).model_dump() for name in tables}
    surface = voxels(job) if _on_hull(capture, job.config.cloud) else clouds(job)
    windows = job.windows
    key = stage_key(__name__, "tracks", surface, pictures, settings, job.fps, windows)
    job.write_record(*tables, "windows")
    work = partial(_track, job, capture) if len(windows) == 1 else partial(_track_windows, job, capture, windows)
    job.stage("tracks", key, [TRACKS], work, derived=KEYPOINT_FILES)
    if capture.n_frames == 1:
        job.tell(
            f"{capture.path}: a single frame shows no motion; trajectories take more frames, {TRACKS} was made "
            "without any"
        )
    return key


def _track(job: Job, capture: Capture) -> int:
    config, read = job.config, frame_reader(capture, job.run, job.config.tracking, job.config.cloud)
    parts = (config.tracking, config.filters, config.smoothing)
    write_tracks(job.run, track_points(read, capture.n_frames, job.fps, *parts, job.progress, job.executor))
    return capture.n_frames


def _track_windows(job: Job, capture: Capture, windows: list[range]) -> int:
    """Track each window by itself, side by side, and join what was found; windows that are done stay."""
    files = [job.part(w).run.path / TRACKS for w in windows]
    sound = job.run.sound("tracks")
    missing = [k for k, file in enumerate(files) if file not in sound]
    if missing:
        config = job.config
        reduction = frame_reader(capture, job.run, config.tracking, config.cloud).reduction
        tracking = config.tracking.model_copy(update={"reduction": reduction})
        task = _TrackWindow(capture, job.run, job.fps, tracking, config.cloud, config.filters, config.smoothing)
        made = map_items(task, [windows[k] for k in missing], job.executor, "track windows", job.progress)
        for k, _ in zip(missing, made, strict=True):
            job.run.note("tracks", [files[k]])
    join_tracks(job.run, [job.part(w).run for w in windows], windows, capture.n_frames)
    return sum(len(windows[k]) for k in missing)


@dataclass(frozen=True)
class _TrackWindow:
    """Trajectories of one window, written into its folder."""

    capture: Capture
    run: Run
    fps: float
    tracking: TrackingSettings
    cloud: CloudSettings
    filters: FilterSettings
    smoothing: SmoothingSettings

    def __call__(self, window: range) -> None:
        run = RunWindow.of(self.run, window)
        read = frame_reader(self.capture.part(window), run, self.tracking, self.cloud)
        found = track_points(read, len(window), self.fps, self.tracking, self.filters, self.smoothing)
        write_tracks(run, replace(found, unfiltered=None, kept=None))


def frame_reader(capture: Capture, run: Run, settings: TrackingSettings, cloud: CloudSettings) -> ReadFrame:
    """Return what reads the frames of a run for tracking; the first one tells how far images may be reduced.

    `cloud` are the settings by which a cloud was measured if there is one.
    """
    spacing = None
    if not _on_hull(capture, cloud):
        spacing = _CLOSED * point_spacing(read_points(run.frame_file("cloud", 0)).positions, np.mean)
    read = ReadFrame(capture, run, settings, Undistortion.of(capture.rig), settings.reduction or 1, spacing)
    return read if settings.reduction else replace(read, reduction=image_reduction(read(0), settings))


def _on_hull(capture: Capture, settings: CloudSettings) -> bool:
    """Whether the surface is the hull's: cameras enclose the subject, or three are too far apart to be matched."""
    if len(capture.rig) >= ENCLOSING:
        return True
    if len(capture.rig) < _AROUND:
        return False
    return too_far_apart(capture.rig, settings.groups, capture.info.region_of_interest)


def surface_voxels(points: np.ndarray, size: float) -> Voxels:
    """Return the voxels of `size` (m) that hold points (N, 3): a cloud as a surface that hides what is behind it."""
    origin = points.min(axis=0) if len(points) else np.zeros(3)
    indices = np.unique(np.floor((points - origin) / size).astype(np.int32), axis=0)
    return Voxels(indices, np.zeros((len(indices), 3), np.uint8), origin, size)


@dataclass(frozen=True)
class ReadFrame:
    """Images, silhouettes and voxels of a frame as tracking wants them."""

    capture: Capture
    run: Run
    settings: TrackingSettings
    undistortion: Undistortion
    reduction: int
    cloud_spacing: float | None

    def __call__(self, frame: int) -> FrameViews:
        """Read one frame."""
        cameras = self.capture.cameras
        views = self.undistortion.views([read_silhouette(self.run, c, frame) for c in cameras])
        images = self.undistortion.images([self.capture.frame(c, frame) for c in cameras], views)
        if self.cloud_spacing is None:
            surface = read_voxels(self.run.frame_file("voxels", frame))
        else:
            surface = surface_voxels(read_points(self.run.frame_file("cloud", frame)).positions, self.cloud_spacing)
        return FrameViews.of(views, images, surface, self.settings.blurs_px, self.reduction)
