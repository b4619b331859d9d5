"""A textured ellipsoid that moves as told, seen by pinhole cameras: images by ray casting, everything known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.carving.silhouette_views import PinholeViews
from geomocap.model.frame_geometry import Voxels
from geomocap.patches.frame_views import FrameViews

RADII = np.array([0.20, 0.16, 0.25])
VOXEL = 0.01


@dataclass(frozen=True)
class MovingEllipsoid:
    """The scene: `world = turn(k) body + place(k)`."""

    n_cameras: int = 6
    shift: tuple[float, float, float] = (0.02, -0.008, 0.005)
    turn_deg: tuple[float, float, float] = (1.0, -1.5, 4.0)
    distance: float = 1.0
    width: int = 160
    height: int = 120
    focal: float = 260.0
    texture: float = 60.0  # waves a metre × 2π

    def pose(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return rotation (3, 3) and translation (3,) of a frame."""
        turn = Rotation.from_rotvec(np.radians(self.turn_deg) * frame).as_matrix()
        return turn, np.array(self.shift) * frame

    def projections(self) -> np.ndarray:
        """Cameras on a circle, looking slightly down at the middle: (C, 3, 4), COLMAP pixels."""
        out = []
        for angle in np.arange(self.n_cameras) * 2 * np.pi / self.n_cameras:
            center = self.distance * np.array([np.cos(angle), np.sin(angle), 0.3])
            forward = -center / np.linalg.norm(center)
            right = np.cross(forward, [0, 0, 1])
            right /= np.linalg.norm(right)
            R = np.stack([right, np.cross(forward, right), forward])
            K = np.array([[self.focal, 0, self.width / 2], [0, self.focal, self.height / 2], [0, 0, 1]])
            out.append(K @ np.c_[R, -R @ center])
        return np.array(out)

    def grey(self, body: np.ndarray) -> np.ndarray:
        """Grey level of the solid texture at body points (…, 3)."""
        rng = np.random.default_rng(3)
        waves, phases = rng.normal(0, self.texture, (40, 3)), rng.uniform(0, 2 * np.pi, 40)
        return 128 + 60 * np.sin(body @ waves.T + phases).sum(axis=-1) / np.sqrt(20)

    def images(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return images (C, H, W, 3) uint8 and masks (C, H, W) uint8."""
        turn, place = self.pose(frame)
        images = np.full((self.n_cameras, self.height, self.width, 3), 40, np.uint8)
        masks = np.zeros((self.n_cameras, self.height, self.width), np.uint8)
        v, u = np.mgrid[: self.height, : self.width] + 0.5
        pixel = np.stack([u, v, np.ones_like(u)], axis=-1)
        for c, P in enumerate(self.projections()):
            center = -np.linalg.solve(P[:, :3], P[:, 3])
            ray = pixel @ np.linalg.inv(P[:, :3]).T @ turn / RADII
            start = (center - place) @ turn / RADII
            a, b, d = (ray**2).sum(-1), ray @ start, start @ start - 1
            root = b * b - a * d
            hit = root > 0
            depth = (-b - np.sqrt(np.where(hit, root, 0))) / a
            body = (start + depth[..., None] * ray) * RADII
            value = np.clip(np.rint(self.grey(body)), 0, 255).astype(np.uint8)
            images[c][hit] = value[hit][:, None]
            masks[c][hit] = 1
        return images, masks

    def voxels(self, frame: int) -> Voxels:
        """Surface voxels."""
        turn, place = self.pose(frame)
        reach = np.ceil(RADII.max() / VOXEL).astype(int) + 1
        grid = np.stack(np.meshgrid(*[np.arange(-reach, reach)] * 3, indexing="ij"), axis=-1)
        low = np.floor(place / VOXEL) * VOXEL
        body = (low + (grid + 0.5) * VOXEL - place) @ turn / RADII
        full = (body**2).sum(-1) < 1
        inner = full.copy()
        for axis in range(3):
            inner &= np.roll(full, 1, axis) & np.roll(full, -1, axis)
        indices = grid[full & ~inner].astype(np.int32) + reach
        return Voxels(indices, np.zeros((len(indices), 3), np.uint8), low - reach * VOXEL, VOXEL)

    def view(self, frame: int) -> FrameViews:
        """Return a frame, ready for tracking."""
        images, masks = self.images(frame)
        return FrameViews.of(PinholeViews.of(self.projections(), masks), images, self.voxels(frame))

    def surface_distance(self, points: np.ndarray, frame: int) -> np.ndarray:
        """Distance of world points (N, 3) from the surface along the radius, metres."""
        turn, place = self.pose(frame)
        body = (points - place) @ turn
        return np.abs(1 - 1 / np.linalg.norm(body / RADII, axis=1)) * np.linalg.norm(body, axis=1)
