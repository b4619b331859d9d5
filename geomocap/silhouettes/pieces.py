"""Separate pieces and holes of a silhouette: which of them are real."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

COHERENCE = 3.0  # log odds that each pixel of border between subject and background costs
SMALLEST_RELATIVE = 0.02  # of the largest piece: smaller ones go


def clean(
    mask: np.ndarray, evidence: np.ndarray, alike: float, smallest: float, words: np.ndarray | None = None
) -> np.ndarray:
    """Fill enclosed holes and drop separate pieces whose evidence is weak for the length of their border.

    The rule of a Potts model for whole regions: a region's own evidence must pay for its border. Size thresholds for
    pieces come on top. A piece of which the other cameras deny every pixel goes, however sure its own camera is:
    something has changed where the subject can't be.

    Parameters
    ----------
    mask : (H, W) bool
    evidence : (H, W) float32
        Log odds of each pixel itself.
    alike : float
        How many neighbouring pixels fraction their noise: a region's evidence is worth that much less.
    smallest : float
        Smaller pieces go, fraction of the image.
    words : (H, W) float32, optional
        What the other cameras say, log odds.

    Returns
    -------
    (H, W) bool
    """
    cost = COHERENCE * np.sqrt(
        alike
    )  # regions of so many pixels have 1 / alike of the evidence, but 1 / sqrt(alike) of the border
    x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
    part = slice(max(0, y - 1), y + h + 1), slice(max(0, x - 1), x + w + 1)
    inner = np.ascontiguousarray(evidence[part])

    # Holes: regions of background that don't reach the border (of the image, or of what surrounds the subject)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~mask[part]).astype(np.uint8), connectivity=4)
    total, border = region_sums(labels, inner, count)
    h, w = labels.shape
    x, y, width, height, _ = stats.T
    weak = (x > 0) & (y > 0) & (x + width < w) & (y + height < h) & (-total < cost * border)
    weak[0] = True

    # Pieces
    count, labels, stats, _ = cv2.connectedComponentsWithStats(weak[labels].astype(np.uint8), connectivity=8)
    total, border = region_sums(labels, inner, count)
    areas = stats[:, cv2.CC_STAT_AREA]
    least = max(smallest * mask.size, SMALLEST_RELATIVE * float(areas[1:].max(initial=0)))
    keep = (areas >= least) & (total > cost * border)
    keep[0] = False
    if words is not None:
        keep &= said_of(labels, np.ascontiguousarray(words[part]), count)
    result = np.zeros_like(mask)
    result[part] = keep[labels]
    return result


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def said_of(labels, words, count):
    """Whether the other cameras say of any pixel of a labelled region that it may be subject, (count,) bool."""
    h, w = labels.shape
    result = np.zeros(count, np.bool_)
    for y in range(h):
        for x in range(w):
            if words[y, x] >= 0.0:
                result[labels[y, x]] = True
    return result
