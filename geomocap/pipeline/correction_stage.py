"""Stage: calibration → cameras, corrected where the silhouettes contradict it: `correction.json`, `sparse/`.

The outlines are those of reduced images in which each camera decides alone, as the silhouettes themselves need the
cameras; given masks are taken as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from geomocap.calibration.silhouette_correction import correct_cameras, disagreement
from geomocap.calibration.silhouette_tangents import OutlineRays
from geomocap.evaluation.camera_check import BACKGROUND_FRAMES
from geomocap.files.capture import Capture
from geomocap.files.corrected_cameras import CORRECTION, SPARSE_FILES, as_seen, write_cameras
from geomocap.files.run import stage_key
from geomocap.files.videos import Video
from geomocap.model.camera_correction import CameraCorrection
from geomocap.model.even_choice import evenly_chosen
from geomocap.pipeline.job import Job
from geomocap.scheduling import map_items
from geomocap.silhouettes.background import BackgroundModel, model_from_frames, model_from_plate
from geomocap.silhouettes.likelihood import Counts
from geomocap.silhouettes.silhouette_scene import SilhouetteScene, learning_frames
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

OUTLINES = 32  # frames, spread over the recording
FIRST = 8  # of these, which are enough where the cameras clearly agree
# Of the disagreement that calls for a correction. Of right cameras the worst pair disagreed by 0.2 to 0.64 pixels in
# eight captures, and 8 frames told it to 0.03 in two of them.
CLEAR = 0.5
LONGEST = 640  # longer side of the images, pixels

_Cutter = Callable[[list[int]], list[tuple[np.ndarray, ...]]]  # silhouettes of all cameras, of frames by their numbers


def with_cameras(job: Job) -> tuple[Job, str]:
    """Hold a capture's calibration against its outlines; return the job with the cameras to use, and the stage's key.

    A capture without calibration stays as it is.
    """
    capture = job.capture
    if capture is None or not capture.is_calibrated:
        return job, ""
    parts = ("images", "videos", "background", "masks", "sparse")
    key = stage_key(
        __name__,
        "correction",
        str(capture.path.resolve()),
        capture.fingerprint(*parts),
        job.config.silhouettes.model_dump(),
        capture.cameras,
    )

    def work() -> int:
        if not job.config.silhouettes.correct_cameras:
            return 0
        write_cameras(job.run, find_correction(job, capture))
        return len(capture.cameras)

    job.run.claim()
    job.stage("correction", key, [], work, [CORRECTION, *SPARSE_FILES])
    return replace(job, capture=as_seen(job.run, capture)), key


def find_correction(job: Job, capture: Capture) -> CameraCorrection:
    """Hold the calibration against the outlines of frames spread over the recording: of a few, or of all if need be."""
    rig = capture.rig
    plates = all(map(capture.has_background, capture.cameras))
    if not (capture.has_masks or plates or capture.n_recorded >= BACKGROUND_FRAMES):
        return CameraCorrection(rig, rig, np.nan, np.nan)  # there are no silhouettes
    shrink = 1 if capture.has_masks else max(1, round(int(rig.sizes.max()) / LONGEST))
    chosen = evenly_chosen(capture.n_frames, OUTLINES).tolist()
    cut = _given(capture) if capture.has_masks else _alone(job, capture, chosen, shrink)
    few = chosen[:: OUTLINES // FIRST]
    masks = dict(zip(few, cut(few), strict=True))
    said = disagreement(rig, OutlineRays.of(rig, list(masks.values())))
    if said <= CLEAR * shrink:
        return CameraCorrection(rig, rig, said, np.nan)
    others = [k for k in chosen if k not in masks]
    masks |= zip(others, cut(others), strict=True)
    return correct_cameras(rig, OutlineRays.of(rig, [masks[k] for k in chosen]), float(shrink))


def _given(capture: Capture) -> _Cutter:
    """Return what gives the masks of frames as they are."""
    return lambda frames: [tuple(capture.mask(c, k) for c in capture.cameras) for k in frames]


def _alone(job: Job, capture: Capture, wanted: list[int], shrink: int) -> _Cutter:
    """Return what cuts the silhouettes of frames, some of those wanted, from reduced images, each camera alone."""
    settings, learning = job.config.silhouettes, learning_frames(capture.n_frames)
    look = _Look(LearnBackground(capture, settings, shrink), tuple(sorted({*wanted, *learning})))
    looks = list(map_items(look, capture.cameras, job.executor, "cameras", job.progress, 2))
    models = [model for model, _ in looks]
    job.backgrounds.update(((c, shrink), model) for c, model in zip(capture.cameras, models, strict=True))

    def moments(numbers: list[int]) -> list[_Moment]:
        return [_Moment(k, tuple(known.get(k) for _, known in looks)) for k in numbers]

    unlearnt = SilhouetteScene.unlearnt(models, None, settings)
    read = _ReadReduced(capture, shrink)
    count, seen = _CountReduced(read, unlearnt), moments(learning)
    scene = unlearnt.learnt(map_items(count, seen, job.executor, "cameras", job.progress, 4))
    cut = _CutReduced(read, scene)
    return lambda frames: list(map_items(cut, moments(frames), job.executor, "cameras", job.progress, 4))


def reduced(image: np.ndarray, shrink: int) -> np.ndarray:
    """Reduce an image by a whole factor; a size that it doesn't divide is rounded up."""
    h, w = image.shape[:2]
    size = -(-w // shrink), -(-h // shrink)
    return image if shrink == 1 else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


@dataclass(frozen=True)
class _Moment:
    """A frame, and of each camera the reduced image if it has been read already."""

    frame: int
    images: tuple[np.ndarray | None, ...]


@dataclass(frozen=True)
class _ReadReduced:
    """Reduced images of one frame."""

    capture: Capture
    shrink: int

    def __call__(self, moment: _Moment) -> list[np.ndarray]:
        return [
            reduced(self.capture.frame(c, moment.frame), self.shrink) if image is None else image
            for c, image in zip(self.capture.cameras, moment.images, strict=True)
        ]


@dataclass(frozen=True)
class LearnBackground:
    """Background model of one camera, in images reduced by a whole factor."""

    capture: Capture
    settings: SilhouetteSettings
    shrink: int = 1

    def __call__(self, camera: str) -> BackgroundModel:
        """Learn it from frames spread over the recording."""
        return self.learnt(camera, [self.read(camera, k) for k in self.chosen(camera)])

    def chosen(self, camera: str) -> list[int]:
        """Return the frames to learn from, also of those before the subject came in; numbers in the recording."""
        return evenly_chosen(len(self.capture.sources[camera]), self.settings.samples).tolist()

    def read(self, camera: str, number: int) -> np.ndarray:
        """Read a frame of the recording, reduced."""
        return reduced(self.capture.sources[camera].read(number), self.shrink)

    def learnt(self, camera: str, frames: list[np.ndarray]) -> BackgroundModel:
        """Learn it from these frames, reduced."""
        if not self.capture.has_background(camera):
            return model_from_frames(frames, self.settings, camera)
        plate = reduced(self.capture.background(camera), self.shrink)
        if self.shrink > 1:
            plate[..., 3] = np.where(plate[..., 3] == 255, 255, 0)  # a pixel is known if all that it covers is
        return model_from_plate(plate, frames, self.settings, camera)


@dataclass(frozen=True)
class _Look:
    """Background model of one camera; of a video also the reduced images of other frames, so that it is decoded once.

    Attributes
    ----------
    learn : LearnBackground
    frames : tuple of int
        Those other frames.
    """

    learn: LearnBackground
    frames: tuple[int, ...]

    def __call__(self, camera: str) -> tuple[BackgroundModel, dict[int, np.ndarray]]:
        capture, chosen = self.learn.capture, self.learn.chosen(camera)
        if not isinstance(capture.sources[camera], Video):
            return self.learn(camera), {}
        wanted = {capture.first + k: k for k in self.frames}
        images = {n: self.learn.read(camera, n) for n in sorted({*chosen, *wanted})}
        return self.learn.learnt(camera, [images[n] for n in chosen]), {k: images[n] for n, k in wanted.items()}


@dataclass(frozen=True)
class _CountReduced:
    """What one frame's reduced images tell about subject and background."""

    read: _ReadReduced
    scene: SilhouetteScene

    def __call__(self, moment: _Moment) -> Counts:
        return self.scene.count(self.read(moment))


@dataclass(frozen=True)
class _CutReduced:
    """Silhouettes of one frame's reduced images."""

    read: _ReadReduced
    scene: SilhouetteScene

    def __call__(self, moment: _Moment) -> tuple[np.ndarray, ...]:
        return self.scene.silhouettes(self.read(moment))
