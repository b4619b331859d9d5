"""Angles over time, with their names and uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError


@dataclass(frozen=True)
class AngleSet:
    """K angles over T frames.

    Attributes
    ----------
    names : tuple of str
        As `knee_left_flexion`.
    values : (T, K) float, degrees
        They run on over time without jumps; NaN in gaps.
    std : (T, K) float, degrees
        Standard deviation from the scatter of the surface; NaN where it isn't known.
    fps : float
    """

    names: tuple[str, ...]
    values: np.ndarray
    std: np.ndarray
    fps: float

    def __post_init__(self) -> None:
        shape = (len(self.values), len(self.names))
        if self.values.shape != shape or self.std.shape != shape:
            raise GeometryError(f"{len(self.names)} angles of shapes {self.values.shape} and {self.std.shape}")

    def column(self, name: str) -> np.ndarray:
        """Values of one angle, (T,) degrees."""
        return self.values[:, self.names.index(name)]
