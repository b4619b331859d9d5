"""Stage: images → measured surface points `cloud/000000.ply`, and how they came about, `cloud/000000.json`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numba
import numpy as np

from geomocap.carving.carving_settings import ENCLOSING
from geomocap.config import load_config
from geomocap.dense.dense_frame import CloudFrame, cloud_of_frame
from geomocap.dense.dense_settings import CloudSettings
from geomocap.dense.match_groups import MatchGroups, match_groups
from geomocap.dense.matching_images import undistorted_color
from geomocap.errors import CaptureError, GeometryError, GeomocapError
from geomocap.files.capture import Capture
from geomocap.files.results import read_silhouette, read_voxels, write_cloud_record, write_points
from geomocap.files.run import Run, stage_key
from geomocap.pipeline.job import Job
from geomocap.pipeline.silhouette_stage import silhouettes
from geomocap.pipeline.voxel_stage import voxels
from geomocap.scheduling import map_items

BACKGROUND_FRAMES = 10  # fewer frames without a background picture don't show what moves

Bounds = Literal["hull", "silhouettes", "none"]


def clouds(job: Job) -> str:
    """Measure the surface in all frames, silhouettes and hull first where there are any; return the stage's key."""
    capture = job.capture
    if capture is None:
        raise CaptureError("clouds need a capture")
    settings = cloud_settings(job.config.cloud, capture)
    groups = match_groups(capture.rig, settings.groups, capture.info.region_of_interest)
    bounds = bounds_of(capture, settings)
    before = {"hull": voxels, "silhouettes": silhouettes, "none": lambda _: ""}[bounds](job)
    pictures = capture.fingerprint("images", "videos", "sparse")
    key = stage_key(__name__, "cloud", bounds, before, pictures, settings.model_dump(), capture.info.region_of_interest)

    def work() -> int:
        sound = job.run.sound("cloud")
        files = {k: cloud_files(job.run, k) for k in range(capture.n_frames)}
        missing = [k for k, of_frame in files.items() if not sound.issuperset(of_frame)]
        task = _Measure(capture, job.run, settings, groups, bounds, len(missing) == 1)
        for k, _ in zip(missing, map_items(task, missing, job.executor, "cloud", job.progress, 4), strict=True):
            job.run.note("cloud", files[k])
        return len(missing)

    job.write_record("cloud")
    return job.stage("cloud", key, ["cloud"], work)


def cloud_files(run: Run, frame: int) -> list[Path]:
    """Files of a frame: the points, and how they came about."""
    points = run.frame_file("cloud", frame)
    return [points, points.with_suffix(".json")]


def cloud_settings(settings: CloudSettings, capture: Capture) -> CloudSettings:
    """Return the settings, with the capture's template camera if none is set."""
    if capture.info.template_camera is not None and settings.groups.template_camera is None:
        named = settings.groups.model_copy(update={"template_camera": capture.info.template_camera})
        return settings.model_copy(update={"groups": named})
    return settings


def bounds_of(capture: Capture, settings: CloudSettings) -> Bounds:
    """Say what bounds the search: as set, else the most that the capture allows.

    Silhouettes need masks, background pictures of all cameras, or so many frames that what moves stands out.
    """
    if settings.bounds != "auto":
        return settings.bounds
    plates = all(capture.has_background(c) for c in capture.cameras)
    if not (capture.has_masks or plates or capture.n_recorded >= BACKGROUND_FRAMES):
        return "none"
    return "hull" if len(capture.cameras) >= ENCLOSING else "silhouettes"


@dataclass(frozen=True)
class _Measure:
    """Cloud of one frame, written to the run."""

    capture: Capture
    run: Run
    settings: CloudSettings
    groups: MatchGroups
    bounds: Bounds
    alone: bool = False  # one frame by itself has all cores

    def __call__(self, frame: int) -> None:
        before = numba.get_num_threads()
        if self.alone:
            numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        try:
            found = self.measure(frame)
        finally:
            numba.set_num_threads(before)
        write_cloud_record(self.run, frame, len(found.points), found.reasons, found.warnings)
        if not len(found.points):
            why = "; ".join(found.warnings) or ", ".join(f"{reason}: {n}" for reason, n in found.reasons.items())
            raise GeometryError(f"frame {frame}: no surface point could be matched ({why}); is there texture in focus?")
        write_points(self.run.frame_file("cloud", frame), found.cloud)

    def measure(self, frame: int) -> CloudFrame:
        """Measure one frame without writing anything."""
        cameras = self.capture.cameras
        images = [self.capture.frame(c, frame) for c in cameras]
        masks = hull = None
        if self.bounds != "none":
            masks = [read_silhouette(self.run, c, frame) for c in cameras]
        if self.bounds == "hull":
            hull = read_voxels(self.run.frame_file("voxels", frame))
        box = self.capture.info.region_of_interest
        return cloud_of_frame(images, masks, hull, self.capture.rig, self.groups, self.settings, box)


def measure_again(run: Run, capture: Capture | None, frame: int) -> tuple[CloudFrame, np.ndarray] | None:
    """Measure one frame of a run once more, for what its files don't hold: regions, shifts, seeds.

    The settings are those of the run; silhouettes and hull are taken from it.

    Returns
    -------
    (CloudFrame, (H, W, 3) uint8) or None
        With the image of the template that gave most points, free of distortion; None if the capture is not at hand
        or nothing is found.
    """
    if capture is None or not capture.is_calibrated:
        return None
    settings = cloud_settings(load_config(run.path / "run.toml").cloud, capture)
    groups = match_groups(capture.rig, settings.groups, capture.info.region_of_interest)
    try:
        found = _Measure(capture, run, settings, groups, bounds_of(capture, settings)).measure(frame)
    except GeomocapError:
        return None
    if not len(found.points):
        return None
    template = max(found.templates, key=lambda t: len(t.points)).group.template
    return found, undistorted_color(capture.frame(capture.cameras[template], frame), groups, template)
