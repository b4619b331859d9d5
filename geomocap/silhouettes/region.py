"""Regions of interest in an image, as masks that `silhouette` takes."""

from __future__ import annotations

import cv2
import numpy as np

from geomocap.errors import SettingsError


def region_of_points(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the convex hull of image points: the projected corners of a 3-D box, say.

    Parameters
    ----------
    points : (N, 2) float
        Image coordinates, pixels (the centre of the top-left pixel is (0.5, 0.5)); not-finite ones are left out.
    size : (int, int)
        Width and height of the image, pixels.

    Returns
    -------
    (H, W) bool

    Raises
    ------
    SettingsError
        If fewer than three points are given or none of the region lies in the image.
    """
    points = np.asarray(points, float).reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    width, height = size
    if len(points) < 3:
        raise SettingsError(f"region of interest: {len(points)} usable points; a region needs at least 3")
    hull = cv2.convexHull(points.astype(np.float32)).reshape(-1, 2).astype(float)
    y, x = np.mgrid[:height, :width] + 0.5
    mask = np.ones((height, width), bool)
    turn = np.sign(_cross(hull[1] - hull[0], hull[-1] - hull[0])) if len(hull) > 2 else 0.0
    for (ax, ay), (bx, by) in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        mask &= turn * _cross((bx - ax, by - ay), (x - ax, y - ay)) >= 0
    mask &= turn != 0
    if not mask.any():
        raise SettingsError(f"region of interest: lies outside the {width}×{height} image; check its coordinates")
    return mask


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]
