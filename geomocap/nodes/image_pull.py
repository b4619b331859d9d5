"""What images ask of a deforming surface: each sample's window looks the same in two frames of every camera.

A window is a piece of the sample's tangent plane, turned as its nodes are. With I(q) the image of one frame where the
window is, and J(q) that of an earlier one where it was, both less their means over the window,

    E = Σ_samples Σ_cameras Σ_q (I(q) − J(q))² / σ²

is linearised in the sample's place and joins the deformation's normal equations. What a window without texture asks is
little and what an edge asks is across it, by itself: there is no threshold below which a sample isn't followed.

Source: B. Lucas, T. Kanade, "An iterative image registration technique", IJCAI 1981, in space instead of an image, as
in F. Devernay, D. Mateus, M. Guilbert, "Multi-camera scene flow by tracking 3-D points and surfels", CVPR 2006.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

HALF = 2
"""Half a window's side, pixels (2 and 3 measure alike; 2 takes a third of the time)."""
LEAST_COSINE = 0.25
"""Surfaces seen at a smaller angle (its sine) say nothing."""
_LEAST_FILLED = 0.5  # of a window that is on the subject in both frames
_HIDING = 3.0  # voxels by which a surface must be nearer to hide a sample


class Views(Protocol):
    """One frame in all cameras, as `patches.frame_views.FrameViews` holds it."""

    @property
    def levels(self) -> np.ndarray:
        """Blurred grey images (L, C, H, W) float32, coarsest first."""

    @property
    def masks(self) -> np.ndarray:
        """Silhouettes (C, H, W) uint8."""

    @property
    def depth(self) -> np.ndarray:
        """Depth of the surface (C, H, W) float32, metres."""

    @property
    def projections(self) -> np.ndarray:
        """World metres to array indices (C, 3, 4), third row of unit length."""

    @property
    def voxel_size(self) -> float:
        """Metres."""


@dataclass(frozen=True)
class FrameImages:
    """The part of a frame's images that shows the subject, in the unit that the surface is followed in.

    Attributes
    ----------
    levels : (L, C, h, w) float32
    masks : (C, h, w) uint8
    depth : (C, h, w) float32, metres
    projections : (C, 3, 4) float
        To array indices of the part; the third row gives the depth in metres.
    centers : (C, 3) float
        Camera centres.
    hiding : float, metres
        Depth by which a surface must be nearer to hide another.
    focal : (C,) float
        Pixels.
    length : float
        Metres of the unit.
    """

    levels: np.ndarray
    masks: np.ndarray
    depth: np.ndarray
    projections: np.ndarray
    centers: np.ndarray
    hiding: float
    focal: np.ndarray
    length: float

    @classmethod
    def of(cls, views: Views, length: float = 1.0, origin: np.ndarray | None = None) -> FrameImages:
        """Cut out the subject; `length` (m) and `origin` (3,), metres, are the unit's."""
        o = np.zeros(3) if origin is None else origin
        H, W = views.masks.shape[1:]
        rows, columns = np.asarray(views.masks.any(axis=2)), np.asarray(views.masks.any(axis=1))
        low = np.stack([np.maximum(_first(columns) - HALF, 0), np.maximum(_first(rows) - HALF, 0)], axis=1)
        high = np.stack([W - _first(columns[:, ::-1]) + HALF, H - _first(rows[:, ::-1]) + HALF], axis=1)
        w, h = np.minimum(np.max(high - low, axis=0), (W, H))
        low = np.minimum(low, (W - w, H - h))
        parts = [(slice(y, y + h), slice(x, x + w)) for x, y in low]
        P = views.projections.astype(float)
        focal = np.sqrt(np.abs(np.linalg.det(P[:, :, :3])))
        P = np.concatenate([P[:, :, :3] * length, P[:, :, :3] @ o[:, None] + P[:, :, 3:]], axis=2)
        P[:, :2] -= low[:, :, None] * P[:, 2:]
        return cls(
            np.stack([views.levels[(slice(None), c, *part)] for c, part in enumerate(parts)], axis=1),
            np.stack([views.masks[(c, *part)] for c, part in enumerate(parts)]),
            np.stack([views.depth[(c, *part)] for c, part in enumerate(parts)]),
            np.ascontiguousarray(P),
            -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0],
            _HIDING * views.voxel_size,
            focal,
            length,
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How squarely each camera sees points (S, 3) with normals, (S, C) cosine, 0 where hidden; pixels' size there.

        The size of a pixel, (S, C), is in the surface's unit.
        """
        P = self.projections
        place = np.einsum("cij,sj->sci", P[:, :, :3], points) + P[:, :, 3]
        depth = np.maximum(place[..., 2], 1e-9)
        pixel = np.rint(place[..., :2] / depth[..., None])
        h, w = self.depth.shape[1:]
        inside = (place[..., 2] > 0) & (pixel >= 0).all(axis=2) & (pixel[..., 0] < w) & (pixel[..., 1] < h)
        x, y = (np.where(inside, pixel[..., k], 0).astype(int) for k in range(2))
        surface = self.depth[np.arange(len(P))[None], y, x]
        ray = self.centers - points[:, None]
        cosine = (ray * normals[:, None]).sum(axis=2) / np.linalg.norm(ray, axis=2)
        seen = inside & np.isfinite(surface) & (depth < surface + self.hiding) & (cosine > LEAST_COSINE)
        return np.where(seen, cosine, 0.0), depth / self.focal / self.length


def _first(flags: np.ndarray) -> np.ndarray:
    """Index of the first True of each row, 0 where there is none."""
    return flags.argmax(axis=1)


@njit(cache=True, nogil=True, error_model="numpy")
def _value(image, x, y):
    j, i = int(x), int(y)
    a, b = x - j, y - i
    return (1 - b) * ((1 - a) * image[i, j] + a * image[i, j + 1]) + b * (
        (1 - a) * image[i + 1, j] + a * image[i + 1, j + 1]
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _project_window(P, y, e, step, middle, row, column):
    """Homogeneous place of a window's middle and steps of its rows and columns, (3,) each, by a projection (3, 4)."""
    for k in range(3):
        middle[k] = P[k, 0] * y[0] + P[k, 1] * y[1] + P[k, 2] * y[2] + P[k, 3]
        row[k] = step * (P[k, 0] * e[0, 0] + P[k, 1] * e[0, 1] + P[k, 2] * e[0, 2])
        column[k] = step * (P[k, 0] * e[1, 0] + P[k, 1] * e[1, 1] + P[k, 2] * e[1, 2])


@njit(cache=True, nogil=True, error_model="numpy")
def window_pulls(now, P, mask_now, then, Q, mask_then, y, e, y0, e0, step, seen, half, A, b, error, count):
    """Gather what the windows of all samples in all cameras ask against K earlier frames, with σ = 1.

    Parameters
    ----------
    now, mask_now : (C, h, w) float32, uint8
        Images and silhouettes of this frame.
    P : (C, 3, 4) float
        Its projections.
    then, Q, mask_then : tuple of K
        The same of earlier frames, whose images may have other sizes.
    y, e : (S, 3), (S, 2, 3) float
        Samples of this frame's surface and two axes of their tangent planes.
    y0, e0 : (K, S, 3), (K, S, 2, 3) float
        The same of the earlier frames.
    step : (S, C) float
        Distance of a window's pixels on the surface.
    seen : (K, S, C) bool
        Which windows to compare.
    half : int
    A, b : (K, S, C, 3, 3), (K, S, C, 3) float, out
        Weights of the samples' places, and these times their errors.
    error : (K, S, C) float, out
        Sum of the squared differences.
    count : (K, S, C) int, out
        Pixels compared; 0: too few.
    """
    side = 2 * half + 1
    size = side**2
    value, slope, on = np.empty(size), np.empty((size, 3)), np.empty(size, np.bool_)
    across = np.empty((size, 2))
    for n in range(size):
        across[n, 0], across[n, 1] = n // side - half, n % side - half
    # places on the images are quotients of what is linear in the window's rows and columns
    o, di, dj = np.empty(3), np.empty(3), np.empty(3)
    # sums of slopes and of their products over the window's pixels, and over those that an earlier frame hasn't
    some, products, less, products_less, pulled = np.empty(3), np.empty(6), np.empty(3), np.empty(6), np.empty(3)
    height, width = mask_now.shape[1:]
    for s in range(len(y)):
        for c in range(len(P)):
            wanted = False
            for k in range(len(then)):
                count[k, s, c] = 0
                wanted |= seen[k, s, c]
            if not wanted:
                continue
            # this frame's values, and how they change with the sample's place
            _project_window(P[c], y[s], e[s], step[s, c], o, di, dj)
            image = now[c]
            there = 0
            some[:], products[:] = 0.0, 0.0
            for n in range(size):
                i, j = across[n, 0], across[n, 1]
                on[n] = False
                w = o[2] + i * di[2] + j * dj[2]
                if w <= 0:
                    continue
                w = 1.0 / w
                u, v = w * (o[0] + i * di[0] + j * dj[0]), w * (o[1] + i * di[1] + j * dj[1])
                if not (u >= 1 and v >= 1 and u < width - 2 and v < height - 2):
                    continue
                if mask_now[c, int(v + 0.5), int(u + 0.5)] == 0:
                    continue
                on[n] = True
                there += 1
                # value and half the central differences there, all bilinear
                row, col = int(v), int(u)
                a, d = u - col, v - row
                p, q = 1 - a, 1 - d
                f00, f01 = image[row, col], image[row, col + 1]
                f10, f11 = image[row + 1, col], image[row + 1, col + 1]
                value[n] = q * (p * f00 + a * f01) + d * (p * f10 + a * f11)
                gx = q * (p * (f01 - image[row, col - 1]) + a * (image[row, col + 2] - f00))
                gx += d * (p * (f11 - image[row + 1, col - 1]) + a * (image[row + 1, col + 2] - f10))
                gy = p * (q * (f10 - image[row - 1, col]) + d * (image[row + 2, col] - f00))
                gy += a * (q * (f11 - image[row - 1, col + 1]) + d * (image[row + 2, col + 1] - f01))
                gx, gy = 0.5 * gx * w, 0.5 * gy * w
                for m in range(3):
                    slope[n, m] = gx * (P[c, 0, m] - u * P[c, 2, m]) + gy * (P[c, 1, m] - v * P[c, 2, m])
                _count_slope(slope[n], some, products)
            if there < _LEAST_FILLED * size:
                continue
            for k in range(len(then)):
                if not seen[k, s, c]:
                    continue
                _project_window(Q[k][c], y0[k, s], e0[k, s], step[s, c], o, di, dj)
                before, mask = then[k][c], mask_then[k][c]
                high, wide = mask.shape
                found, total, squares = 0, 0.0, 0.0
                less[:], products_less[:], pulled[:] = 0.0, 0.0, 0.0
                for n in range(size):
                    if not on[n]:
                        continue
                    i, j = across[n, 0], across[n, 1]
                    w = o[2] + i * di[2] + j * dj[2]
                    w = 1.0 / w if w > 0 else -1.0
                    u, v = w * (o[0] + i * di[0] + j * dj[0]), w * (o[1] + i * di[1] + j * dj[1])
                    inside = w > 0 and u >= 0 and v >= 0 and u < wide - 1 and v < high - 1
                    if not inside or mask[int(v + 0.5), int(u + 0.5)] == 0:
                        _count_slope(slope[n], less, products_less)
                        continue
                    r = value[n] - _value(before, u, v)
                    found += 1
                    total += r
                    squares += r * r
                    for m in range(3):
                        pulled[m] += slope[n, m] * r
                if found < _LEAST_FILLED * size:
                    continue
                count[k, s, c] = found
                error[k, s, c] = squares - total * total / found
                at = 0
                for m in range(3):
                    mean = (some[m] - less[m]) / found
                    b[k, s, c, m] = pulled[m] - mean * total
                    for n in range(m, 3):
                        A[k, s, c, m, n] = products[at] - products_less[at] - mean * (some[n] - less[n])
                        A[k, s, c, n, m] = A[k, s, c, m, n]
                        at += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _count_slope(slope, total, products):
    """Add a slope (3,) to a sum, and its products with itself, the upper triangle row by row (6,), to theirs."""
    at = 0
    for m in range(3):
        total[m] += slope[m]
        for n in range(m, 3):
            products[at] += slope[m] * slope[n]
            at += 1
