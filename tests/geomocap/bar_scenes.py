"""Small synthetic bar recordings with truth: cameras, bar positions, image points and images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.ndimage import gaussian_filter

from geomocap.cameras import Rig


@dataclass(frozen=True)
class Scene:
    """True cameras and bar ends.

    rig : true cameras; bars : (P, 2, 3) m; length : m; radius : of the balls, m
    """

    rig: Rig
    bars: np.ndarray
    length: float
    radius: float

    @property
    def extent(self) -> float:
        """Diagonal of the box around all bar ends, metres."""
        ends = self.bars.reshape(-1, 3)
        return float(np.linalg.norm(ends.max(axis=0) - ends.min(axis=0)))

    def visible(self) -> np.ndarray:
        """Which end is well inside which image, (C, P, 2) bool."""
        pixels = self.rig.project(self.bars.reshape(-1, 3))
        w, h = self.rig.sizes.T
        inside = (pixels > 4).all(axis=2) & (pixels[..., 0] < w[:, None] - 4) & (pixels[..., 1] < h[:, None] - 4)
        return inside.reshape(len(self.rig), -1, 2)

    def points(self, rng: np.random.Generator, noise: float) -> np.ndarray:
        """Observed ends (C, P, 2, 2), COLMAP pixels, NaN where not visible."""
        pixels = self.rig.project(self.bars.reshape(-1, 3)).reshape(len(self.rig), -1, 2, 2)
        pixels = pixels + rng.normal(0, noise, pixels.shape)
        pixels[~self.visible()] = np.nan
        return pixels


def look_at(center: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    x, y = np.cos(roll) * x + np.sin(roll) * y, -np.sin(roll) * x + np.cos(roll) * y
    R = np.array([x, y, z])
    return np.column_stack([R, -R @ center])


def random_camera(rng: np.random.Generator, size: tuple[int, int], focal: float) -> pycolmap.Camera:
    w, h = size
    f = focal * w * rng.uniform(0.94, 1.06)
    params = [
        f,
        f * rng.uniform(0.997, 1.003),
        w / 2 + rng.uniform(-0.02, 0.02) * w,
        h / 2 + rng.uniform(-0.02, 0.02) * w,
        rng.uniform(-0.22, -0.12),
        rng.uniform(0.03, 0.1),
        rng.uniform(-1e-3, 1e-3),
        rng.uniform(-1e-3, 1e-3),
    ]
    return pycolmap.Camera(model="OPENCV", width=w, height=h, params=params)


def three_cameras(seed: int, n_bars: int = 60) -> Scene:
    """Three cameras 640×480 in a triangle in front of a volume of 1.2 m."""
    rng = np.random.default_rng(seed)
    focal = rng.uniform(0.95, 1.4)
    distance = 2.15 * focal
    target = np.array([0.0, 0.0, 1.0])
    poses = []
    for azimuth, height in ((-32, 1.35), (0, 0.75), (30, 1.3)):
        a = np.deg2rad(azimuth + rng.uniform(-4, 4))
        c = np.array([distance * np.sin(a), -distance * np.cos(a), height]) + rng.normal(0, 0.05, 3)
        poses.append(look_at(c, target + rng.normal(0, 0.04, 3), rng.normal(0, 0.05)))
    cameras = tuple(random_camera(rng, (640, 480), focal) for _ in range(3))
    rig = Rig(("a", "b", "c"), cameras, np.array(poses))
    bars = random_bars(rng, rig, n_bars, 0.5, np.array([0.62, 0.5, 0.5]), target, needed=3)
    return Scene(rig, bars, 0.5, 0.02)


def eight_cameras(seed: int, n_bars: int = 60) -> Scene:
    """Eight cameras 320×240 around a volume of 2 m, every bar end in three of them at least."""
    rng = np.random.default_rng(seed)
    focal = rng.uniform(0.9, 1.2)
    distance = 3.4 * focal
    target = np.array([0.0, 0.0, 1.0])
    poses = []
    for k in range(8):
        a = np.deg2rad(45 * k + rng.uniform(-6, 6))
        c = np.array([distance * np.cos(a), distance * np.sin(a), 1.0 + (0.8 if k % 2 else 0.1) + rng.normal(0, 0.1)])
        poses.append(look_at(c, target + rng.normal(0, 0.05, 3), rng.normal(0, 0.05)))
    cameras = tuple(random_camera(rng, (320, 240), focal) for _ in range(8))
    rig = Rig(tuple(f"cam{k}" for k in range(8)), cameras, np.array(poses))
    bars = random_bars(rng, rig, n_bars, 0.7, np.array([1.1, 1.1, 0.9]), target, needed=3)
    return Scene(rig, bars, 0.7, 0.035)


def random_bars(
    rng: np.random.Generator,
    rig: Rig,
    count: int,
    length: float,
    half: np.ndarray,
    target: np.ndarray,
    needed: int,
) -> np.ndarray:
    bars: list[np.ndarray] = []
    while len(bars) < count:
        middle = target + rng.uniform(-half, half)
        d = rng.normal(size=3)
        d *= length / 2 / np.linalg.norm(d)
        bar = np.array([middle - d, middle + d])
        scene = Scene(rig, bar[None], length, 0.0)
        apart = np.linalg.norm(np.diff(rig.project(bar), axis=1), axis=2).min()
        if scene.visible().all(axis=2).sum() >= needed and apart > 12:
            bars.append(bar)
    return np.array(bars)


def render(scene: Scene, frame: int, camera: int, rng: np.random.Generator, noise: float = 1.5) -> np.ndarray:
    """Draw the two balls of a bar as the camera sees them: area-sampled discs, Gaussian blur, noise.

    Returns (H, W, 3) uint8.
    """
    w, h = scene.rig.sizes[camera]
    image = np.full((h, w), 30.0)
    image += 12 * np.sin(np.arange(w) / 17.0) + 8 * np.cos(np.arange(h) / 23.0)[:, None]
    center_world = scene.rig.centers[camera]
    blur = 0.6
    for end in scene.bars[frame]:
        pixel = scene.rig.project(end[None])[camera, 0]
        distance = np.linalg.norm(end - center_world)
        reach = int(np.ceil(1.3 * scene.radius / distance * scene.rig.cameras[camera].focal_length_x + 5))
        x0, y0 = int(pixel[0]) - reach, int(pixel[1]) - reach
        if np.isnan(pixel).any() or x0 < 0 or y0 < 0 or x0 + 2 * reach + 1 > w or y0 + 2 * reach + 1 > h:
            continue
        # Share of each small square inside the outline, from its distance to it; then blur, then area means
        n, sub = 2 * reach + 1, 4
        g = (np.arange(n * sub) + 0.5) / sub
        grid = np.stack(np.meshgrid(x0 + g, y0 + g), axis=-1).reshape(-1, 2)
        _, rays = scene.rig.rays(camera, grid)
        angle = np.arccos(np.minimum(rays @ ((end - center_world) / distance), 1.0))
        limit = np.arcsin(scene.radius / distance)
        scale = scene.rig.cameras[camera].focal_length_x * sub
        disc = np.clip(0.5 + (limit - angle) * scale, 0, 1).reshape(n * sub, n * sub)
        disc = gaussian_filter(disc, blur * sub, truncate=5)
        disc = disc.reshape(n, sub, n, sub).mean(axis=(1, 3))
        patch = image[y0 : y0 + n, x0 : x0 + n]
        patch += disc * (215.0 - patch)
    image += rng.normal(0, noise, image.shape)
    return np.repeat(np.clip(np.rint(image), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
