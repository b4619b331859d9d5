"""A figure that walks between cameras, with its silhouettes in small images, and what can be wrong with a camera."""

from __future__ import annotations

import numpy as np
import pycolmap

from geomocap.model.rig import Rig
from tests.geomocap.carving_scenes import FIGURE, ring, silhouettes

SIZE = 96, 72
FOCAL = 85.0


def walk_rig(cameras: int) -> Rig:
    """Cameras round the figure."""
    P = ring(cameras, focal=FOCAL, width=SIZE[0], height=SIZE[1])
    camera = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[FOCAL, FOCAL, 48, 36])
    poses = np.linalg.inv(camera.calibration_matrix()) @ P
    return Rig(tuple(f"cam{c + 1}" for c in range(cameras)), (camera,) * cameras, poses)


def walk(rig: Rig, frames: int) -> list[list[np.ndarray]]:
    """Silhouettes of T frames, each C arrays (H, W) uint8: the figure turns, steps aside and lifts an arm."""
    shown = []
    for k in range(frames):
        figure = FIGURE.copy()
        figure[3, 2] += 0.12 * k
        figure[:, 0] += 0.07 * k - 0.2
        shown.append(silhouettes(rig.projections, figure, *SIZE))
    return shown


def changed(shown: list[list[np.ndarray]], camera: int, how) -> list[list[np.ndarray]]:
    """Change the silhouettes of a camera."""
    return [[how(m) if c == camera else m for c, m in enumerate(row)] for row in shown]


def posed(rig: Rig, camera: int, turn: np.ndarray, shift=(0.0, 0.0, 0.0)) -> Rig:
    """Turn and shift a camera in its own axes."""
    poses = np.array(rig.cam_from_world)
    poses[camera] = turn @ poses[camera]
    poses[camera, :, 3] += shift
    return Rig(rig.names, rig.cameras, poses)


def with_focal(rig: Rig, camera: int, factor: float) -> Rig:
    """Multiply a camera's focal length."""
    cameras = [pycolmap.Camera(c.todict()) for c in rig.cameras]
    cameras[camera].focal_length_x *= factor
    cameras[camera].focal_length_y *= factor
    return Rig(rig.names, tuple(cameras), rig.cam_from_world)
