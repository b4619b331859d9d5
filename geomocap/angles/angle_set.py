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
    bodies : (K, 2) int
        The bodies whose turn against each other it is, the inner one first.
    """

    names: tuple[str, ...]
    values: np.ndarray
    std: np.ndarray
    fps: float
    bodies: np.ndarray

    def __post_init__(self) -> None:
        shape = (len(self.values), len(self.names))
        if self.values.shape != shape or self.std.shape != shape or self.bodies.shape != (len(self.names), 2):
            shapes = f"{self.values.shape}, {self.std.shape} and {self.bodies.shape}"
            raise GeometryError(f"{len(self.names)} angles of shapes {shapes}")

    def column(self, name: str) -> np.ndarray:
        """Values of one angle, (T,) degrees."""
        return self.values[:, self.names.index(name)]

    def of_joint(self, parent: int, child: int) -> list[int]:
        """Return the numbers of the angles that tell how a body sits on its parent, or on a part beyond that.

        The inner body of an anatomical angle may be the child: a tree needn't grow from the trunk.
        """
        near = [k for k, pair in enumerate(self.bodies.tolist()) if set(pair) == {parent, child}]
        return near or [k for k, (_, outer) in enumerate(self.bodies.tolist()) if outer == child]
