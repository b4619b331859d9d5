"""The block of voxels that is carved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError


@dataclass(frozen=True)
class Grid:
    """A block of cubic voxels, axes parallel to the world's.

    Attributes
    ----------
    origin : (3,) float
        Corner of voxel (0, 0, 0) with the lowest coordinates, metres, world.
    voxel_size : float
        Edge of a voxel, metres.
    shape : (X, Y, Z) int
        Number of voxels along each axis.
    """

    origin: np.ndarray
    voxel_size: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        origin = np.array(self.origin, dtype=np.float64)
        shape = tuple(int(n) for n in self.shape)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise GeometryError(f"the grid's origin must be three finite numbers, got {self.origin}")
        if not (np.isfinite(self.voxel_size) and self.voxel_size > 0):
            raise GeometryError(f"the grid's voxel size must be above 0 m, got {self.voxel_size}")
        if len(shape) != 3 or min(shape) < 1:
            raise GeometryError(f"the grid needs at least one voxel along each axis, got {self.shape}")
        origin.flags.writeable = False
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "voxel_size", float(self.voxel_size))
        object.__setattr__(self, "shape", shape)

    @classmethod
    def of_box(
        cls, low: np.ndarray, high: np.ndarray, *, resolution: int | None = None, voxel_size: float | None = None
    ) -> Grid:
        """Cover a box with cubic voxels.

        Parameters
        ----------
        low, high : (3,) float
            Corners of the box, metres, world. Where the box is no multiple of a voxel, the grid stands out evenly on
            both sides.
        resolution : int, optional
            Number of voxels along the longest side.
        voxel_size : float, optional
            Edge of a voxel, metres; then `resolution` is not looked at. One of them has to be given.

        Raises
        ------
        GeometryError
            If the box is empty.
        ValueError
            If neither resolution nor voxel size is given.
        """
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        size = high - low
        if not (np.isfinite(size).all() and (size > 0).all()):
            raise GeometryError(f"the volume from {_show(low)} to {_show(high)} is empty: each max must exceed its min")
        if voxel_size is None:
            if resolution is None:
                raise ValueError("a grid needs a resolution or a voxel size")
            voxel_size = float(size.max()) / resolution
        edge = float(voxel_size)
        shape = np.maximum(np.ceil(size / edge - 1e-6), 1).astype(int)
        origin = (low + high) / 2 - shape * edge / 2
        return cls(origin, edge, (int(shape[0]), int(shape[1]), int(shape[2])))

    @property
    def low(self) -> np.ndarray:
        """Lowest corner, (3,) float, metres, world."""
        return self.origin

    @property
    def high(self) -> np.ndarray:
        """Highest corner, (3,) float, metres, world."""
        return self.origin + np.array(self.shape) * self.voxel_size

    def centers(self, indices: np.ndarray) -> np.ndarray:
        """World positions of voxel centres, metres, of indices (…, 3)."""
        return self.origin + (np.asarray(indices) + 0.5) * self.voxel_size

    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates of the voxel centres along x, y and z, metres, world."""
        x, y, z = (self.origin[a] + (np.arange(self.shape[a]) + 0.5) * self.voxel_size for a in range(3))
        return x, y, z


def _show(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in point) + ")"
