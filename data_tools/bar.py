"""A reference-bar recording: a bar with two bright targets, held in many ways in a darkened room."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tomli_w

from data_tools.camera_views import DistortedView
from data_tools.image_rendering import Stage, expose
from geomocap.errors import CalibrationError
from geomocap.files.atomic import write_atomic, write_text
from geomocap.files.images import write_image
from geomocap.model.rig import Rig
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items

TARGET_SAMPLES = 16  # rays a pixel are this squared
ROOM_LIGHT = 0.06  # of the room's usual light
TARGET_LEVEL, ROD_LEVEL = 225.0, 14.0  # grey levels
LENS_BLUR = 0.7  # pixels, standard deviation: no lens draws targets as sharp as the pixels' squares alone


@dataclass(frozen=True)
class BarRecording:
    """Where the bar is held.

    Attributes
    ----------
    targets : (P, 2, 3) float
        Centres of the two targets, metres, world.
    length : float
        Their distance, metres.
    radius : float
        Of the target balls, metres.
    """

    targets: np.ndarray
    length: float
    radius: float

    @classmethod
    def plan(
        cls, rig: Rig, low: np.ndarray, high: np.ndarray, count: int, length: float | None, footprint: float, seed: int
    ) -> BarRecording:
        """Choose places all over a volume and directions all over the sphere.

        Places at which the targets leave a camera's image or cover each other are not used (after many vain
        attempts, those that two cameras see). The balls' radius is three pixels: an ellipse's centre is then within
        0.01 pixel of its ball's.

        Parameters
        ----------
        low, high : (3,) float
            Corners of the volume, metres; narrow sides are widened to 60 % of the longest.
        """
        size = np.maximum(high - low, 0.6 * float((high - low).max()))
        middle = (low + high) / 2
        radius = 3.0 * footprint
        length = length or round(float(size.max()) / 3, 2)
        random = np.random.default_rng((seed, 4))
        targets = np.empty((count, 2, 3))
        for p in range(count):
            for attempt in range(400):
                direction = random.standard_normal(3)
                direction *= length / 2 / np.linalg.norm(direction)
                place = middle + size * random.uniform(-0.5, 0.5, 3)
                pair = np.stack([place - direction, place + direction])
                if pair[:, 2].min() < radius:
                    continue
                if _seen(rig, pair, radius).sum() >= (len(rig) if attempt < 300 else min(2, len(rig))):
                    break
            else:
                raise CalibrationError(
                    f"no place for a bar of {length} m that two cameras see whole; give a smaller bar_length"
                )
            targets[p] = pair
        return cls(targets, length, radius)


def _seen(rig: Rig, pair: np.ndarray, radius: float) -> np.ndarray:
    """Which cameras see both targets whole and apart: (C,) bool."""
    pixels, depth = rig.project(pair), rig.to_camera(pair)[:, :, 2]
    focal = np.array([c.mean_focal_length() for c in rig.cameras])
    with np.errstate(invalid="ignore", divide="ignore"):
        reach = 2 + (focal[:, None] * radius / depth).max(axis=1)
        inside = (pixels > reach[:, None, None]) & (pixels < rig.sizes[:, None] - reach[:, None, None])
        apart = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1) > 2 * reach - 2
    return inside.all(axis=(1, 2)) & apart & (depth > 0.1).all(axis=1)


def record_bar(
    bar: BarRecording,
    rig: Rig,
    stages: list[Stage],
    gains: np.ndarray,
    noise: float,
    capture: Path,
    truth: Path,
    seed: int,
    executor: Executor,
    progress: Progress = silent,
) -> None:
    """Write bar/<camera>/*.png and bar/bar.toml into the capture, bar.npz into the truth folder."""

    def make(p: int) -> None:
        for c, name in enumerate(rig.names):
            image = picture_bar(stages[c].background, stages[c].view, rig, c, bar.targets[p], bar.radius)
            write_image(capture / "bar" / name / f"{p:06d}.png", expose(image, gains[c], noise, (seed, 5, c, p)))

    for _ in map_items(make, range(len(bar.targets)), executor, "bar", progress, ahead=4):
        pass
    write_text(capture / "bar" / "bar.toml", tomli_w.dumps({"length": bar.length}))
    write_atomic(truth / "bar.npz", lambda p: np.savez(p, points=bar.targets, length=bar.length))


def picture_bar(
    background: np.ndarray, view: DistortedView, rig: Rig, camera: int, targets: np.ndarray, radius: float
) -> np.ndarray:
    """Render a bar in the darkened room, (H, W, 3) float32, grey levels.

    The rod ends short of the targets, and the targets are evenly bright, as retro-reflective ones are: the centroid
    of a target's image is its centre's image.
    """
    image = background * np.float32(ROOM_LIGHT)
    width, height = view.size
    axis = targets[1] - targets[0]
    rod = targets[0] + np.linspace(0.08, 0.92, 200)[:, None] * axis
    pixels = rig.select([rig.names[camera]]).project(rod)[0]
    if np.isfinite(pixels).all():
        line = np.rint((pixels - 0.5) * 16).astype(np.int32)
        cv2.polylines(image, [line[:, None]], False, (ROD_LEVEL,) * 3, 1, cv2.LINE_AA, shift=4)
    depths = rig.to_camera(targets)[camera, :, 2]
    flat = image.reshape(-1, 3)
    for k in np.argsort(-depths):  # the nearer one covers the farther one
        if depths[k] <= radius:
            continue
        u, v = rig.select([rig.names[camera]]).project(targets[k : k + 1])[0, 0]
        reach = 2 + 1.5 * rig.cameras[camera].mean_focal_length() * radius / depths[k]
        columns = np.arange(max(0, int(u - reach)), min(width, int(u + reach) + 1))
        rows = np.arange(max(0, int(v - reach)), min(height, int(v + reach) + 1))
        near = (rows[:, None] * width + columns).ravel()
        if not len(near):
            continue
        rays = view.rays(near, TARGET_SAMPLES).astype(np.float64)
        direction = rays[..., 3:] / np.linalg.norm(rays[..., 3:], axis=-1, keepdims=True)
        toward = targets[k] - view.origin
        along = direction @ toward
        hit = (toward @ toward - along**2 <= radius**2) & (along > 0)
        coverage = hit.mean(axis=1)[:, None].astype(np.float32)
        flat[near] += coverage * (TARGET_LEVEL - flat[near])
    return cv2.GaussianBlur(image, (0, 0), LENS_BLUR)
