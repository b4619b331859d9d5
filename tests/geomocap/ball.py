"""A textured ball seen by cameras around it: images by exact ray casting of a band-limited texture, truth for free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from geomocap.model.rig import Rig

RADIUS = 0.45
WIDTH, HEIGHT = 288, 224


def ring(count: int, arc_deg: float, distance: float = 2.0, distortion: float = 0.0, seed: int = 0) -> Rig:
    """Cameras on an arc around the origin, looking at it, a little up and down in turn."""
    cameras, poses = [], []
    for c in range(count):
        step = arc_deg / count if arc_deg >= 360 else arc_deg / max(count - 1, 1)
        angle = np.radians(c * step - (0 if arc_deg >= 360 else arc_deg / 2))
        eye = distance * np.array([np.sin(angle), -np.cos(angle), 0.1 * (-1) ** c])
        z = -eye / np.linalg.norm(eye)
        x = np.cross([0, 0, -1.0], z)
        x /= np.linalg.norm(x)
        R = np.array([x, np.cross(z, x), z])
        poses.append(np.column_stack([R, -R @ eye]))
        params = [420.0, 421.0, WIDTH / 2 + 1, HEIGHT / 2 - 2, distortion, 0.0, 0.0, 0.0]
        cameras.append(pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params))
    return Rig(tuple(f"cam{c}" for c in range(count)), tuple(cameras), np.array(poses))


@dataclass(frozen=True)
class Texture:
    """A sum of plane waves in space: grey = 128 + Σ a cos(k · X + φ)."""

    waves: np.ndarray
    phases: np.ndarray
    contrast: float

    @classmethod
    def random(cls, contrast: float = 40.0, seed: int = 0, count: int = 80) -> Texture:
        """Waves of all directions, 20 to 50 mm long: four to ten pixels."""
        rng = np.random.default_rng(seed)
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = rng.uniform(0.02, 0.05, (count, 1))
        return cls(2 * np.pi * direction / length, rng.uniform(0, 2 * np.pi, count), contrast)

    @classmethod
    def stripes(cls, contrast: float = 40.0, length: float = 0.06) -> Texture:
        """Return one pattern again and again along x and z."""
        return cls(2 * np.pi / length * np.array([[1.0, 0, 0], [0, 0, 1.0]]), np.zeros(2), contrast)

    def at(self, points: np.ndarray) -> np.ndarray:
        """Grey levels at points (N, 3)."""
        amplitude = self.contrast * np.sqrt(2 / len(self.phases))
        return 128 + amplitude * np.cos(points @ self.waves.T + self.phases).sum(axis=1)


def photograph(
    rig: Rig, texture: Texture, noise: float = 1.0, gains: np.ndarray | None = None, seed: int = 5
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Images (H, W, 3) uint8 and silhouettes (H, W) bool of the ball, in front of a smooth wall."""
    images, masks = [], []
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for c in range(len(rig)):
        origin, d = rig.rays(c, np.column_stack([x.ravel(), y.ravel()]))
        b = d @ origin
        root = b * b - (origin @ origin - RADIUS**2)
        hit = root > 0
        grey = 60 + 30 * d[:, 2]
        points = origin + d[hit] * (-b[hit] - np.sqrt(root[hit]))[:, None]
        grey[hit] = texture.at(points)
        grey *= 1.0 if gains is None else gains[c]
        grey += np.random.default_rng(seed + c).normal(0, noise, len(grey))
        image = np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH)
        images.append(np.repeat(image[..., None], 3, axis=2))
        masks.append(hit.reshape(HEIGHT, WIDTH))
    return images, masks


def off_surface(points: np.ndarray) -> np.ndarray:
    """Distances of points (N, 3) from the ball's surface, metres."""
    return np.abs(np.linalg.norm(points, axis=1) - RADIUS)


def surface_points(count: int = 4000) -> np.ndarray:
    """Points (N, 3) evenly over the ball."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z * z)
    return RADIUS * np.column_stack([flat * np.cos(angle), flat * np.sin(angle), z])


def cosines(rig: Rig, points: np.ndarray) -> np.ndarray:
    """Cosines of the angles of incidence of all cameras at surface points, (C, N)."""
    rays = rig.centers[:, None] - points
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return np.einsum("cni,ni->cn", rays, points / RADIUS)
