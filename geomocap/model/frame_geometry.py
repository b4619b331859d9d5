"""Frame geometry as Open3D holds it, and as the arrays that numeric code works on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import open3d as o3d

from geomocap.errors import GeometryError
from geomocap.files.atomic import write_atomic
from geomocap.files.open3d_geometry import read_by_open3d
from geomocap.model.palette import body_colors


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

    def __len__(self) -> int: ...

    def points(self, frame: int) -> np.ndarray:
        """Points of one frame, (N, 3) float, metres, world."""
        ...


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
        return cls._sorted(indices, colors, np.array(grid.origin), float(grid.voxel_size))

    @classmethod
    def _sorted(cls, indices: np.ndarray, colors: np.ndarray, origin: np.ndarray, voxel_size: float) -> Voxels:
        order = np.lexsort(indices.T[::-1])
        return cls(indices[order], colors[order], origin, voxel_size)

    def write(self, path: Path) -> None:
        """Write as PLY, whole or not at all."""
        grid = self.to_open3d()
        write_atomic(path, lambda p: o3d.io.write_voxel_grid(p, grid))

    @classmethod
    def read(cls, path: Path) -> Voxels:
        """Read a voxel grid's PLY.

        Raises
        ------
        GeometryError
            If the file is missing or holds no voxels.
        """
        if not path.is_file():
            raise GeometryError(f"{path}: no such voxel grid")
        voxels = _read_binary(path)
        if voxels is not None:
            return cls._sorted(*voxels)
        grid = read_by_open3d(o3d.io.read_voxel_grid, path)
        if not grid.has_voxels():
            raise GeometryError(f"{path}: no readable voxel grid; make it again")
        return cls.from_open3d(grid)


@dataclass(frozen=True)
class BodyPoints:
    """Points of one frame and the rigid bodies that they belong to.

    Attributes
    ----------
    positions : (N, 3) float, metres, world
    body : (N,) int
        Body of each point, -1: none.
    """

    positions: np.ndarray
    body: np.ndarray

    def to_open3d(self) -> o3d.t.geometry.PointCloud:
        """Return the tensor point cloud with attributes `body` (int32) and `colors` (one a body)."""
        positions = o3d.core.Tensor(np.ascontiguousarray(self.positions, np.float32))  # type: ignore[call-overload]
        cloud = o3d.t.geometry.PointCloud(positions)
        cloud.point["body"] = np.ascontiguousarray(self.body, np.int32)[:, None]  # type: ignore[call-overload]
        cloud.point["colors"] = body_colors(self.body)  # type: ignore[call-overload]
        return cloud

    def write(self, path: Path) -> None:
        """Write as PLY, whole or not at all."""
        cloud = self.to_open3d()
        write_atomic(path, lambda p: o3d.t.io.write_point_cloud(p, cloud))

    @classmethod
    def read(cls, path: Path) -> BodyPoints:
        """Read points with their bodies.

        Raises
        ------
        GeometryError
            If the file is missing or has no attribute `body`.
        """
        if not path.is_file():
            raise GeometryError(f"{path}: no such point cloud")
        cloud = read_by_open3d(o3d.t.io.read_point_cloud, path)
        if "body" not in cloud.point:
            raise GeometryError(f"{path}: has no attribute `body`; delete it and run again")
        return cls(cloud.point.positions.numpy().astype(np.float64), cloud.point["body"].numpy().ravel())


def read_cloud(path: Path) -> np.ndarray:
    """Read the positions of a point cloud file, (N, 3) float, in the file's order.

    Raises
    ------
    GeometryError
        If the file is missing or holds no points.
    """
    if not path.is_file():
        raise GeometryError(f"{path}: no such point cloud")
    cloud = read_by_open3d(o3d.t.io.read_point_cloud, path)
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise GeometryError(f"{path}: holds no points; delete it and run again")
    return cloud.point.positions.numpy().astype(np.float64)


def read_cloud_colors(path: Path) -> np.ndarray:
    """Read the colours of a point cloud file, (N, 3) uint8, in the file's order.

    Raises
    ------
    GeometryError
        If the file is missing or its points have no colours.
    """
    if not path.is_file():
        raise GeometryError(f"{path}: no such point cloud")
    cloud = read_by_open3d(o3d.t.io.read_point_cloud, path)
    if "colors" not in cloud.point:
        raise GeometryError(f"{path}: its points have no colours; delete it and run again")
    return cloud.point.colors.numpy()


_HEADER = b"""ply
format binary_little_endian 1.0
comment Created by Open3D
element origin 1
property double x
property double y
property double z
element rotation 1
"""
_VOXEL = np.dtype([("index", "<f8", 3), ("color", "u1", 3)])


def _read_binary(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, float] | None:
    """Read a voxel grid as Open3D writes it, a hundred times faster than voxel by voxel; None if it is another kind."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    vertex = [line for line in lines if line.startswith("element vertex ")]
    properties = [line for line in lines[lines.index(vertex[0]) + 1 :]] if vertex else []
    if not data.startswith(_HEADER) or properties != [
        "property double x",
        "property double y",
        "property double z",
        "property uchar red",
        "property uchar green",
        "property uchar blue",
    ]:
        return None
    count = int(vertex[0].split()[-1])
    frame = np.frombuffer(body, "<f8", 13)  # origin, rotation, voxel size
    if len(body) != 13 * 8 + count * _VOXEL.itemsize or not np.array_equal(frame[3:12].reshape(3, 3), np.eye(3)):
        return None
    voxels = np.frombuffer(body, _VOXEL, count, 13 * 8)
    return voxels["index"].astype(np.int32), np.array(voxels["color"]), np.array(frame[:3]), float(frame[12])
