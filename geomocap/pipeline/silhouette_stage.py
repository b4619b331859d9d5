"""Stage: images → silhouettes, `silhouettes/<camera>/000000.png`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add
from pathlib import Path

import cv2
import numpy as np

from geomocap.carving.holes import fill_false_holes
from geomocap.carving.silhouette_views import Undistortion
from geomocap.errors import CaptureError
from geomocap.files.atomic import write_atomic
from geomocap.files.capture import Capture
from geomocap.files.run import Run, stage_key
from geomocap.pipeline.job import Job
from geomocap.scheduling import map_items
from geomocap.silhouettes.background import BackgroundModel, model_from_frames, model_from_plate
from geomocap.silhouettes.joint_decision import CameraEvidence, decide, learn_from
from geomocap.silhouettes.likelihood import Counts, Likelihood
from geomocap.silhouettes.other_cameras import OtherCameras
from geomocap.silhouettes.region import region_of_points
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

LEARNING_FRAMES = 6  # spread over the capture


def silhouettes(job: Job) -> str:
    """Make the silhouettes of all cameras and frames, and return the stage's key."""
    capture = job.capture
    if capture is None:
        raise CaptureError("silhouettes need a capture")
    key = stage_key(
        __name__,
        "silhouettes",
        str(capture.path.resolve()),
        capture.fingerprint("images", "videos", "background", "masks", "sparse"),
        job.config.silhouettes.model_dump(),
    )
    job.write_record("silhouettes")
    return job.stage("silhouettes", key, ["silhouettes"], lambda: _make_silhouettes(job, capture))


def _make_silhouettes(job: Job, capture: Capture) -> int:
    missing = [
        k for k in range(capture.n_frames) if not all(job.run.silhouette_file(c, k).exists() for c in capture.cameras)
    ]
    task: Callable[[int], None] = _Copy(capture, job.run)
    if missing and not capture.has_masks:
        task = _Cut(job.run, learn_scene(job))
    for _ in map_items(task, missing, job.executor, "silhouettes", job.progress, 4):
        pass
    return len(missing) * len(capture.cameras)


def learn_scene(job: Job) -> LearntScene:
    """Learn what the cameras see without the subject, and how subject and background differ."""
    capture, settings = job.capture, job.config.silhouettes
    assert capture is not None
    learn = _Learn(capture, settings)
    models = tuple(map_items(learn, capture.cameras, job.executor, "background", job.progress, 2))
    others = OtherCameras.of(capture.rig) if settings.joint and capture.is_calibrated and len(models) > 1 else None
    undistortion = Undistortion.of(capture.rig) if others is not None else None
    unlearnt = Likelihood.unlearnt(len(models))
    scene = LearntScene(capture, settings, models, _regions(capture), others, undistortion, unlearnt)
    some = np.unique(np.linspace(0, capture.n_frames - 1, min(LEARNING_FRAMES, capture.n_frames)).round().astype(int))
    counts = list(map_items(scene.learn, some.tolist(), job.executor, "likelihood", job.progress, 4))
    return replace(scene, likelihood=Likelihood.of(reduce(add, counts)))


@dataclass(frozen=True)
class _Learn:
    """Background model of one camera."""

    capture: Capture
    settings: SilhouetteSettings

    def __call__(self, camera: str) -> BackgroundModel:
        recorded = self.capture.sources[camera]  # also the frames before the subject came in
        count = min(self.settings.samples, len(recorded))
        chosen = np.unique(np.linspace(0, len(recorded) - 1, count).round().astype(int))
        frames = [recorded.read(int(k)) for k in chosen]
        if self.capture.has_background(camera):
            return model_from_plate(self.capture.background(camera), frames, self.settings, camera)
        return model_from_frames(frames, self.settings, camera)


@dataclass(frozen=True)
class LearntScene:
    """What the silhouettes of any frame need."""

    capture: Capture
    settings: SilhouetteSettings
    models: tuple[BackgroundModel, ...]
    regions: dict[str, np.ndarray]
    others: OtherCameras | None
    undistortion: Undistortion | None
    likelihood: Likelihood

    def views(self, frame: int) -> list[CameraEvidence]:
        """Read the images of a frame and compare them with the background."""
        shadows = bool(np.isfinite(self.likelihood.shadow).any())
        return [
            CameraEvidence.of(self.capture.frame(c, frame), model, self.settings, self.regions.get(c), shadows)
            for c, model in zip(self.capture.cameras, self.models, strict=True)
        ]

    def learn(self, frame: int) -> Counts:
        """Count what a frame tells about subject and background."""
        return learn_from(self.views(frame), self.others, self.settings)

    def silhouettes(self, frame: int) -> tuple[np.ndarray, ...]:
        """Cut out a frame's silhouettes, C arrays (H, W) bool."""
        masks = decide(self.views(frame), self.likelihood, self.others, self.settings).masks
        if self.undistortion is None:
            return masks
        given = [m.astype(np.uint8) * np.uint8(255) for m in masks]
        return tuple(m > 0 for m in fill_false_holes(self.capture.rig, self.undistortion.views(given), given))


@dataclass(frozen=True)
class _Cut:
    """Silhouettes of one frame, written to the run."""

    run: Run
    scene: LearntScene

    def __call__(self, frame: int) -> None:
        for camera, mask in zip(self.scene.capture.cameras, self.scene.silhouettes(frame), strict=True):
            write_atomic(self.run.silhouette_file(camera, frame), partial(_write_mask, mask * np.uint8(255)))


@dataclass(frozen=True)
class _Copy:
    """Given masks of one frame, written to the run."""

    capture: Capture
    run: Run

    def __call__(self, frame: int) -> None:
        for camera in self.capture.cameras:
            mask = self.capture.mask(camera, frame)
            write_atomic(self.run.silhouette_file(camera, frame), partial(_write_mask, mask))


def _write_mask(mask: np.ndarray, path: Path) -> bool:
    """Write a silhouette as a PNG that is made for speed."""
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    return cv2.imwrite(str(path), mask, parameters)


def _regions(capture: Capture) -> dict[str, np.ndarray]:
    """Images of the capture's region of interest, (H, W) bool by camera; nothing where there is none."""
    box = capture.info.region_of_interest
    if box is None or not capture.is_calibrated:
        return {}
    corners = np.stack(np.meshgrid(*np.transpose(box), indexing="ij"), axis=-1).reshape(-1, 3)
    pixels = capture.rig.project(corners)
    sizes = capture.rig.sizes
    return {
        name: region_of_points(pixels[c], (int(sizes[c, 0]), int(sizes[c, 1])))
        for c, name in enumerate(capture.cameras)
        if np.isfinite(pixels[c]).all()
    }
