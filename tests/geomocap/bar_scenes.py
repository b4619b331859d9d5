"""Small synthetic bar recordings with truth: cameras, bar positions, image points and images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from geomocap.calibration.datum import rigid_alignment
from geomocap.calibration.network import Network, rotated
from geomocap.calibration.projection import interior_of
from geomocap.calibration.target_observations import TargetObservations, stack_candidates
from geomocap.model.rig import Rig


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
    def diagonal(self) -> float:
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
        # Fraction of each small square inside the outline, from its distance to it; then blur, then area means
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


def true_network(scene: Scene, noise: float, seed: int) -> Network:
    """The network of a scene with observed points of a given noise, at its true state."""
    rng = np.random.default_rng(seed)
    pixels = scene.points(rng, noise)
    bar, view, end = np.nonzero(np.moveaxis(np.isfinite(pixels[..., 0]), 0, 1))
    poses = scene.rig.cam_from_world
    return Network(
        scene.rig.names,
        scene.rig.sizes,
        np.array([interior_of(c) for c in scene.rig.cameras]),
        np.arange(len(scene.rig)),
        np.array(poses[:, :, :3]),
        np.array(poses[:, :, 3]),
        scene.bars.copy(),
        np.arange(len(scene.bars)),
        bar,
        view,
        end,
        pixels[view, bar, end],
        np.full(len(bar), noise),
        scene.length,
        1e-5,
    )


def disturbed_network(scene: Scene, noise: float, seed: int) -> Network:
    """The same with approximate values: focal lengths 3 % off, no distortion, poses and points shifted."""
    network = true_network(scene, noise, seed)
    rng = np.random.default_rng(seed + 100)
    interior = network.interior.copy()
    interior[:, :2] *= 1.03
    interior[:, 2:4] = network.sizes / 2
    interior[:, 4:] = 0
    C = len(network.names)
    return network.with_state(
        interior,
        rotated(network.rotation, rng.normal(0, 0.02, (C, 3))),
        network.translation + rng.normal(0, 0.05, (C, 3)),
        network.bars + rng.normal(0, 0.03, network.bars.shape),
    )


def seen(
    scene: Scene, rng: np.random.Generator, noise: float, false: float = 0.0, missing: np.ndarray | None = None
) -> TargetObservations:
    """Observations of a scene, ends in random order.

    false : fraction of images with a false blob; missing : fraction of detections missing in each camera
    """
    pixels = scene.points(rng, noise)
    found = {}
    for c in range(len(scene.rig)):
        for t in range(len(scene.bars)):
            kept = [
                p for p in pixels[c, t] if np.isfinite(p[0]) and not (missing is not None and rng.random() < missing[c])
            ]
            if rng.random() < false:
                kept.append(rng.uniform([5, 5], scene.rig.sizes[c] - 5))
            rng.shuffle(kept)
            found[c, t] = np.array([[*p, noise, 0.0] for p in kept]).reshape(-1, 4)
    return stack_candidates(scene.rig.names, scene.rig.sizes, np.arange(len(scene.bars)), found)


def joined(first: TargetObservations, second: TargetObservations, frame: int) -> TargetObservations:
    """The first observations up to a frame, the second from it on."""
    K = max(first.pixels.shape[2], second.pixels.shape[2])

    def both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        rest = [(0, 0)] * (a.ndim - 3)
        wide = [np.pad(x, [(0, 0), (0, 0), (0, K - x.shape[2]), *rest], constant_values=np.nan) for x in (a, b)]
        return np.concatenate([wide[0][:, :frame], wide[1][:, frame:]], axis=1)

    return TargetObservations(
        first.cameras,
        first.sizes,
        first.frames,
        both(first.pixels, second.pixels),
        both(first.sigmas, second.sigmas),
        both(first.radii, second.radii),
    )


def knocked(scene: Scene, camera: int, angle_deg: float, shift: float, seed: int = 0) -> Scene:
    """The scene after one camera was turned and shifted (m)."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
    move = rng.normal(size=3)
    poses = np.array(scene.rig.cam_from_world)
    poses[camera] = turn @ poses[camera]
    poses[camera, :, 3] += shift * move / np.linalg.norm(move)
    return Scene(Rig(scene.rig.names, scene.rig.cameras, poses), scene.bars, scene.length, scene.radius)


def object_errors(scene: Scene, rig: Rig, bars: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, float]:
    """Errors of bar ends (N, 3) after a rigid alignment without scale, and the reprojection error of the volume, px."""
    truth = scene.bars[frames]
    turn = scene.rig.cam_from_world[0, :, :3].T @ rig.cam_from_world[0, :, :3]
    rough = bars @ turn.T + scene.rig.centers[0] - turn @ rig.centers[0]
    swap = np.linalg.norm(rough[:, 0] - truth[:, 0], axis=1) > np.linalg.norm(rough[:, 0] - truth[:, 1], axis=1)
    truth = np.where(swap[:, None, None], truth[:, ::-1], truth).reshape(-1, 3)
    R, t, _ = rigid_alignment(bars.reshape(-1, 3), truth)
    errors = bars.reshape(-1, 3) @ R.T + t - truth
    ends = scene.bars.reshape(-1, 3)
    axes = [np.linspace(a, b, 7) for a, b in zip(ends.min(axis=0), ends.max(axis=0), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    true, ours = scene.rig.project(grid), rig.project((grid - t) @ R)
    inside = (true > 0).all(axis=2) & (true < scene.rig.sizes[:, None]).all(axis=2)
    return errors, float(np.sqrt(np.mean((ours - true)[inside] ** 2)))
