"""Stage: images → measured surface points, `cloud/000000.ply` and beside it why matches failed, `cloud/000000.json`."""

from __future__ import annotations

import json
from dataclasses import dataclass

import open3d as o3d

from geomocap.capture import Capture, read_image
from geomocap.cloud import CloudSettings, MatchGroups, cloud_of_frame, match_groups
from geomocap.errors import CaptureError, GeometryError
from geomocap.files import write_atomic, write_text
from geomocap.geometry import Voxels
from geomocap.pipeline.job import Job
from geomocap.pipeline.silhouettes import silhouettes
from geomocap.pipeline.voxels import voxels
from geomocap.run import Run, stage_key
from geomocap.scheduling import map_items

HULL_CAMERAS = 4  # fewer cameras don't enclose the subject: their hull bounds nothing


def clouds(job: Job) -> str:
    """Measure the surface in all frames, silhouettes and hull first if need be, and return the stage's key."""
    capture = job.capture
    if capture is None:
        raise CaptureError("clouds need a capture")
    settings = job.config.cloud
    if capture.info.template_camera is not None and settings.groups.template_camera is None:
        named = settings.groups.model_copy(update={"template_camera": capture.info.template_camera})
        settings = settings.model_copy(update={"groups": named})
    groups = match_groups(capture.rig, settings.groups)
    with_hull = len(capture.rig) >= HULL_CAMERAS
    bounds = voxels(job) if with_hull else silhouettes(job)
    pictures = capture.fingerprint("images", "videos", "sparse")
    key = stage_key("cloud", bounds, pictures, settings.model_dump())

    def work() -> int:
        task = _Measure(capture, job.run, settings, groups, with_hull)
        missing = [k for k in range(capture.n_frames) if not job.run.frame_file("cloud", k).exists()]
        for _ in map_items(task, missing, job.executor, "cloud", job.progress, 4):
            pass
        return len(missing)

    return job.stage("cloud", key, ["cloud"], work)


@dataclass(frozen=True)
class _Measure:
    """Cloud of one frame, written to the run."""

    capture: Capture
    run: Run
    settings: CloudSettings
    groups: MatchGroups
    with_hull: bool

    def __call__(self, frame: int) -> None:
        cameras = self.capture.cameras
        images = [self.capture.frame(c, frame) for c in cameras]
        masks = [read_image(self.run.silhouette_file(c, frame), gray=True) for c in cameras]
        hull = Voxels.read(self.run.frame_file("voxels", frame)) if self.with_hull else None
        found = cloud_of_frame(images, masks, hull, self.capture.rig, self.groups, self.settings)
        write_text(self.run.path / "cloud" / f"{frame:06d}.json", json.dumps(found.reasons, indent=1))
        if not len(found.points):
            why = ", ".join(f"{reason}: {count}" for reason, count in found.reasons.items())
            raise GeometryError(f"frame {frame}: no surface point could be matched ({why}); is there texture in focus?")
        cloud = found.cloud
        write_atomic(self.run.frame_file("cloud", frame), lambda p: o3d.t.io.write_point_cloud(p, cloud))
