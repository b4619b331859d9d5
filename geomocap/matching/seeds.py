"""Seeds: interest points of the template and their best match along the epipolar lines of all search images.

A seed's patch is carried along the viewing ray (a sweep of the inverse depth μ) on planes of several tilts; every image gives
a correlation for every μ. The best place is that of the highest mean correlation. It has to lead over all other places
(uniqueness), every image has to correlate there, and each image's own best place has to be near it (consistency).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit, prange

from geomocap.matching.foerstner import interest_points
from geomocap.matching.grow_kernel import plane_start
from geomocap.matching.patch_kernel import transfer
from geomocap.matching.settings import SeedSettings
from geomocap.matching.spline import FAST

REASONS = ("seed found", "seed without depth range", "seed of low correlation", "seed not unique", "images disagree")


@dataclass(frozen=True)
class Seeds:
    """Where growing begins.

    Attributes
    ----------
    pixels : (S, 2) float
        Template image, COLMAP pixels.
    planes : (S, 3) float
        Inverse depth, 1/m, and its slope in x and y, 1/m per pixel.
    correlation : (S,) float
    reasons : dict
        How many interest points came to which end.
    """

    pixels: np.ndarray
    planes: np.ndarray
    correlation: np.ndarray
    reasons: dict[str, int]

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class DepthRange:
    """Where surface may lie along the template's rays.

    Attributes
    ----------
    near, far : (H, W) float32
        Bounds of the depth along the camera's axis for each template pixel, metres; NaN where there is no surface.
    """

    near: np.ndarray
    far: np.ndarray

    @classmethod
    def constant(cls, shape: tuple[int, int], near: float, far: float) -> DepthRange:
        """Return the same bounds for all pixels of an image of shape (H, W)."""
        return cls(np.full(shape, near, np.float32), np.full(shape, far, np.float32))


def find_seeds(
    images: list[np.ndarray],
    masks: list[np.ndarray | None],
    template: int,
    searches: np.ndarray,
    transfers: np.ndarray,
    depth: DepthRange,
    focal: float,
    settings: SeedSettings | None = None,
) -> Seeds:
    """Find interest points and their planes.

    Parameters
    ----------
    images : list of (H, W) arrays
        Grey images free of distortion, after the Wallis filter.
    masks : list of (H, W) arrays or None
        Non-zero where the subject is seen.
    template : int
    searches : (K,) int
    transfers : (K, 12) float
    depth : DepthRange
    focal : float
        Camera constant of the template, pixels.
    settings : SeedSettings, optional

    Returns
    -------
    seeds : Seeds
        The strongest interest points first.
    """
    settings = settings or SeedSettings()
    used = [template, *(int(s) for s in searches)]
    smooth = []
    for i in used:
        image = np.asarray(images[i], dtype=np.float32)
        smooth.append(cv2.GaussianBlur(image, (0, 0), settings.blur) if settings.blur > 0 else image)
    shapes = np.array([s.shape for s in smooth], dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]])
    flat = np.concatenate([s.ravel() for s in smooth])
    seen = np.concatenate(
        [
            np.ones(s.size, np.uint8) if masks[i] is None else (np.asarray(masks[i]) != 0).astype(np.uint8).ravel()
            for i, s in zip(used, smooth, strict=True)
        ]
    )
    points = interest_points(
        images[template],
        masks[template],
        settings.window | 1,
        settings.minimum_weight,
        settings.minimum_roundness,
        settings.cell,
        settings.limit,
    )
    rows, columns = (points.pixels[:, ::-1].T - 0.5).astype(int)
    bounds = np.column_stack([1 / depth.far[rows, columns], 1 / depth.near[rows, columns]]).astype(np.float64)
    result = np.zeros((len(points.pixels), 5))
    _sweep(
        flat,
        seen,
        shapes,
        starts,
        transfers,
        points.pixels - 0.5,
        bounds,
        focal,
        settings.radius,
        settings.step,
        settings.tilt,
        settings.correlation,
        settings.uniqueness,
        settings.agreement,
        result,
    )
    status = result[:, 0].astype(int)
    counts = Counter(status.tolist())
    good = status == 0
    return Seeds(
        points.pixels[good],
        result[good, 1:4],
        result[good, 4],
        {REASONS[code]: counts[code] for code in sorted(counts)},
    )


@njit(cache=True, nogil=True, fastmath=FAST)
def _correlate(flat, start, height, width, f, offsets, variance, position, affine, radius):
    """Normalised correlation of the centred template samples `f` at `offsets` with an image under a warp, bilinear."""
    ex = (abs(affine[0]) + abs(affine[1])) * radius
    ey = (abs(affine[2]) + abs(affine[3])) * radius
    px, py = position
    if not (px - ex >= 0 and py - ey >= 0 and px + ex < width - 1 and py + ey < height - 1):
        return -2.0
    s = ss = sf = 0.0
    n = len(f)
    for i in range(n):
        dx, dy = offsets[i]
        x = px + affine[0] * dx + affine[1] * dy
        y = py + affine[2] * dx + affine[3] * dy
        ix = int(x)
        iy = int(y)
        tx = x - ix
        ty = y - iy
        at = start + iy * width + ix
        top = flat[at] + tx * (flat[at + 1] - flat[at])
        bottom = flat[at + width] + tx * (flat[at + width + 1] - flat[at + width])
        g = top + ty * (bottom - top)
        s += g
        ss += g * g
        sf += g * f[i]
    spread = ss - s * s / n
    if not spread > 1e-6 * ss:
        return -2.0
    return sf / math.sqrt(spread * variance)


@njit(cache=True, nogil=True, fastmath=FAST)
def _on_plane(
    transfers, shapes, starts, flat, x, y, plane, f, offsets, variance, radius, position, affine, point, each
):
    """Mean correlation over all images with the template patch laid on a plane; each image's into `each`."""
    each[:] = -2.0
    if not plane_start(transfers, x, y, plane, position, affine, point):
        return -2.0
    total = 0.0
    for k in range(len(transfers)):
        h, w = shapes[k + 1]
        each[k] = _correlate(flat, starts[k + 1], h, w, f, offsets, variance, position[k], affine[k], radius)
        total += each[k]
    return total / len(transfers)


@njit(cache=True, nogil=True, parallel=True)
def _sweep(
    flat,
    seen,
    shapes,
    starts,
    transfers,
    points,
    bounds,
    focal,
    radius,
    step,
    tilt,
    least,
    lead,
    agreement,
    result,
):
    images = len(transfers)
    side_tilts = 3 if tilt > 0 else 1
    side = radius + 1
    for s in prange(len(points)):
        x, y = points[s]
        ix, iy = int(x), int(y)
        low, high = bounds[s]
        result[s, 0] = 1
        if not (low > 0 and high > low):
            continue
        height, width = shapes[0]
        if ix < radius or iy < radius or ix + radius >= width or iy + radius >= height:
            continue
        f = np.empty(side * side)
        offsets = np.empty((side * side, 2))
        n = 0
        mean = 0.0
        for dy in range(-radius, radius + 1, 2):
            for dx in range(-radius, radius + 1, 2):
                at = (iy + dy) * width + ix + dx
                if seen[at]:
                    f[n] = flat[at]
                    offsets[n] = dx, dy
                    mean += f[n]
                    n += 1
        if n < 0.3 * side * side:
            continue
        f = f[:n] - mean / n
        offsets = offsets[:n]
        variance = 0.0
        for i in range(n):
            variance += f[i] * f[i]
        if not variance > 0:
            continue
        position = np.empty((images, 2))
        affine = np.empty((images, 4))
        point = np.empty(6)
        plane = np.zeros(5)
        trial = np.zeros(5)
        each = np.empty(images)
        # Steps of μ that move the fastest image by `step`
        length = 0.0
        for k in range(images):
            if transfer(transfers[k], high, x, y, point):
                ax, ay = point[0], point[1]
                if transfer(transfers[k], low, x, y, point):
                    length = max(length, math.hypot(ax - point[0], ay - point[1]))
        steps = min(max(int(length / step) + 1, 2), 2000)
        scores = np.full((steps, images + 1), -2.0)
        tilt_of = np.zeros(steps, np.int64)
        for m in range(steps):
            mu = low + (high - low) * (m + 0.5) / steps
            inside = True
            for k in range(images):
                if not transfer(transfers[k], mu, x, y, point):
                    inside = False
                    break
                h, w = shapes[k + 1]
                if not (point[0] >= 0 and point[1] >= 0 and point[0] < w - 1 and point[1] < h - 1):
                    inside = False
                    break
                if seen[starts[k + 1] + int(point[1] + 0.5) * w + int(point[0] + 0.5)] == 0:
                    inside = False
                    break
            if not inside:
                continue
            for t in range(side_tilts * side_tilts):
                plane[0] = mu
                plane[1] = mu * tilt / focal * ((t + 1) % 3 - 1)
                plane[2] = mu * tilt / focal * ((t // 3 + 1) % 3 - 1)
                total = _on_plane(
                    transfers, shapes, starts, flat, x, y, plane, f, offsets, variance, radius, position, affine, point, each
                )
                for k in range(images):
                    scores[m, k] = max(scores[m, k], each[k])
                if total > scores[m, images]:
                    scores[m, images] = total
                    tilt_of[m] = t
        best = np.argmax(scores[:, images])
        t = tilt_of[best]
        unit = (high - low) / steps
        plane[0] = low + unit * (best + 0.5)
        plane[1] = plane[0] * tilt / focal * ((t + 1) % 3 - 1)
        plane[2] = plane[0] * tilt / focal * ((t // 3 + 1) % 3 - 1)
        # Refine the best plane, one unknown after the other
        top = scores[best, images]
        for halving in range(4):
            scale = 0.5 ** (halving + 1)
            for unknown in range(3):
                change = scale * (unit if unknown == 0 else plane[0] * tilt / focal)
                for sign in (-1.0, 1.0):
                    trial[:] = plane
                    trial[unknown] += sign * change
                    total = _on_plane(
                        transfers, shapes, starts, flat, x, y, trial, f, offsets, variance, radius, position, affine, point, each
                    )
                    if total > top:
                        top = total
                        plane[:] = trial
        _on_plane(transfers, shapes, starts, flat, x, y, plane, f, offsets, variance, radius, position, affine, point, each)
        result[s, 0] = 2
        result[s, 1:4] = plane[:3]
        result[s, 4] = top
        if each.min() < least:
            continue
        result[s, 0] = 0
        pixels = length / steps
        apart = int(math.ceil(4.0 / pixels))
        for m in range(steps):
            if abs(m - best) > apart and scores[m, images] > top - lead:
                result[s, 0] = 3
        for k in range(images):
            own = np.argmax(scores[:, k])
            if abs(own - best) * pixels > agreement and scores[own, k] > each[k] + 0.5 * lead:
                result[s, 0] = 4
