"""Silhouettes of a whole sequence, to ask them where the subject can't be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError


@dataclass(frozen=True)
class Outlines:
    """Silhouettes of C pinhole cameras in K of a sequence's frames.

    Attributes
    ----------
    frames : (K,) int
    projections : (C, 3, 4) float
        World metres to array indices (COLMAP pixel minus 0.5).
    empty : (K, C, H, W) uint8
        1 where the subject is not: seen by the real image, and outside of its silhouette.

    Raises
    ------
    GeometryError
        If the arrays don't belong together.
    """

    frames: np.ndarray
    projections: np.ndarray
    empty: np.ndarray

    def __post_init__(self) -> None:
        K, C = len(self.frames), len(self.projections)
        if self.empty.ndim != 4 or self.empty.shape[:2] != (K, C) or self.projections.shape != (C, 3, 4):
            raise GeometryError(
                f"outlines: {K} frames, projections {self.projections.shape}, images {self.empty.shape}; "
                "expected one image (H, W) for each frame and camera"
            )
        object.__setattr__(self, "empty", np.ascontiguousarray(self.empty, np.uint8))

    def check_frames(self, count: int) -> None:
        """Raise GeometryError unless all frames are among the `count` of a sequence."""
        if len(self.frames) and not (0 <= np.min(self.frames) and np.max(self.frames) < count):
            raise GeometryError(
                f"outlines: frames {np.min(self.frames)} to {np.max(self.frames)}, but the paths have {count}; "
                "number them from the paths' first frame"
            )
