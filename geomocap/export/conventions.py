"""Axes and units of every motion format, in one place: what world coordinates become in each file.

A file's coordinates are `scale * file_from_world @ world`. All matrices are proper rotations, so left stays left.

| format  | up | unit | why |
|---------|----|------|-----|
| BVH     | y  | m (cm by option) | what BVH importers, Blender's among them, assume unless told otherwise |
| TRC     | y  | mm (m by option) | OpenSim's world; the unit stands in the header |
| C3D     | z  | mm   | laboratory systems; POINT:X_SCREEN and Y_SCREEN name the axes |
| GLB     | y  | m    | required by glTF 2.0, section 3.4 |
| USD     | y  | m    | stated by the stage's upAxis and metersPerUnit |
| CSV, Parquet | as the world | m | stated by the column names |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Axis = Literal["x", "y", "z"]
Unit = Literal["m", "cm", "mm"]

UNITS_PER_METRE: dict[str, float] = {"m": 1.0, "cm": 100.0, "mm": 1000.0}

# z-up to y-up turns by -90° about x, so that x stays x: (x, y, z) → (x, z, -y), as glTF exporters do.
_Y_FROM_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
# An x-up world is turned cyclically: (x, y, z) → (z, x, y) is y-up.
_Y_FROM_X = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_Y_FROM = {"x": _Y_FROM_X, "y": np.eye(3), "z": _Y_FROM_Z}


@dataclass(frozen=True)
class Convention:
    """Axes and unit of a file's coordinates.

    Attributes
    ----------
    up : "x", "y" or "z"
        The file's axis that points up.
    unit : "m", "cm" or "mm"
    """

    up: Axis
    unit: Unit

    @property
    def scale(self) -> float:
        """File units in a metre."""
        return UNITS_PER_METRE[self.unit]

    def points(self, world: np.ndarray, world_up: Axis) -> np.ndarray:
        """Convert world points or displacements, (..., 3) metres, into the file's axes and unit."""
        return self.scale * (world @ file_from_world(world_up, self.up).T)

    def rotations(self, world: np.ndarray, world_up: Axis) -> np.ndarray:
        """Convert rotations about world axes, (..., 3, 3), into rotations about the file's axes."""
        turn = file_from_world(world_up, self.up)
        return turn @ world @ turn.T

    def world_points(self, points: np.ndarray, world_up: Axis) -> np.ndarray:
        """Convert a file's points, (..., 3), back into world metres; the inverse of `points`."""
        return (points / self.scale) @ file_from_world(world_up, self.up)


def file_from_world(world_up: Axis, file_up: Axis) -> np.ndarray:
    """Return the rotation, (3, 3), that takes a world with axis `world_up` up to one with `file_up` up."""
    return _Y_FROM[file_up].T @ _Y_FROM[world_up]


BVH = Convention("y", "m")
TRC = Convention("y", "mm")
C3D = Convention("z", "mm")
GLB = Convention("y", "m")
USD = Convention("y", "m")
