"""Places of which a recording without an empty frame doesn't tell whether they are background.

A subject that stays in its place hides what is behind its middle in all frames. There nothing changes, as nothing does
where the background is always seen; but around the subject's middle its outline moves. So what doesn't change is
background where it goes on to the border of the image; what is enclosed by what changes in half of the frames or so
may be either, and its colours and the other cameras have to tell. What an animal runs around now and then isn't
enclosed.
"""

from __future__ import annotations

import cv2
import numpy as np

# Fractions of the frames. An outline that moves about its middle covers it in half of the frames or so. With up to 0.9
# what is seen between legs is enclosed, too: a plain man's silhouettes overlapped with the true ones by 0.85 instead of
# 0.92, and of a real mouse's first camera 7 % were unknown instead of 3.
LEVELS = np.arange(6, 15) / 20
_MEDIAN = 5  # pixels along its side; smaller changes are noise
_OPENED = 2  # radius, pixels: thinner ways to the border are none; settled by eye and overlap on six captures


def enclosed(mean: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """Find what changes less than all that is around it, (H, W) bool.

    What changes as little as that, and lies on no way to the border of the image that changes as little, is enclosed,
    for any fraction of the frames. So is what is between it and the background as far as it looks like it (watershed of
    the gradient: Meyer, Topographic distance and watershed lines, Signal Processing 38, 1994).

    Parameters
    ----------
    mean : (H, W, 3) float32
        Colour that is seen most, grey levels.
    changed : (T, H, W) uint8
        1 where a frame shows another colour; specks are taken for noise.
    """
    support = 1.0 - np.mean([cv2.medianBlur(frame, _MEDIAN) for frame in changed], axis=0)
    smooth = cv2.GaussianBlur(mean.clip(0, 255).astype(np.uint8), (0, 0), 1.0)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _OPENED + 1, 2 * _OPENED + 1))
    result = np.zeros(support.shape, bool)
    for level in LEVELS:
        still = (support >= level).astype(np.uint8)
        still = np.asarray(cv2.morphologyEx(still, cv2.MORPH_OPEN, kernel))
        count, pieces = cv2.connectedComponents(still, connectivity=4)
        island = np.ones(count, bool)
        island[np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]])] = False
        island[0] = False
        if not island.any():
            continue
        markers = np.where(island[pieces], 2, still).astype(np.int32)
        cv2.watershed(smooth, markers)
        found = cv2.dilate((markers == 2).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        result |= found & (markers != 1)
    return result
