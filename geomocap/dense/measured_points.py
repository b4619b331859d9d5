"""Measured points as arrays and as an Open3D point cloud."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import open3d as o3d


@dataclass(frozen=True)
class MeasuredPoints:
    """Points of a surface measurement.

    Attributes
    ----------
    positions : (N, 3) float, metres, world
    normals : (N, 3) float
        Unit vectors to the outside.
    colors : (N, 3) uint8, RGB
    sigma : (N,) float
        Standard deviation of the position (root of the sum of the three variances), metres.
    views : (N,) int
        Cameras that saw the point.
    correlation : (N,) float
        Mean correlation with the search images.
    template : (N,) int
        Number of the template camera.
    """

    positions: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    sigma: np.ndarray
    views: np.ndarray
    correlation: np.ndarray
    template: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def empty(cls) -> MeasuredPoints:
        """Return no points."""
        none, integers = np.zeros(0), np.zeros(0, np.int32)
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, integers, none, integers)

    @classmethod
    def join(cls, parts: list[MeasuredPoints]) -> MeasuredPoints:
        """Return the points of all parts, in order."""
        parts = parts or [cls.empty()]
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def select(self, which: np.ndarray) -> MeasuredPoints:
        """Return the points that `which` (mask or numbers) names."""
        return MeasuredPoints(*(getattr(self, f.name)[which] for f in fields(self)))

    def to_open3d(self) -> o3d.t.geometry.PointCloud:
        """Return an Open3D point cloud with attributes sigma (metres), views, correlation and template."""
        cloud = o3d.t.geometry.PointCloud()
        tensor = o3d.core.Tensor.from_numpy
        cloud.point.positions = tensor(np.ascontiguousarray(self.positions, dtype=np.float32))
        cloud.point.normals = tensor(np.ascontiguousarray(self.normals, dtype=np.float32))
        cloud.point.colors = tensor(np.ascontiguousarray(self.colors, dtype=np.uint8))
        for name in ("sigma", "correlation"):
            cloud.point[name] = tensor(np.ascontiguousarray(getattr(self, name), dtype=np.float32)[:, None])
        for name in ("views", "template"):
            cloud.point[name] = tensor(np.ascontiguousarray(getattr(self, name), dtype=np.int32)[:, None])
        return cloud
