"""What the cameras saw: up to a few candidate targets per image, not yet told apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import CalibrationError


@dataclass(frozen=True)
class TargetObservations:
    """Candidate targets in the images of a bar recording.

    Attributes
    ----------
    cameras : tuple of C str
    sizes : (C, 2) int
        Image sizes, pixels.
    frames : (T,) int
        Frame numbers, the same for all cameras.
    pixels : (C, T, K, 2) float
        COLMAP pixels, best candidate first, NaN where there are fewer than K.
    sigmas : (C, T, K) float
        Standard deviation of a coordinate, pixels.
    radii : (C, T, K) float
        Radius of the target in the image, pixels; 0 where it has none (a corner).
    """

    cameras: tuple[str, ...]
    sizes: np.ndarray
    frames: np.ndarray
    pixels: np.ndarray
    sigmas: np.ndarray
    radii: np.ndarray

    def __post_init__(self) -> None:
        shape = self.pixels.shape[:3]
        if len(self.cameras) < 2:
            raise CalibrationError(f"a bar calibration needs two cameras at least, got {len(self.cameras)}")
        if shape[:2] != (len(self.cameras), len(self.frames)) or self.sigmas.shape != shape:
            raise CalibrationError(f"observations of {len(self.cameras)} cameras have the shape {shape}")

    @property
    def counts(self) -> np.ndarray:
        """Number of candidates, (C, T) int."""
        return np.isfinite(self.pixels[..., 0]).sum(axis=2)

    def at(self, keep: np.ndarray) -> TargetObservations:
        """Return the frames (T,) bool or int that are wanted."""
        return TargetObservations(
            self.cameras, self.sizes, self.frames[keep], self.pixels[:, keep], self.sigmas[:, keep], self.radii[:, keep]
        )


def stack_candidates(
    cameras: tuple[str, ...],
    sizes: np.ndarray,
    frames: np.ndarray,
    found: dict[tuple[int, int], np.ndarray],
) -> TargetObservations:
    """Bring candidates of single images into arrays.

    Parameters
    ----------
    found : dict of (camera index, frame index) to (n, 4) float
        x, y, standard deviation, radius of each candidate, best first.
    """
    K = max([2, *(len(f) for f in found.values())])
    values = np.full((len(cameras), len(frames), K, 4), np.nan)
    for (c, t), candidates in found.items():
        values[c, t, : len(candidates)] = candidates
    return TargetObservations(
        cameras, np.asarray(sizes), np.asarray(frames), values[..., :2], values[..., 2], values[..., 3]
    )
