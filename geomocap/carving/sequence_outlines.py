"""Outlines of the silhouettes of a sequence, as its undistorted cameras see them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from geomocap.carving.silhouette_views import Undistortion
from geomocap.errors import GeometryError
from geomocap.model.outline_points import OutlinePoints, outline_points
from geomocap.model.rig import Rig

LONGEST_SIDE = 640  # pixels, about: larger images are reduced by a whole factor
_STEP = 4  # pixels from one point of an outline to the next


def find_outlines(masks: Sequence[Sequence[np.ndarray]], rig: Rig) -> OutlinePoints:
    """Find the outlines of silhouettes, to refine a motion by.

    Parameters
    ----------
    masks : sequence of T sequences of C arrays (H, W)
        Silhouettes, not 0 on the subject; an empty one says nothing.
    rig : Rig
        The C cameras.

    Raises
    ------
    GeometryError
        If a frame has another number of silhouettes than there are cameras.
    """
    for frame, row in enumerate(masks):
        if len(row) != len(rig):
            raise GeometryError(
                f"outlines: frame {frame} has {len(row)} silhouettes, expected one for each of {len(rig)} cameras"
            )
    undistortion = Undistortion.of(rig)
    return OutlinePoints(array_projections(undistortion), [frame_outlines(undistortion, row) for row in masks])


def frame_outlines(undistortion: Undistortion, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Find the outlines of one frame's silhouettes, C arrays (H, W): C arrays (M, 4), see `OutlinePoints`."""
    views, factor = undistortion.views(masks), reduction_of(undistortion)
    found = []
    for mask, valid, blind in zip(views.masks, views.valid, views.blind(), strict=True):
        inside, seen = (_mean_of_blocks(image, factor) for image in (mask, valid))
        found.append(outline_points(0.0 * inside if blind else inside, seen, _STEP))
    return found


def reduction_of(undistortion: Undistortion) -> int:
    """Return the whole factor by which images are reduced."""
    return max(1, round(max(undistortion.valid.shape[1:]) / LONGEST_SIDE))


def array_projections(undistortion: Undistortion) -> np.ndarray:
    """Return the projections, (C, 3, 4), from world metres to array indices of the reduced images."""
    projections = undistortion.projections.copy()
    projections[:, :2] /= reduction_of(undistortion)
    projections[:, :2] -= 0.5 * projections[:, 2:]
    return projections


def _mean_of_blocks(image: np.ndarray, factor: int) -> np.ndarray:
    """Means (H', W') float32 of blocks of an image; what is left over on the right and below is cut off."""
    height, width = (n // factor for n in image.shape)
    part = image[: height * factor, : width * factor].astype(np.float32)
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA))
