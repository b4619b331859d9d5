"""Interest points: Foerstner's operator (Foerstner, Gülch 1987).

With the structure tensor N = Σ ∇g ∇gᵀ over a window, w = det N / tr N measures how well a window can be located (the
larger, the smaller its error ellipse) and q = 4 det N / (tr N)² how round that ellipse is (1: a circle, 0: an edge).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.matching.matching_settings import SeedSettings


@dataclass(frozen=True)
class InterestPoints:
    """Points that can be located well in all directions, the best first.

    Attributes
    ----------
    pixels : (N, 2) float, COLMAP pixels
    weight : (N,) float
        w, grey levels² per window.
    roundness : (N,) float
        q, 0 … 1.
    """

    pixels: np.ndarray
    weight: np.ndarray
    roundness: np.ndarray


def foerstner(image: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Return w and q of a grey image (H, W): two (H, W) float arrays; `window` is an odd edge length, pixels."""
    g = np.asarray(image, dtype=np.float64)
    gx = np.zeros_like(g)
    gy = np.zeros_like(g)
    gx[:, 1:-1] = (g[:, 2:] - g[:, :-2]) / 2
    gy[1:-1] = (g[2:] - g[:-2]) / 2
    size = (window, window)
    xx, xy, yy = (
        cv2.boxFilter(p, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for p in (gx * gx, gx * gy, gy * gy)
    )
    trace = np.maximum(xx + yy, 1e-12)
    det = np.maximum(xx * yy - xy * xy, 0)
    return det / trace, np.minimum(4 * det / trace**2, 1.0)


def interest_points(
    image: np.ndarray, mask: np.ndarray | None = None, settings: SeedSettings | None = None
) -> InterestPoints:
    """Find the best point of every cell of the image.

    Parameters
    ----------
    image : (H, W) array, grey levels
    mask : (H, W) array, optional
        Non-zero where points may lie.
    settings : SeedSettings, optional
        Window, least w (as a multiple of its mean over the mask) and q, cell and limit; points keep half a cell between
        them.
    """
    settings = settings or SeedSettings()
    window, cell = settings.window | 1, settings.cell
    w, q = foerstner(image, window)
    usable = np.ones(w.shape, bool) if mask is None else np.asarray(mask) != 0
    border = window // 2 + 1
    usable[:border] = usable[-border:] = usable[:, :border] = usable[:, -border:] = False
    if not usable.any():
        return InterestPoints(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    good = usable & (q >= settings.minimum_roundness) & (w >= settings.minimum_weight * w[usable].mean()) & (w > 0)
    value = np.where(good, w, 0.0)
    reach = cell // 2 * 2 + 1
    peak = good & (value >= cv2.dilate(value, np.ones((reach, reach), np.uint8)))
    rows, columns = np.nonzero(peak)
    order = np.lexsort([columns, rows, -w[rows, columns]])
    rows, columns = rows[order], columns[order]
    _, first = np.unique(rows // cell * (w.shape[1] // cell + 1) + columns // cell, return_index=True)
    first = np.sort(first)[: settings.limit]
    rows, columns = rows[first], columns[first]
    return InterestPoints(np.column_stack([columns, rows]) + 0.5, w[rows, columns], q[rows, columns])
