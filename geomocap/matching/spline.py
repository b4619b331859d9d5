"""Images as B-splines: prefiltered coefficients, values and exact derivatives between the pixels.

A spline image is s(x, y) = Σ c[j, i] β(x − i) β(y − j), with β the centred B-spline of degree 3 (cubic) or 5
(quintic) and the coefficients chosen so that s runs through all pixel values (Unser, Aldroubi, Eden 1993, "B-spline
signal processing"). Inside the kernels positions are array indices (COLMAP pixel minus 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from scipy import ndimage

PAD = 4
"""Coefficients kept beyond each border, pixels; the quintic needs three."""

ANY_ORDER = {"reassoc", "nsz"}
"""What the compiler may do with sums: add in another order, but not round otherwise.

Code that was just compiled and the same code from the cache are optimised differently; were they free to fuse
multiplications with additions, a first run would differ from later ones in the last bits.
"""

_F4 = np.float32
_SIXTH = _F4(1 / 6)
_I120 = _F4(1 / 120)
_1, _2, _3, _4, _5, _6 = (_F4(v) for v in (1, 2, 3, 4, 5, 6))
_20, _26, _30, _50, _60, _66, _10 = (_F4(v) for v in (20, 26, 30, 50, 60, 66, 10))


@dataclass(frozen=True)
class ImageStack:
    """Spline coefficients of several images, of any sizes, one behind the other.

    Attributes
    ----------
    flat : (M,) float32
        Padded coefficients of all images, row by row.
    masks : (M,) uint8
        1 where the pixel may be used, in the same order; all ones without masks.
    layout : (C, 4) int64
        For each image: index of its pixel (0, 0) in `flat`, length of a padded row, height, width.
    order : int
        Degree of the splines, 3 or 5.
    """

    flat: np.ndarray
    masks: np.ndarray
    layout: np.ndarray
    order: int

    def __len__(self) -> int:
        return len(self.layout)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """What kernels take: coefficients, masks, layout and order."""
        return self.flat, self.masks, self.layout, self.order

    @classmethod
    def of(
        cls, images: Sequence[np.ndarray], order: int = 3, masks: Sequence[np.ndarray | None] | None = None
    ) -> ImageStack:
        """Prefilter grey images.

        Parameters
        ----------
        images : sequence of (H, W) arrays, any grey levels
        order : {3, 5}
            Cubic or quintic splines.
        masks : sequence of (H, W) arrays or None
            Non-zero where an image may be used.

        Raises
        ------
        ValueError
            If an image is not two-dimensional, too small, or its mask has another shape; or for another order.
        """
        if order not in (3, 5):
            raise ValueError(f"spline order {order}: only 3 (cubic) and 5 (quintic) are there")
        layout = np.zeros((len(images), 4), np.int64)
        coefficients, usable = [], []
        start = 0
        for c, image in enumerate(images):
            image = np.asarray(image)
            mask = None if masks is None else masks[c]
            if image.ndim != 2 or min(image.shape) <= 2 * PAD:
                raise ValueError(f"image {c} has shape {image.shape}: a grey image of more than 8×8 pixels is needed")
            if mask is not None and mask.shape != image.shape:
                raise ValueError(f"mask {c} has shape {mask.shape}, its image {image.shape}")
            padded = np.pad(image.astype(np.float64), PAD, mode="reflect")
            spline = ndimage.spline_filter(padded, order=order, mode="mirror", output=np.float64)
            coefficients.append(spline.astype(np.float32).ravel())
            part = np.zeros(padded.shape, np.uint8)
            part[PAD:-PAD, PAD:-PAD] = 1 if mask is None else np.asarray(mask) != 0
            usable.append(part.ravel())
            stride = padded.shape[1]
            layout[c] = start + PAD * stride + PAD, stride, image.shape[0], image.shape[1]
            start += padded.size
        empty = np.zeros(0)
        return cls(
            np.concatenate(coefficients or [empty.astype(np.float32)]),
            np.concatenate(usable or [empty.astype(np.uint8)]),
            layout,
            order,
        )

    def sample(self, image: int, pixels: np.ndarray) -> np.ndarray:
        """Evaluate one image at COLMAP pixels (N, 2): (N,) float32, NaN outside the outermost pixel centres."""
        pixels = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
        out = np.empty(len(pixels), np.float32)
        _sample_points(self.flat, self.layout[image], self.order, pixels, out)
        return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER, inline="always")
def cubic_weights(t, w, j):
    """Put the four cubic B-spline weights at fraction `t` into column `j` of `w`."""
    t2 = t * t
    t3 = t2 * t
    u = _1 - t
    w[0, j] = u * u * u * _SIXTH
    w[1, j] = (_3 * t3 - _6 * t2 + _4) * _SIXTH
    w[2, j] = (_3 * (t + t2 - t3) + _1) * _SIXTH
    w[3, j] = t3 * _SIXTH


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER, inline="always")
def quintic_weights(t, w, j):
    """Put the six quintic B-spline weights at fraction `t` into column `j` of `w`."""
    u = _1 - t
    t2 = t * t
    u2 = u * u
    w[0, j] = u2 * u2 * u * _I120
    w[1, j] = (_26 + t * (-_50 + t * (_20 + t * (_20 + t * (-_20 + _5 * t))))) * _I120
    w[2, j] = (_66 + t2 * (-_60 + t2 * (_30 - _10 * t))) * _I120
    w[3, j] = (_66 + u2 * (-_60 + u2 * (_30 - _10 * u))) * _I120
    w[4, j] = (_26 + u * (-_50 + u * (_20 + u * (_20 + u * (-_20 + _5 * u))))) * _I120
    w[5, j] = t2 * t2 * t * _I120


@njit(cache=True, nogil=True, error_model="numpy", fastmath=ANY_ORDER)
def _weights(order, t, w):
    """Put the weights of spline `order` at fraction `t` into the column of `w`."""
    if order == 3:
        cubic_weights(t, w, 0)
    else:
        quintic_weights(t, w, 0)


@njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def _sample_points(flat, layout, order, pixels, out):
    start, stride, height, width = layout
    for n in prange(len(pixels)):
        x = pixels[n, 0] - 0.5
        y = pixels[n, 1] - 0.5
        if not (x >= 0 and y >= 0 and x <= width - 1 and y <= height - 1):
            out[n] = np.nan
            continue
        wx, wy = np.empty((6, 1), np.float32), np.empty((6, 1), np.float32)
        ix = int(x)
        iy = int(y)
        _weights(order, np.float32(x - ix), wx)
        _weights(order, np.float32(y - iy), wy)
        taps = order + 1
        base = start + (iy - order // 2) * stride + ix - order // 2
        value = np.float32(0)
        for k in range(taps):
            row = np.float32(0)
            for m in range(taps):
                row += wx[m, 0] * flat[base + k * stride + m]
            value += wy[k, 0] * row
        out[n] = value


NOISE_VALUE = np.array([[0.87625, 0.12375], [0.918, 0.082]])
"""Fraction of white pixel noise that a spline value keeps, as a function of the fraction t, for cubic and quintic:
a(t) = Σ_k η(k + t)² ≈ A₀ + A₁ cos 2πt, with η the cardinal spline; 1 on a pixel, 0.756 between two (cubic)."""

NOISE_SLOPE = np.array([1.392305, 1.893964])
"""Variance of the spline's derivative on a pixel for white pixel noise of variance 1, cubic and quintic: Σ_k η'(k)²."""
