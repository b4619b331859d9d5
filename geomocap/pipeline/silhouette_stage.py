"""Stage: images → silhouettes, `silhouettes/<camera>/000000.png`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.errors import CaptureError
from geomocap.evaluation.camera_check import BACKGROUND_FRAMES
from geomocap.files.capture import Capture
from geomocap.files.images import write_mask
from geomocap.files.run import Run, stage_key
from geomocap.model.rig import Rig, reduction
from geomocap.pipeline.correction_stage import LearnBackground, reduced, with_cameras
from geomocap.pipeline.job import Job
from geomocap.scheduling import map_items
from geomocap.silhouettes.likelihood import Counts
from geomocap.silhouettes.region import region_of_points
from geomocap.silhouettes.silhouette_scene import SilhouetteScene, learning_frames

LONGEST = 960
"""Longer side of the images that are decided on, pixels, about: larger ones are reduced by a whole factor.

A voxel of the default grid is nearly 4 pixels of these where the subject fills the image. Of a real person in
1080 × 1920 pixels outlines had fewer spurs than at full size, in two fifths of the time; no other value was tried.
"""


def silhouettes(job: Job) -> str:
    """Make the silhouettes of all cameras and frames, and return the stage's key."""
    job, cameras = with_cameras(job)
    capture = job.capture
    if capture is None:
        raise CaptureError("silhouettes need a capture")
    key = stage_key(
        __name__,
        "silhouettes",
        str(capture.path.resolve()),
        capture.fingerprint("images", "videos", "background", "masks", "sparse"),
        job.config.silhouettes.model_dump(),
        capture.cameras,
        cameras,
    )
    job.write_record("silhouettes")
    return job.stage("silhouettes", key, ["silhouettes"], lambda: _make_silhouettes(job, capture))


def _make_silhouettes(job: Job, capture: Capture) -> int:
    sound = job.run.sound("silhouettes")
    files = {k: [job.run.silhouette_file(c, k) for c in capture.cameras] for k in range(capture.n_frames)}
    missing = [k for k, of_frame in files.items() if not sound.issuperset(of_frame)]
    task: Callable[[int], None] = _Copy(capture, job.run)
    if missing and not capture.has_masks:
        lacking = [c for c in capture.cameras if not capture.has_background(c)]
        if lacking and capture.n_recorded < BACKGROUND_FRAMES:
            job.tell(
                f"{capture.n_recorded} frames without background pictures of {', '.join(lacking)} hardly show what the "
                "background is; add background/<camera>.png"
            )
        shrink = _shrink(capture)
        task = _Cut(capture, job.run, shrink, learn_scene(job, capture, shrink))
    for k, _ in zip(missing, map_items(task, missing, job.executor, "silhouettes", job.progress, 4), strict=True):
        job.run.note("silhouettes", files[k])
    return len(missing) * len(capture.cameras)


def learn_scene(job: Job, capture: Capture, shrink: int) -> SilhouetteScene:
    """Learn what the cameras see without the subject, and how both differ, in images reduced by a whole factor."""
    settings = job.config.silhouettes
    known = {c: job.backgrounds[c, shrink] for c in capture.cameras if (c, shrink) in job.backgrounds}
    job.backgrounds.clear()
    missing = [c for c in capture.cameras if c not in known]
    if missing:
        learn = LearnBackground(capture, settings, shrink)
        known |= zip(missing, map_items(learn, missing, job.executor, "background", job.progress, 2), strict=True)
    models = [known[c] for c in capture.cameras]
    rig = capture.rig.shrunk(shrink) if capture.is_calibrated else None
    regions = _regions(capture, rig)
    scene = SilhouetteScene.unlearnt(models, rig, settings, [regions.get(c) for c in capture.cameras])
    some = learning_frames(capture.n_frames)
    return scene.learnt(map_items(_Count(capture, shrink, scene), some, job.executor, "likelihood", job.progress, 4))


@dataclass(frozen=True)
class _Count:
    """What the images of one frame tell about subject and background."""

    capture: Capture
    shrink: int
    scene: SilhouetteScene

    def __call__(self, frame: int) -> Counts:
        return self.scene.count(_read(self.capture, frame, self.shrink))


@dataclass(frozen=True)
class _Cut:
    """Silhouettes of one frame, written to the run."""

    capture: Capture
    run: Run
    shrink: int
    scene: SilhouetteScene

    def __call__(self, frame: int) -> None:
        capture = self.capture
        masks = self.scene.silhouettes(_read(capture, frame, self.shrink))
        for camera, mask in zip(capture.cameras, masks, strict=True):
            full = _enlarged(mask * np.uint8(255), capture.sources[camera].size)
            write_mask(self.run.silhouette_file(camera, frame), full)


@dataclass(frozen=True)
class _Copy:
    """Given masks of one frame, written to the run."""

    capture: Capture
    run: Run

    def __call__(self, frame: int) -> None:
        for camera in self.capture.cameras:
            write_mask(self.run.silhouette_file(camera, frame), self.capture.mask(camera, frame))


def _shrink(capture: Capture) -> int:
    """Factor by which all images are reduced."""
    return max(reduction(*capture.sources[c].size, LONGEST) for c in capture.cameras)


def _read(capture: Capture, frame: int, shrink: int) -> list[np.ndarray]:
    """Images of one frame, reduced."""
    return [reduced(capture.frame(c, frame), shrink) for c in capture.cameras]


def _enlarged(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bring a mask of a reduced image to the image's size (width, height), with smooth outlines."""
    if mask.shape == size[::-1]:
        return mask
    return np.where(cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR) > 127, np.uint8(255), np.uint8(0))


def _regions(capture: Capture, rig: Rig | None) -> dict[str, np.ndarray]:
    """Where the region of interest lies in the images of a rig, (H, W) bool by camera; nothing without one."""
    box = capture.info.region_of_interest
    if box is None or rig is None:
        return {}
    corners = np.stack(np.meshgrid(*np.transpose(box), indexing="ij"), axis=-1).reshape(-1, 3)
    pixels, sizes = rig.project(corners), rig.sizes
    return {
        name: region_of_points(pixels[c], (int(sizes[c, 0]), int(sizes[c, 1])))
        for c, name in enumerate(capture.cameras)
        if np.isfinite(pixels[c]).all()
    }
