"""Images of one frame as the matching wants them: free of distortion, filtered, prefiltered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.dense.dense_settings import CloudSettings
from geomocap.dense.match_groups import MatchGroups
from geomocap.errors import GeometryError
from geomocap.matching.spline import ImageStack
from geomocap.matching.wallis import wallis


@dataclass(frozen=True)
class PreparedImages:
    """Images of one frame, free of distortion, ready for matching.

    Attributes
    ----------
    colors : list of (H, W, 3) uint8
    filtered : list of (H, W) float32
        Grey, after the Wallis filter.
    masks : list of (H, W) bool or None
        Where the subject is seen.
    inner : list of (H, W) bool or None
        The same without the margin along the contours.
    stack : ImageStack
    """

    colors: list[np.ndarray]
    filtered: list[np.ndarray]
    masks: list[np.ndarray | None]
    inner: list[np.ndarray | None]
    stack: ImageStack


def undistorted_color(image: np.ndarray, groups: MatchGroups, camera: int) -> np.ndarray:
    """Return the colours (H, W, 3) of one camera's image as the matching sees them, without distortion."""
    maps = groups.maps[camera]
    return image if maps is None else cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR)


def prepare(
    images: Sequence[np.ndarray], masks: Sequence[np.ndarray] | None, groups: MatchGroups, settings: CloudSettings
) -> PreparedImages:
    """Remove distortion, filter, and prefilter the splines.

    Raises
    ------
    GeometryError
        If an image or mask does not have its camera's size.
    """
    if len(images) != len(groups.rig) or (masks is not None and len(masks) != len(images)):
        given = len(images) if masks is None else f"{len(images)} and {len(masks)}"
        raise GeometryError(f"{given} images and masks for {len(groups.rig)} cameras: expected one each a camera")
    colors, filtered, silhouettes, inner = [], [], [], []
    for c, (image, map_) in enumerate(zip(images, groups.maps, strict=True)):
        image = np.asarray(image)
        color = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        mask = None if masks is None else np.asarray(masks[c]) != 0
        camera = groups.rig.cameras[c]
        if (map_ is None and color.shape[:2] != (camera.height, camera.width)) or (
            mask is not None and mask.shape != color.shape[:2]
        ):
            raise GeometryError(
                f"camera {groups.rig.names[c]}: image {color.shape[:2]} and its mask have to be "
                f"{camera.height}×{camera.width} as calibrated"
            )
        grey = color.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
        if map_ is not None:
            x, y = map_
            pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64) + 0.5
            grey = ImageStack.of([grey], settings.kernel.order).sample(0, pixels).reshape(x.shape)
            outside = ~np.isfinite(grey)
            grey = np.where(outside, np.float32(0), grey)
            color = undistorted_color(color, groups, c)
            if mask is not None:
                mask = cv2.remap(mask.astype(np.uint8), x, y, cv2.INTER_NEAREST) != 0
            mask = ~outside if mask is None else mask & ~outside
        filtered.append(wallis(grey, settings.wallis, mask) if settings.wallis.enabled else grey)
        colors.append(color)
        silhouettes.append(mask)
        kernel = np.ones((2 * settings.contour_margin + 1,) * 2, np.uint8)
        inner.append(None if mask is None else cv2.erode(mask.astype(np.uint8), kernel) != 0)
    stack = ImageStack.of(filtered, settings.kernel.order, inner)
    return PreparedImages(colors, filtered, silhouettes, inner, stack)
