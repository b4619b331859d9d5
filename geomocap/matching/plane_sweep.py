"""Sweeps of template patches over planes in object space, compiled.

Images stand one behind the other in `flat`, the template first, row by row without padding; `seen` is 1 where they show
the subject. Positions are array indices; correlation uses every second pixel and bilinear values of smoothed images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit, prange

from geomocap.matching.patch_kernel import transfer
from geomocap.matching.plane_patch import on_plane, refine, template_patch

_PROMISING = 16  # places on a line at which tilted planes are tried, those where facing ones correlate best


@dataclass(frozen=True)
class SweepImages:
    """Smoothed images of a template group.

    Attributes
    ----------
    flat : (M,) float32
    seen : (M,) uint8
    shapes : (K + 1, 2) int64
    starts : (K + 1,) int64
    """

    flat: np.ndarray
    seen: np.ndarray
    shapes: np.ndarray
    starts: np.ndarray

    @classmethod
    def of(cls, images: list[np.ndarray], masks: list[np.ndarray | None], blur: float) -> SweepImages:
        """Smooth grey images (H, W), the template first, by a Gaussian of standard deviation `blur`, pixels."""
        smooth = [np.asarray(image, dtype=np.float32) for image in images]
        if blur > 0:
            smooth = [np.asarray(cv2.GaussianBlur(s, (0, 0), blur), dtype=np.float32) for s in smooth]
        seen = [
            np.ones(s.size, np.uint8) if m is None else (np.asarray(m) != 0).astype(np.uint8).ravel()
            for s, m in zip(smooth, masks, strict=True)
        ]
        shapes = np.array([s.shape for s in smooth], dtype=np.int64)
        starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]])
        return cls(np.concatenate([s.ravel() for s in smooth]), np.concatenate(seen), shapes, starts)


@njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def sweep(sweep_images, transfers, points, bounds, focal, radius, step, tilt, tilts, limits, result):
    """Find the best plane of every point (N, 2) on its ray, between inverse depths `bounds` (N, 2).

    `sweep_images` are the arrays of `SweepImages`, `limits` the least correlation of all images, that of one alone, the
    lead over other places, and how far images may disagree, pixels.
    `result` (N, 5) receives the number of a reason in `seeds.REASONS`, the plane, and its correlation.
    """
    flat, seen, shapes, starts = sweep_images
    least, pair_least, lead, agreement = limits
    images = len(transfers)
    side = 2 * tilts + 1
    for s in prange(len(points)):
        x, y = points[s]
        ix, iy = int(x), int(y)
        low, high = bounds[s]
        result[s, 0] = 1
        if not (low > 0 and high > low):
            continue
        height, width = shapes[0]
        f, offsets, variance = template_patch(flat, seen, height, width, ix, iy, radius)
        if not variance > 0:
            continue
        point, each = np.empty(6), np.empty(images)
        plane, trial = np.zeros(5), np.zeros(5)
        scene = transfers, shapes, starts, flat
        patch = f, offsets, variance, radius
        work = np.empty((images, 2)), np.empty((images, 4)), point, each
        # Steps of μ that move the fastest image by `step`
        length = 0.0
        for k in range(images):
            if transfer(transfers[k], high, x, y, point):
                ax, ay = point[0], point[1]
                if transfer(transfers[k], low, x, y, point):
                    length = max(length, math.hypot(ax - point[0], ay - point[1]))
        if not length > 0:
            continue
        steps = min(max(int(length / step) + 1, 2), 2000)
        scores = np.full((steps, images + 1), -2.0)
        tilt_of = np.zeros((steps, images + 1), np.int64)
        for m in range(steps):
            mu = low + (high - low) * (m + 0.5) / steps
            inside = True
            for k in range(images):
                if not transfer(transfers[k], mu, x, y, point):
                    inside = False
                    break
                h, w = shapes[k + 1]
                if not (point[0] >= 0 and point[1] >= 0 and point[0] < w - 1 and point[1] < h - 1):
                    continue
                # Off the subject in one image: there is no surface
                if seen[starts[k + 1] + int(point[1] + 0.5) * w + int(point[0] + 0.5)] == 0:
                    inside = False
                    break
            if not inside:
                continue
            plane[0] = mu
            plane[1] = plane[2] = 0.0
            total = on_plane(scene, x, y, plane, patch, work, -1)
            scores[m, :images] = each
            scores[m, images] = total
        tilt_of[:] = side * side // 2
        # Tilted planes, where facing ones are not hopeless
        promise = np.empty(steps)
        for m in range(steps):
            promise[m] = scores[m].max()
        for _ in range(min(steps, _PROMISING)):
            m = int(np.argmax(promise))
            if not promise[m] > -1.5:
                break
            promise[m] = -2.0
            for t in range(side * side):
                plane[0] = low + (high - low) * (m + 0.5) / steps
                plane[1] = plane[0] * tilt / focal * (t % side - tilts)
                plane[2] = plane[0] * tilt / focal * (t // side - tilts)
                total = on_plane(scene, x, y, plane, patch, work, -1)
                for k in range(images):
                    if each[k] > scores[m, k]:
                        scores[m, k] = each[k]
                        tilt_of[m, k] = t
                if total > scores[m, images]:
                    scores[m, images] = total
                    tilt_of[m, images] = t
        # All images together; where they don't agree, one of them alone, which then has to be the better
        unit = (high - low) / steps
        pixels = length / steps
        apart = math.ceil(4.0 / pixels)
        for choice in range(images + 1):
            only = choice - 1
            column = images if only < 0 else only
            if only >= 0 and images == 1:
                break
            best = np.argmax(scores[:, column])
            t = tilt_of[best, column]
            plane[0] = low + unit * (best + 0.5)
            plane[1] = plane[0] * tilt / focal * (t % side - tilts)
            plane[2] = plane[0] * tilt / focal * (t // side - tilts)
            top = scores[best, column]
            needed = least if only < 0 else pair_least
            if top > needed - lead:
                top = refine(scene, x, y, plane, unit, plane[0] * tilt / focal, top, patch, work, trial, only)
            on_plane(scene, x, y, plane, patch, work, only)
            status = 0
            for m in range(steps):
                if abs(m - best) > apart and scores[m, column] > top - lead * (1 if only < 0 else 2):
                    status = 3
            if only < 0:
                for k in range(images):
                    own = np.argmax(scores[:, k])
                    if abs(own - best) * pixels > agreement and scores[own, k] > each[k] + 0.5 * lead:
                        status = 4
                if each.min() < least:
                    status = 2
            elif top < pair_least:
                status = 2
            if only < 0 or status == 0:
                result[s, 0] = status
                result[s, 1:4] = plane[:3]
                result[s, 4] = top
            if status == 0:
                break
