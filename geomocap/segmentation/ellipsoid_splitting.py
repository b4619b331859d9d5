"""The split stage: a frame's points as a tree of ever smaller ellipsoids, of which the leaves are kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.model.ellipsoids import (
    Ellipsoids,
    check_points,
    eigen_axes,
    equivalent_length,
    error_terms,
    from_moments,
    range_moments,
)
from geomocap.segmentation.m3_settings import SegmentationSettings


@dataclass(frozen=True)
class SplitFrame:
    """The leaves of a frame: all that merging and matching need of it.

    Attributes
    ----------
    points : (N, 3) float, grid units
        Leaf by leaf.
    order : (N,) int32
        Number of each of these points in the frame as it was given.
    starts : (L + 1,) int32
        Leaf k is points[starts[k]:starts[k + 1]].
    moments : (L, 10) float, grid units
        Moments of the leaves (see `ellipsoids.eigen_axes`).
    errors : (L,) float, grid units
        Fitting errors (equivalent lengths).
    origin : (3,) float, metres, world
        Centroid of the frame, the origin of grid units.
    spacing : float, metres
    """

    points: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    moments: np.ndarray
    errors: np.ndarray
    origin: np.ndarray
    spacing: float

    @property
    def ellipsoids(self) -> Ellipsoids:
        """The leaves as ellipsoids in metres."""
        return from_moments(self.moments, self.errors, self.origin, self.spacing)

    @property
    def leaves(self) -> np.ndarray:
        """Leaf of each of `points`, (N,) int32."""
        return np.repeat(np.arange(len(self.errors), dtype=np.int32), np.diff(self.starts))


@njit(cache=True, nogil=True, error_model="numpy")
def _exceeds(
    points: np.ndarray, start: int, end: int, m: np.ndarray, variances: np.ndarray, axes: np.ndarray, limit: float
) -> bool:
    """Whether the error is above the limit; the terms are positive, so it stops as soon as it must be."""
    total = 0.0
    enough = limit**2.5 * (end - start)
    for first in range(start, end, 256):
        total += error_terms(points, first, min(first + 256, end), m, variances, axes)
        if total > enough:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def split_points(
    points: np.ndarray, limit: float, max_depth: int, min_points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Split points recursively by the plane through the centroid orthogonal to the major axis (section 5.2.1).

    Parameters
    ----------
    points : (N, 3) float, grid units
    limit : float
        A set with a greater error (equivalent length, grid units) is split.
    max_depth, min_points : int
        A set at this depth, or of which a half would be smaller, is a leaf.

    Returns
    -------
    sorted_points : (N, 3) float
        The points leaf by leaf, within a leaf in their own order.
    order : (N,) int32
        `sorted_points = points[order]`.
    starts : (L + 1,) int32
        Leaf k is sorted_points[starts[k]:starts[k + 1]].
    moments : (L, 10) float
    errors : (L,) float
        Equivalent lengths, grid units.
    """
    n = points.shape[0]
    pts = points.copy()
    order = np.arange(n).astype(np.int32)
    spare_pts = np.empty((n, 3))
    spare_order = np.empty(n, np.int32)
    most = 1 << max_depth
    starts = np.zeros(most + 1, np.int32)
    moments = np.empty((most, 10))
    errors = np.empty(most)
    # depth first, the lower side of the plane first: at most one waiting set for each level
    begin = np.empty(max_depth + 2, np.int64)
    end = np.empty(max_depth + 2, np.int64)
    depth = np.empty(max_depth + 2, np.int64)
    waiting = np.empty((max_depth + 2, 10))
    begin[0], end[0], depth[0] = 0, n, 0
    range_moments(pts, begin[0], end[0], waiting[0])
    top, leaves = 1, 0
    variances = np.empty(3)
    axes = np.empty((3, 3))
    low = np.empty(10)
    while top > 0:
        top -= 1
        a, b, d = begin[top], end[top], depth[top]
        m = waiting[top].copy()
        eigen_axes(m, variances, axes)
        cut = -1
        if d < max_depth and b - a >= 2 * min_points and _exceeds(pts, a, b, m, variances, axes, limit):
            v0, v1, v2 = axes[0, 0], axes[1, 0], axes[2, 0]
            offset = (v0 * m[1] + v1 * m[2] + v2 * m[3]) / m[0]
            below = 0
            for i in range(a, b):
                if v0 * pts[i, 0] + v1 * pts[i, 1] + v2 * pts[i, 2] < offset:
                    below += 1
            if below >= min_points and b - a - below >= min_points:
                cut = a + below
        if cut < 0:
            starts[leaves + 1] = b
            moments[leaves] = m
            errors[leaves] = equivalent_length(error_terms(pts, a, b, m, variances, axes) / (b - a))
            leaves += 1
            continue
        i, j = a, cut
        low[:] = 0.0
        for k in range(a, b):
            x, y, z = pts[k, 0], pts[k, 1], pts[k, 2]
            if v0 * x + v1 * y + v2 * z < offset:
                to = i
                i += 1
                low[1] += x
                low[2] += y
                low[3] += z
                low[4] += x * x
                low[5] += x * y
                low[6] += x * z
                low[7] += y * y
                low[8] += y * z
                low[9] += z * z
            else:
                to = j
                j += 1
            spare_pts[to, 0], spare_pts[to, 1], spare_pts[to, 2] = x, y, z
            spare_order[to] = order[k]
        low[0] = cut - a
        pts[a:b] = spare_pts[a:b]
        order[a:b] = spare_order[a:b]
        begin[top], end[top], depth[top] = cut, b, d + 1
        waiting[top] = m - low
        top += 1
        begin[top], end[top], depth[top] = a, cut, d + 1
        waiting[top] = low
        top += 1
    return pts, order, starts[: leaves + 1].copy(), moments[:leaves].copy(), errors[:leaves].copy()


def split_frame(points: np.ndarray, spacing: float, settings: SegmentationSettings, frame: int = 0) -> SplitFrame:
    """Split one frame; pure, so that any executor can map it over the frames.

    Parameters
    ----------
    points : (N, 3) float, metres, world
        Surface points of the frame.
    spacing : float, metres
        Voxel size, or the mean distance of a point from its nearest neighbour.
    settings : SegmentationSettings
    frame : int
        Number of the frame, for errors.

    Raises
    ------
    GeometryError
        If the frame has fewer points than one ellipsoid needs, or points that are not finite.
    """
    points = check_points(points, frame, settings.min_points)
    origin = points.mean(axis=0)
    grid = (points - origin) / spacing
    ordered, order, starts, moments, errors = split_points(
        grid, settings.split_error, settings.max_depth, settings.min_points
    )
    return SplitFrame(ordered, order, starts, moments, errors, origin, spacing)
