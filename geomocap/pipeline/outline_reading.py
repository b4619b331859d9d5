"""Silhouettes of a run, reduced and undistorted: as images of some frames, or as their outlines in all frames."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.carving.silhouette_views import Undistortion
from geomocap.files.capture import Capture
from geomocap.files.corrected_cameras import as_seen
from geomocap.files.results import read_silhouette
from geomocap.files.run import Run
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.outline_points import OutlinePoints, outline_points
from geomocap.model.outlines import Outlines
from geomocap.pipeline.job import Job
from geomocap.scheduling import map_items

_FRAMES = 40  # evenly spread: with four cameras a hundred and sixty views
_LONGEST_SIDE = 640  # pixels, about: those that depths were measured with
_STEP = 4  # pixels from one point of an outline to the next


def outlines_of(job: Job) -> Outlines | None:
    """Silhouettes of frames spread evenly over the job; None: it has no capture."""
    if job.capture is None:
        return None
    capture = as_seen(job.run, job.capture)
    undistortion = Undistortion.of(capture.rig)
    frames = evenly_chosen(capture.n_frames, _FRAMES)
    factor = _reduction(undistortion)
    seen = _blocks(undistortion.valid, factor).min(axis=(2, 4))
    empty = np.empty((len(frames), *seen.shape), np.uint8)
    for k, frame in enumerate(frames):
        views = undistortion.views([read_silhouette(job.run, camera, int(frame)) for camera in capture.cameras])
        empty[k] = seen & (_blocks(views.masks, factor).max(axis=(2, 4)) == 0)
        empty[k, views.blind()] = 0  # an empty silhouette has no say
    return Outlines(frames, _array_projections(undistortion, factor), empty)


def outline_points_of(job: Job) -> OutlinePoints | None:
    """Outlines of all frames of the job; None: it has no capture."""
    if job.capture is None:
        return None
    capture = as_seen(job.run, job.capture)
    undistortion = Undistortion.of(capture.rig)
    factor = _reduction(undistortion)
    read = _ReadOutlines(job.run, capture, undistortion, factor)
    points = list(map_items(read, range(capture.n_frames), job.executor, "outlines", job.progress))
    return OutlinePoints(_array_projections(undistortion, factor), points)


@dataclass(frozen=True)
class _ReadOutlines:
    """Outlines of all cameras in one frame."""

    run: Run
    capture: Capture
    undistortion: Undistortion
    factor: int

    def __call__(self, frame: int) -> list[np.ndarray]:
        views = self.undistortion.views([read_silhouette(self.run, c, frame) for c in self.capture.cameras])
        found = []
        for mask, valid, blind in zip(views.masks, views.valid, views.blind(), strict=True):
            inside, seen = (_mean_of_blocks(image, self.factor) for image in (mask, valid))
            found.append(outline_points(0.0 * inside if blind else inside, seen, _STEP))
        return found


def _reduction(undistortion: Undistortion) -> int:
    return max(1, round(max(undistortion.valid.shape[1:]) / _LONGEST_SIDE))


def _array_projections(undistortion: Undistortion, factor: int) -> np.ndarray:
    """Projections (C, 3, 4) to array indices of images reduced by a factor."""
    projections = undistortion.projections.copy()
    projections[:, :2] /= factor
    projections[:, :2] -= 0.5 * projections[:, 2:]
    return projections


def _mean_of_blocks(image: np.ndarray, factor: int) -> np.ndarray:
    """Means (H', W') float32 of blocks of an image; what is left over on the right and below is cut off."""
    height, width = (n // factor for n in image.shape)
    part = image[: height * factor, : width * factor].astype(np.float32)
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA))


def _blocks(masks: np.ndarray, factor: int) -> np.ndarray:
    """Masks (C, H, W) in blocks, (C, H', factor, W', factor); what is left over on the right and below is cut off."""
    C, H, W = masks.shape
    height, width = H // factor, W // factor
    return masks[:, : height * factor, : width * factor].reshape(C, height, factor, width, factor)
