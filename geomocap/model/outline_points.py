"""Points along the silhouettes of a sequence, and which way the subject ends there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

_SMOOTH = 2.0  # pixels over which the direction of an outline is averaged
_SHORTEST = 12  # pixels around; shorter outlines are specks
_CLEAR = 0.05  # slope of the smoothed silhouette from which it has a direction
_BORDER = 3  # pixels from where an image ends


@dataclass(frozen=True)
class OutlinePoints:
    """Points on the outlines in T frames of C pinhole cameras.

    Attributes
    ----------
    projections : (C, 3, 4) float
        World metres to array indices (COLMAP pixel minus 0.5) of the images that the outlines were taken from.
    points : sequence of T sequences of C arrays (M, 4) float32
        Place (x, y), and the direction out of the silhouette (unit); none where a camera sees no outline.
    """

    projections: np.ndarray
    points: Sequence[Sequence[np.ndarray]]

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.points)

    @property
    def centers(self) -> np.ndarray:
        """Centres of the cameras, (C, 3), metres, world."""
        return -np.linalg.solve(self.projections[:, :, :3], self.projections[:, :, 3:])[:, :, 0]


def outline_points(mask: np.ndarray, valid: np.ndarray, step: int) -> np.ndarray:
    """Points along the outlines of a silhouette, holes included, every `step` pixels: (M, 4), see `OutlinePoints`.

    Parameters
    ----------
    mask, valid : (H, W) float32
        Fraction of each pixel that is the subject's, and that the real image sees; no outline is where it ends.
    step : int
    """
    inside = (mask >= 0.5).astype(np.uint8)
    around = cv2.findContours(inside, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
    pieces = [c[::step, 0] for c in around if len(c) >= _SHORTEST]
    if not pieces:
        return np.zeros((0, 4), np.float32)
    place = np.concatenate(pieces)
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _SMOOTH)
    x, y = place.T
    slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, *axes)[y, x] for axes in ((1, 0), (0, 1))], axis=1)
    length = np.linalg.norm(slope, axis=1)
    beyond = np.ones((2 * _BORDER + 1,) * 2, np.uint8)
    seen = cv2.erode((valid == 1).astype(np.uint8), beyond, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    clear = (length > _CLEAR) & (seen[y, x] > 0)
    outward = -slope[clear] / length[clear, None]
    # pixels of the contour are the subject's: it ends half a pixel further out
    return np.hstack([place[clear] + 0.5 * outward, outward]).astype(np.float32)
