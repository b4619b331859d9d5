"""Finding and measuring bright targets in the images of a bar recording."""

from __future__ import annotations

import cv2
import numpy as np

from geomocap.calibration.calibration_settings import TargetSettings
from geomocap.calibration.disc import fit_disc
from geomocap.files.capture import FrameSource
from geomocap.model.even_choice import evenly_chosen

SATURATION = 254.0


def gray_of(image: np.ndarray) -> np.ndarray:
    """Brightness of an image (H, W, 3) or (H, W) uint8: (H, W) float32."""
    if image.ndim == 2:
        return image.astype(np.float32)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def still_background(source: FrameSource, frames: np.ndarray, settings: TargetSettings) -> np.ndarray:
    """Brightness that stays through a recording, (H, W) float32: lamps and reflections that do not move.

    The median of some frames: the bar itself is nowhere long enough to be part of it.
    """
    picked = evenly_chosen(len(frames), settings.background_frames)
    stack = [gray_of(source.read(int(frames[k]))).astype(np.uint8) for k in picked]
    return np.median(np.stack(stack), axis=0).astype(np.float32)


def find_targets(image: np.ndarray, background: np.ndarray, settings: TargetSettings) -> np.ndarray:
    """Find and measure the bright targets in one image.

    Parameters
    ----------
    image : (H, W) float32
    background : (H, W) float32
        From `still_background`.
    settings : TargetSettings

    Returns
    -------
    targets : (n, 7) float
        x, y (COLMAP pixels), standard deviation of a coordinate (px), radius (px), brightness over the surroundings,
        standard deviation of unit weight (grey levels), ratio of the axes; brightest times largest first.
    """
    difference = cv2.GaussianBlur(image - background, (3, 3), 0)
    # Half of each target's own brightness bounds it, so find peaks first, then what belongs to them
    _, mask = cv2.threshold(difference, settings.contrast, 255, cv2.THRESH_BINARY)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    side = max(image.shape)
    largest = settings.max_radius * side
    found = []
    result = np.zeros(16)
    order = np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")[: 8 * settings.max_candidates] + 1
    for k in order:
        x, y, w, h, _ = stats[k]
        if max(w, h) > 4 * largest:
            continue
        inside = labels[y : y + h, x : x + w] == k
        values = np.where(inside, difference[y : y + h, x : x + w], 0)
        core = inside & (values > 0.5 * values.max())
        area = float(core.sum())
        radius = np.sqrt(area / np.pi)
        if not 0.5 * settings.min_radius <= radius <= largest or count < 2:
            continue
        rows, columns = np.nonzero(core)
        cx, cy = x + columns.mean() + 0.5, y + rows.mean() + 0.5
        spread = np.cov(np.stack([columns, rows])) if len(rows) > 2 else np.eye(2)
        axes = np.sqrt(np.maximum(np.linalg.eigvalsh(np.atleast_2d(spread)), 1 / 12))
        if axes[1] / axes[0] > 1.5 * settings.max_elongation:
            continue
        if not fit_disc(image, cx, cy, max(radius, settings.min_radius), 0.8, 4.0, SATURATION, result):
            continue
        if result[15] > settings.max_elongation or not settings.min_radius <= result[3] <= largest:
            continue
        contrast = result[2] - result[7]
        if contrast < settings.contrast or result[10] > 0.25 * contrast:
            continue
        sigma = np.sqrt(0.5 * (result[11] ** 2 + result[12] ** 2))
        sigma = np.hypot(sigma, settings.min_sigma)
        found.append((result[0], result[1], sigma, result[3], contrast, result[10], result[15]))
    targets = np.array(found).reshape(-1, 7)
    return targets[np.argsort(-targets[:, 4] * targets[:, 3], kind="stable")]
