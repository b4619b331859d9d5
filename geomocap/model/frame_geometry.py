"""Frame geometry as Open3D holds it, and as the arrays that numeric code works on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import open3d as o3d

from geomocap.errors import GeometryError
from geomocap.model.palette import body_colors

GREY = 150


class Geometry(Protocol):
    """A sequence of point sets, wherever they come from."""

    @property
    def spacing(self) -> float:
        """Distance of neighbouring points, metres."""
        ...

    @property
    def features(self) -> Callable[[int], np.ndarray] | None:
        """`features(frame) -> (N, F)`: what else is known of the points, such as colours from 0 to 1; None: nothing."""
        ...

    @property
    def normals(self) -> Callable[[int], np.ndarray] | None:
        """`normals(frame) -> (N, 3)`: outward unit normals of the points, 0 where unknown; None: there are none."""
        ...

    def __len__(self) -> int: ...

    def points(self, frame: int) -> np.ndarray:
        """Points of one frame, (N, 3) float, metres, world."""
        ...


@dataclass(frozen=True)
class GeometryPart:
    """Some frames of a sequence, numbered from its first."""

    whole: Geometry
    part: range

    @property
    def spacing(self) -> float:
        """Distance of neighbouring points, metres."""
        return self.whole.spacing

    @property
    def features(self) -> Callable[[int], np.ndarray] | None:
        """What else is known of the points, see `Geometry`."""
        known = self.whole.features
        return None if known is None else lambda frame: known(self.part[frame])

    @property
    def normals(self) -> Callable[[int], np.ndarray] | None:
        """Outward unit normals of the points, see `Geometry`."""
        known = self.whole.normals
        return None if known is None else lambda frame: known(self.part[frame])

    def __len__(self) -> int:
        return len(self.part)

    def points(self, frame: int) -> np.ndarray:
        """Points of one frame, (N, 3) float, metres, world."""
        return self.whole.points(self.part[frame])


@dataclass(frozen=True)
class Voxels:
    """Surface voxels of one frame.

    Attributes
    ----------
    indices : (N, 3) int32
        Grid indices, x, y, z, of the voxels.
    colors : (N, 3) uint8, RGB
    origin : (3,) float
        Corner of voxel (0, 0, 0) with the lowest coordinates, metres, world.
    voxel_size : float
        Edge of a voxel, metres.
    """

    indices: np.ndarray
    colors: np.ndarray
    origin: np.ndarray
    voxel_size: float

    @property
    def points(self) -> np.ndarray:
        """Voxel centres, (N, 3) float, metres, world."""
        return np.asarray(self.origin) + (self.indices + 0.5) * self.voxel_size

    def to_open3d(self) -> o3d.geometry.VoxelGrid:
        """Return the Open3D voxel grid; its voxels come in Open3D's own order."""
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.points))
        cloud.colors = o3d.utility.Vector3dVector(self.colors / 255.0)
        low = np.asarray(self.origin, float)
        top = self.indices.max(axis=0, initial=0) + 1
        high = low + top * self.voxel_size
        return o3d.geometry.VoxelGrid.create_from_point_cloud_within_bounds(cloud, self.voxel_size, low, high)

    @classmethod
    def from_open3d(cls, grid: o3d.geometry.VoxelGrid) -> Voxels:
        """Take over an Open3D voxel grid, voxels sorted by x, y, z index so that results repeat."""
        voxels = grid.get_voxels()
        indices = np.array([v.grid_index for v in voxels], dtype=np.int32).reshape(-1, 3)
        colors = np.array([v.color for v in voxels]).reshape(-1, 3)
        colors = np.clip(np.rint(colors * 255), 0, 255).astype(np.uint8)
        return cls.sorted(indices, colors, np.array(grid.origin), float(grid.voxel_size))

    @classmethod
    def sorted(cls, indices: np.ndarray, colors: np.ndarray, origin: np.ndarray, voxel_size: float) -> Voxels:
        """Return voxels sorted by x, y, z index."""
        order = _order(indices)
        return cls(indices[order], colors[order], origin, voxel_size)


def _order(indices: np.ndarray) -> np.ndarray:
    """Order (N,) of grid indices (N, 3) by x, y, z; those that are there more than once stay in their own order."""
    low = indices.min(axis=0, initial=0)
    if np.subtract(indices.max(axis=0, initial=0), low, dtype=np.int64).max() > np.iinfo(np.uint16).max:
        return np.lexsort(indices.T[::-1])
    x, y, z = (indices - low).astype(np.uint16).T  # numbers as small as these NumPy sorts by counting
    order = np.argsort(z, kind="stable")
    for axis in (y, x):
        order = order[np.argsort(axis[order], kind="stable")]
    return order


@dataclass(frozen=True)
class BodyPoints:
    """Points of one frame and the rigid bodies that they belong to.

    Attributes
    ----------
    positions : (N, 3) float, metres, world
    body : (N,) int
        Body of each point, -1: none.
    colors : (N, 3) uint8, RGB, optional
    normals : (N, 3) float, optional
    """

    positions: np.ndarray
    body: np.ndarray
    colors: np.ndarray | None = None
    normals: np.ndarray | None = None

    def __post_init__(self) -> None:
        count = len(self.positions)
        expected = {"positions": (count, 3), "body": (count,), "colors": (count, 3), "normals": (count, 3)}
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise GeometryError(f"points: {name} of shape {array.shape}, expected {shape}")

    @property
    def shown_colors(self) -> np.ndarray:
        """Colours, (N, 3) uint8, RGB; grey where none are known."""
        return np.full(self.positions.shape, GREY, np.uint8) if self.colors is None else self.colors

    @property
    def finite(self) -> BodyPoints:
        """Those of the points that have a position."""
        keep = np.isfinite(self.positions).all(axis=1)
        arrays = (self.positions, self.body, self.colors, self.normals)
        return BodyPoints(*(None if a is None else a[keep] for a in arrays))  # type: ignore[arg-type]

    def to_open3d(self) -> o3d.t.geometry.PointCloud:
        """Return the tensor point cloud with attributes `body` (int32) and `colors` (one a body)."""
        positions = o3d.core.Tensor(np.ascontiguousarray(self.positions, np.float32))  # type: ignore[call-overload]
        cloud = o3d.t.geometry.PointCloud(positions)
        cloud.point["body"] = np.ascontiguousarray(self.body, np.int32)[:, None]  # type: ignore[call-overload]
        cloud.point["colors"] = body_colors(self.body)  # type: ignore[call-overload]
        return cloud
