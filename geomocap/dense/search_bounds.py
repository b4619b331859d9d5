"""What silhouettes and a hull say about where surface can be."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from geomocap.matching.seeds import DepthRange
from geomocap.model.frame_geometry import Voxels
from geomocap.model.rig import Rig

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Corners (min, max) of a region of interest, metres, world."""


def depth_range(
    rig: Rig,
    camera: int,
    shape: tuple[int, int],
    near: float,
    far: float,
    hull: Voxels | None,
    behind: float,
    box: Box | None = None,
) -> DepthRange:
    """Bounds of the depth for every pixel of a camera.

    Parameters
    ----------
    rig : Rig
        Pinhole cameras.
    camera : int
    shape : (H, W)
    near, far : float
        Bounds where there is no hull, metres.
    hull : Voxels, optional
        Then surface is sought from just before the hull to some way behind its front.
    behind : float
        That way, in diagonals of the hull.
    box : Box, optional
        Then surface is sought inside it.
    """
    bounds = DepthRange.constant(shape, near, far)
    if hull is not None:
        front = hull_depth(rig, camera, shape, hull)
        front[~np.isfinite(front)] = np.nan
        diagonal = float(np.linalg.norm(np.ptp(hull.points, axis=0)))
        bounds = DepthRange(front - np.float32(2 * hull.voxel_size), front + np.float32(behind * diagonal))
    if box is not None:
        entry, exit_ = box_depth(rig, camera, shape, box)
        # Where a ray misses the box, both are NaN, and so are the bounds
        low, high = np.maximum(bounds.near, entry), np.minimum(bounds.far, exit_)
        missed = ~(high > low)
        low[missed] = high[missed] = np.nan
        bounds = DepthRange(low, high)
    return bounds


def box_depth(rig: Rig, camera: int, shape: tuple[int, int], box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Depths (H, W) float32, metres, where the rays of all pixels enter and leave a box; NaN where they miss it."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    origin, rays = rig.rays(camera, np.column_stack([x.ravel(), y.ravel()]))
    rays /= (rays @ rig.viewing_directions[camera])[:, None]  # one unit of depth long
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = (np.asarray(box)[:, None] - origin) / rays
    entry = np.maximum(np.nanmax(ways.min(axis=0), axis=1), 1e-6)
    exit_ = np.nanmin(ways.max(axis=0), axis=1)
    entry[exit_ <= entry] = np.nan
    exit_[np.isnan(entry)] = np.nan
    return entry.reshape(shape).astype(np.float32), exit_.reshape(shape).astype(np.float32)


def hull_depth(rig: Rig, camera: int, shape: tuple[int, int], hull: Voxels) -> np.ndarray:
    """Depth of the foremost voxel in every pixel, (H, W) float32, metres; infinite where there is none."""
    one = rig.select([rig.names[camera]])
    points = hull.points
    pixels = one.project(points)[0]
    depth = one.to_camera(points)[0, :, 2]
    image = np.full(shape, np.inf, np.float32)
    known = np.isfinite(pixels).all(axis=1)
    column, row = np.floor(pixels[known]).astype(int).T
    inside = (row >= 0) & (column >= 0) & (row < shape[0]) & (column < shape[1])
    np.minimum.at(image, (row[inside], column[inside]), depth[known][inside].astype(np.float32))
    # A voxel covers more than the pixel of its centre
    if inside.any():
        size = rig.cameras[camera].mean_focal_length() * hull.voxel_size / float(np.median(depth[known][inside]))
        reach = 2 * int(np.ceil(size)) + 1
        image = np.asarray(cv2.erode(image, np.ones((reach, reach), np.uint8)), dtype=np.float32)
        image[image > 1e30] = np.inf
    return image


def inside_silhouettes(rig: Rig, masks: Sequence[np.ndarray | None], points: np.ndarray, margin: int) -> np.ndarray:
    """Say which points (N, 3) project onto the subject, or within `margin` pixels of it, in every image: (N,) bool.

    Points outside an image are not judged by it.
    """
    inside = np.ones(len(points), bool)
    if len(points) == 0:
        return inside
    pixels = rig.project(points)
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    for mask, p in zip(masks, pixels, strict=True):
        if mask is None:
            continue
        wide = cv2.dilate(mask.astype(np.uint8), kernel) != 0
        with np.errstate(invalid="ignore"):
            in_view = ((p >= 0) & (p < [mask.shape[1], mask.shape[0]])).all(axis=1)
        column, row = p[in_view].astype(int).T
        inside[in_view] &= wide[row, column]
    return inside
