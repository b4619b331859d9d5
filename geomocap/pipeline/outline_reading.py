"""Silhouettes of a run, reduced and undistorted, all frames in one array."""

from __future__ import annotations

import numpy as np

from geomocap.carving.silhouette_views import Undistortion
from geomocap.files.corrected_cameras import as_seen
from geomocap.files.results import read_silhouette
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.outlines import Outlines
from geomocap.pipeline.job import Job

_FRAMES = 40  # evenly spread: with four cameras a hundred and sixty views
_LONGEST_SIDE = 640  # pixels, about: those that depths were measured with


def outlines_of(job: Job) -> Outlines | None:
    """Silhouettes of frames spread evenly over the job; None: it has no capture."""
    if job.capture is None:
        return None
    capture = as_seen(job.run, job.capture)
    undistortion = Undistortion.of(capture.rig)
    frames = evenly_chosen(capture.n_frames, _FRAMES)
    height, width = undistortion.valid.shape[1:]
    factor = max(1, round(max(height, width) / _LONGEST_SIDE))
    seen = _blocks(undistortion.valid, factor).min(axis=(2, 4))
    empty = np.empty((len(frames), *seen.shape), np.uint8)
    for k, frame in enumerate(frames):
        views = undistortion.views([read_silhouette(job.run, camera, int(frame)) for camera in capture.cameras])
        empty[k] = seen & (_blocks(views.masks, factor).max(axis=(2, 4)) == 0)
        empty[k, views.blind()] = 0  # an empty silhouette has no say
    projections = undistortion.projections.copy()
    projections[:, :2] /= factor
    projections[:, :2] -= 0.5 * projections[:, 2:]
    return Outlines(frames, projections, empty)


def _blocks(masks: np.ndarray, factor: int) -> np.ndarray:
    """Masks (C, H, W) in blocks, (C, H', factor, W', factor); what is left over on the right and below is cut off."""
    C, H, W = masks.shape
    height, width = H // factor, W // factor
    return masks[:, : height * factor, : width * factor].reshape(C, height, factor, width, factor)
