"""Silhouettes: frame and background model in, mask out."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from geomocap.errors import CaptureError
from geomocap.silhouettes.background import BackgroundModel
from geomocap.silhouettes.colors import color_evidence
from geomocap.silhouettes.evidence import DOUBTFUL, LIMIT, background_evidence, shadow_evidence, smooth_evidence
from geomocap.silhouettes.light import light_change
from geomocap.silhouettes.outline import refine_outline
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings


def silhouette(
    image: np.ndarray,
    model: BackgroundModel,
    settings: SilhouetteSettings | None = None,
    region: np.ndarray | None = None,
) -> np.ndarray:
    """Cut out what stands before the background.

    Parameters
    ----------
    image : (H, W, 3) uint8
        Frame, RGB.
    model : BackgroundModel
        Of the same camera.
    settings : SilhouetteSettings, optional
    region : (H, W) bool, optional
        Only within this region; see `region_of_points`.

    Returns
    -------
    (H, W) uint8
        0 or 255. Empty or full if the image says so: check its `coverage`.

    Raises
    ------
    CaptureError
        If image or region haven't the model's size.
    """
    settings = settings or SilhouetteSettings()
    model.check(image)
    if region is not None and region.shape != model.known.shape:
        raise CaptureError(f"region of interest {region.shape}: expected {model.known.shape}, the size of the images")
    image = np.ascontiguousarray(image)

    # Light of this frame, from the background alone
    gain, offset = (
        light_change(image, model.mean, model.sigma, model.known) if settings.gain else (np.ones(3), np.zeros(3))
    )
    light = gain.astype(np.float32), offset.astype(np.float32)

    # Evidence of each pixel against background and shadow, then of its surroundings
    evidence = pixel_evidence(image, model, settings, light)
    if region is not None:
        evidence[~region] = -LIMIT
    voted = evidence
    if settings.smoothing > 0:
        voted = smooth_evidence(evidence, image, model.sigma, np.float32(settings.smoothing), np.float32(settings.edge))

    # Subject or not, its outline to half a pixel, pieces and holes that aren't real
    mask = voted > 0
    mask = clean(mask, evidence, settings)
    mask = refine_outline(mask, image, model.mean, model.known, model.sigma, *light, settings.outline_contrast)
    if region is not None:
        mask &= region
    return mask.astype(np.uint8) * np.uint8(255)


def pixel_evidence(
    image: np.ndarray,
    model: BackgroundModel,
    settings: SilhouetteSettings,
    light: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return each pixel's own evidence for the subject, (H, W) float32, log likelihood ratio."""
    evidence = background_evidence(
        image,
        model.mean,
        model.sigma,
        model.known,
        *light,
        np.float32(settings.threshold),
        np.float32(settings.unknown),
    )
    if settings.shadows:
        evidence = shadow_evidence(
            evidence,
            image,
            model.mean,
            model.sigma,
            model.known,
            *light,
            settings.shadow_radius,
            settings.shadow_darkest,
            settings.shadow_lightest,
            settings.shadow_color,
        )
    if settings.colors:
        color_evidence(evidence, image, np.float32(DOUBTFUL), np.float32(LIMIT))
    return evidence


def clean(mask: np.ndarray, evidence: np.ndarray, settings: SilhouetteSettings) -> np.ndarray:
    """Fill enclosed holes and drop separate pieces whose evidence is weak for the length of their border.

    The rule of a Potts model for whole regions: a region's own evidence must pay for its border. Size thresholds for
    pieces come on top.

    Parameters
    ----------
    mask : (H, W) bool
    evidence : (H, W) float32
        Of each pixel itself.
    settings : SilhouetteSettings

    Returns
    -------
    (H, W) bool
    """
    x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
    part = slice(max(0, y - 1), y + h + 1), slice(max(0, x - 1), x + w + 1)
    inner = np.ascontiguousarray(evidence[part])

    # Holes: regions of background that don't reach the border (of the image, or of what surrounds the subject)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~mask[part]).astype(np.uint8), connectivity=4)
    total, border = region_sums(labels, inner, count)
    h, w = labels.shape
    x, y, width, height, _ = stats.T
    weak = (x > 0) & (y > 0) & (x + width < w) & (y + height < h) & (-total < settings.coherence * border)
    weak[0] = True

    # Pieces
    count, labels, stats, _ = cv2.connectedComponentsWithStats(weak[labels].astype(np.uint8), connectivity=8)
    total, border = region_sums(labels, inner, count)
    areas = stats[:, cv2.CC_STAT_AREA]
    least = max(settings.smallest * mask.size, settings.smallest_relative * float(areas[1:].max(initial=0)))
    keep = (areas >= least) & (total > settings.coherence * border)
    keep[0] = False
    result = np.zeros_like(mask)
    result[part] = keep[labels]
    return result


@njit(cache=True, nogil=True)
def region_sums(labels, evidence, count):
    """Sum the evidence of labelled regions and count the pairs of neighbouring pixels across their borders.

    Parameters
    ----------
    labels : (H, W) int32
    evidence : (H, W) float32
    count : int
        Number of labels.

    Returns
    -------
    total, border : (count,) float64
    """
    h, w = labels.shape
    total, border = np.zeros(count), np.zeros(count)
    for y in range(h):
        for x in range(w):
            k = labels[y, x]
            total[k] += evidence[y, x]
            if x + 1 < w and labels[y, x + 1] != k:
                border[k] += 1
                border[labels[y, x + 1]] += 1
            if y + 1 < h and labels[y + 1, x] != k:
                border[k] += 1
                border[labels[y + 1, x]] += 1
    return total, border


def coverage(mask: np.ndarray, region: np.ndarray | None = None) -> float:
    """Return the fraction of the image (or of the region) that a silhouette covers: 0 empty, 1 full."""
    if region is not None:
        mask = mask[region]
    return float(np.count_nonzero(mask)) / max(1.0, float(mask.size))
