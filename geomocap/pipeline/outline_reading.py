"""Silhouettes of a run, reduced and undistorted: as images of some frames, or as their outlines in all frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.carving.sequence_outlines import array_projections, frame_outlines, reduction_of
from geomocap.carving.silhouette_views import Undistortion
from geomocap.files.capture import Capture
from geomocap.files.corrected_cameras import as_seen
from geomocap.files.results import read_silhouette
from geomocap.files.run import Run
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.outline_points import OutlinePoints
from geomocap.model.outlines import Outlines
from geomocap.pipeline.job import Job
from geomocap.scheduling import map_items

_FRAMES = 40  # evenly spread: with four cameras a hundred and sixty views


def outlines_of(job: Job) -> Outlines | None:
    """Silhouettes of frames spread evenly over the job; None: it has no capture."""
    if job.capture is None:
        return None
    capture = as_seen(job.run, job.capture)
    undistortion = Undistortion.of(capture.rig)
    frames = evenly_chosen(capture.n_frames, _FRAMES)
    factor = reduction_of(undistortion)
    seen = _blocks(undistortion.valid, factor).min(axis=(2, 4))
    empty = np.empty((len(frames), *seen.shape), np.uint8)
    for k, frame in enumerate(frames):
        views = undistortion.views([read_silhouette(job.run, camera, int(frame)) for camera in capture.cameras])
        empty[k] = seen & (_blocks(views.masks, factor).max(axis=(2, 4)) == 0)
        empty[k, views.blind()] = 0  # an empty silhouette has no say
    return Outlines(frames, array_projections(undistortion), empty)


def outline_points_of(job: Job) -> OutlinePoints | None:
    """Outlines of all frames of the job; None: it has no capture."""
    if job.capture is None:
        return None
    capture = as_seen(job.run, job.capture)
    undistortion = Undistortion.of(capture.rig)
    read = _ReadOutlines(job.run, capture, undistortion)
    points = list(map_items(read, range(capture.n_frames), job.executor, "outlines", job.progress))
    return OutlinePoints(array_projections(undistortion), points)


@dataclass(frozen=True)
class _ReadOutlines:
    """Outlines of all cameras in one frame."""

    run: Run
    capture: Capture
    undistortion: Undistortion

    def __call__(self, frame: int) -> list[np.ndarray]:
        return frame_outlines(self.undistortion, [read_silhouette(self.run, c, frame) for c in self.capture.cameras])


def _blocks(masks: np.ndarray, factor: int) -> np.ndarray:
    """Masks (C, H, W) in blocks, (C, H', factor, W', factor); what is left over on the right and below is cut off."""
    C, H, W = masks.shape
    height, width = H // factor, W // factor
    return masks[:, : height * factor, : width * factor].reshape(C, height, factor, width, factor)
