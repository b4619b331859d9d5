"""Stage: silhouettes → coloured surface voxels, `voxels/000000.ply`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from geomocap.carving.agreement import check_cameras, check_silhouettes
from geomocap.carving.carving_settings import CarvingSettings
from geomocap.carving.frames import carve_frame, needs_images
from geomocap.carving.silhouette_views import PinholeViews, Undistortion
from geomocap.carving.volume import working_volume
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import CaptureError
from geomocap.files.capture import Capture
from geomocap.files.results import read_silhouette, write_voxels
from geomocap.files.run import Run, stage_key
from geomocap.model.even_choice import evenly_chosen
from geomocap.pipeline.correction_stage import with_cameras
from geomocap.pipeline.job import Job
from geomocap.pipeline.silhouette_stage import silhouettes
from geomocap.scheduling import map_items

VOLUME_FRAMES = 60  # the working volume is found from at most so many frames, spread over the sequence


def voxels(job: Job) -> str:
    """Carve all frames, silhouettes first if need be, and return the stage's key."""
    job, _ = with_cameras(job)
    capture = job.capture
    if capture is None:
        raise CaptureError("voxels need a capture")
    settings = carving_settings(job, capture)
    _ = capture.rig  # what is wrong with the calibration is said before long work begins
    key = stage_key(
        __name__, "voxels", silhouettes(job), capture.fingerprint("images", "videos", "sparse"), settings.model_dump()
    )
    job.write_record("carving")
    return job.stage("voxels", key, ["voxels"], lambda: _carve_all(job, capture, settings))


def carving_settings(job: Job, capture: Capture) -> CarvingSettings:
    """Return the settings, with the capture's region of interest as the volume if none is set."""
    settings = job.config.carving
    if settings.volume is None and capture.info.region_of_interest is not None:
        return settings.model_copy(update={"volume": capture.info.region_of_interest})
    return settings


def _carve_all(job: Job, capture: Capture, settings: CarvingSettings) -> int:
    undistortion = Undistortion.of(capture.rig)
    task = _Carve(capture, job.run, settings, undistortion, None)
    check_cameras(task.views(0).everything(), settings.hull)
    sample = evenly_chosen(capture.n_frames, VOLUME_FRAMES).tolist()
    grid = working_volume(_reported(job, task, sample), settings, sample)
    sound = job.run.sound("voxels")
    missing = [k for k in range(capture.n_frames) if job.run.frame_file("voxels", k) not in sound]
    task = _Carve(capture, job.run, settings, undistortion, grid)
    for k, _ in zip(missing, map_items(task, missing, job.executor, "voxels", job.progress, 8), strict=True):
        job.run.note("voxels", [job.run.frame_file("voxels", k)])
    return len(missing)


def _reported(job: Job, task: _Carve, frames: list[int]) -> Iterator[PinholeViews]:
    yield from map_items(task.checked_views, frames, job.executor, "volume", job.progress, 4)


@dataclass(frozen=True)
class _Carve:
    """Surface voxels of one frame, written to the run."""

    capture: Capture
    run: Run
    settings: CarvingSettings
    undistortion: Undistortion
    grid: Grid | None

    def views(self, frame: int) -> PinholeViews:
        """Read the silhouettes of a frame as the pinhole cameras see them."""
        cameras = self.capture.cameras
        return self.undistortion.views([read_silhouette(self.run, c, frame) for c in cameras])

    def checked_views(self, frame: int) -> PinholeViews:
        """Read the silhouettes of a frame; an empty one is reported with the mask it was taken from."""
        capture, views = self.capture, self.views(frame)
        given = {c: capture.mask_file(c, frame) for c in capture.cameras} if capture.has_masks else None
        check_silhouettes(views, frame, self.settings.hull, given)
        return views

    def __call__(self, frame: int) -> None:
        assert self.grid is not None
        views, images = self.checked_views(frame), None
        if self.capture.has_images and needs_images(self.settings):
            within = views if self.settings.hull.tolerance == 0 else None  # every voxel is in all silhouettes
            images = self.undistortion.images([self.capture.frame(c, frame) for c in self.capture.cameras], within)
        found = carve_frame(views, self.grid, self.settings, images, frame)
        write_voxels(self.run.frame_file("voxels", frame), found)
