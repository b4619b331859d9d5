"""Wallis filter: local mean and contrast brought to target values.

Wallis 1976, "An approach to the space variant restoration and enhancement of images": with the mean m and standard
deviation s of a window around each pixel,

    g' = r₁ g + r₀,   r₁ = c s_t / (c s + (1 − c) s_t),   r₀ = b m_t + (1 − b − r₁) m.
"""

from __future__ import annotations

import cv2
import numpy as np

from geomocap.matching.matching_settings import WallisSettings


def local_statistics(image: np.ndarray, window: int, mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation in a square window around each pixel, cut at the borders and by the mask.

    Parameters
    ----------
    image : (H, W) array
    window : int
        Edge of the window, odd, pixels.
    mask : (H, W) array, optional
        Non-zero where pixels count.

    Returns
    -------
    mean, deviation : (H, W) float
        0 where no pixel of the window counts.
    """

    def box(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, cv2.CV_64F, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)

    g = np.asarray(image, dtype=np.float64)
    weight = np.ones_like(g) if mask is None else (np.asarray(mask) != 0).astype(np.float64)
    # Sums of squares about a value near the mean lose no digits
    middle = float(g[weight > 0].mean()) if weight.any() else 0.0
    g = (g - middle) * weight
    # Running sums of real numbers may miss a whole number by rounding
    count = np.rint(box(weight))
    safe = np.maximum(count, 1)
    mean = box(g) / safe
    variance = np.maximum(box(g * g) / safe - mean**2, 0)
    return np.where(count > 0, mean + middle, 0.0), np.sqrt(variance)


def wallis(image: np.ndarray, settings: WallisSettings | None = None, mask: np.ndarray | None = None) -> np.ndarray:
    """Filter a grey image.

    Parameters
    ----------
    image : (H, W) array, grey levels
    settings : WallisSettings, optional
    mask : (H, W) array, optional
        Non-zero where pixels count for the statistics, so that the background does not tint the subject's border.

    Returns
    -------
    (H, W) float32, grey levels; not clipped, not rounded
    """
    settings = settings or WallisSettings()
    mean, deviation = local_statistics(image, settings.window | 1, mask)
    b, c, target = settings.brightness, settings.contrast, settings.deviation
    gain = c * target / (c * deviation + (1 - c) * target) if c < 1 else target / np.maximum(deviation, 1e-6)
    offset = b * settings.mean + (1 - b - gain) * mean
    return (gain * image + offset).astype(np.float32)
