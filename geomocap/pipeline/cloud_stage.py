"""Stage: images → measured surface points `cloud/000000.ply`, and how they came about, `cloud/000000.json`."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numba
import open3d as o3d

from geomocap.carving.carving_settings import ENCLOSING
from geomocap.dense.dense_frame import CloudFrame, cloud_of_frame
from geomocap.dense.dense_settings import CloudSettings
from geomocap.dense.match_groups import MatchGroups, match_groups
from geomocap.errors import CaptureError, GeometryError, RunError
from geomocap.files.atomic import write_atomic, write_text
from geomocap.files.capture import Capture
from geomocap.files.images import read_image
from geomocap.files.run import Run, stage_key
from geomocap.model.frame_geometry import Voxels
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
        missing = [k for k in range(capture.n_frames) if not job.run.frame_file("cloud", k).exists()]
        task = _Measure(capture, job.run, settings, groups, bounds, len(missing) == 1)
        for _ in map_items(task, missing, job.executor, "cloud", job.progress, 4):
            pass
        return len(missing)

    job.write_record("cloud")
    return job.stage("cloud", key, ["cloud"], work)


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
        record = {"points": len(found.points), "reasons": found.reasons, "warnings": found.warnings}
        write_text(self.run.path / "cloud" / f"{frame:06d}.json", json.dumps(record, indent=1))
        if not len(found.points):
            why = "; ".join(found.warnings) or ", ".join(f"{reason}: {n}" for reason, n in found.reasons.items())
            raise GeometryError(f"frame {frame}: no surface point could be matched ({why}); is there texture in focus?")
        cloud = found.cloud
        write_atomic(self.run.frame_file("cloud", frame), lambda p: o3d.t.io.write_point_cloud(p, cloud))

    def measure(self, frame: int) -> CloudFrame:
        """Measure one frame without writing anything."""
        cameras = self.capture.cameras
        images = [self.capture.frame(c, frame) for c in cameras]
        masks = hull = None
        if self.bounds != "none":
            masks = [read_image(self.run.silhouette_file(c, frame), gray=True) for c in cameras]
        if self.bounds == "hull":
            hull = Voxels.read(self.run.frame_file("voxels", frame))
        box = self.capture.info.region_of_interest
        return cloud_of_frame(images, masks, hull, self.capture.rig, self.groups, self.settings, box)


@dataclass(frozen=True)
class CloudRecord:
    """What a run says of its clouds.

    Attributes
    ----------
    frames : int
    points : int
        Of all frames.
    reasons : dict
        What became of all cells and seeds, in words, summed over the frames.
    warnings : dict
        Warnings, and the number of frames that have them or the same with other figures.
    """

    frames: int
    points: int
    reasons: dict[str, int]
    warnings: dict[str, int]


def read_cloud_record(run: Run) -> CloudRecord | None:
    """Sum up `cloud/*.json` of a run; None if there are none.

    Raises
    ------
    RunError
        If a file is damaged.
    """
    reasons, warnings = Counter[str](), Counter[str]()
    first: dict[str, str] = {}
    files = sorted((run.path / "cloud").glob("[0-9]*.json"))
    points = 0
    for file in files:
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            points += int(record["points"])
            reasons.update({str(k): int(v) for k, v in record["reasons"].items()})
            for warning in record["warnings"]:
                warnings[first.setdefault(re.sub(r"[\d.]+ ?(px|%)", "", warning), warning)] += 1
        except (OSError, ValueError, KeyError, AttributeError, TypeError):
            raise RunError(f"{file}: damaged; delete it and run again") from None
    return CloudRecord(len(files), points, dict(reasons), dict(warnings)) if files else None


def measure_again(run: Run, capture: Capture, settings: CloudSettings, frame: int) -> tuple[CloudFrame, MatchGroups]:
    """Measure one frame of a run once more, for what its files don't hold: regions, shifts, seeds.

    The settings are those of the run; silhouettes and hull are taken from it.
    """
    settings = cloud_settings(settings, capture)
    groups = match_groups(capture.rig, settings.groups, capture.info.region_of_interest)
    bounds = bounds_of(capture, settings)
    return _Measure(capture, run, settings, groups, bounds).measure(frame), groups
