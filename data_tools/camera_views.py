"""Rays of a distorted camera, several a pixel, and the placing of cameras around a moving subject."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap
from geomocap.model.rig import Rig


@dataclass(frozen=True)
class DistortedView:
    """One camera's rays, known at the corners of all pixels.

    Attributes
    ----------
    origin : (3,) float
        Projection centre, metres, world.
    corners : (H + 1, W + 1, 3) float
        Directions through the pixels' corners, world, of depth 1 along the optical axis. Between corners they are
        interpolated linearly: over one pixel even strong distortion bends by less than 0.001 pixel.
    """

    origin: np.ndarray
    corners: np.ndarray

    @classmethod
    def of(cls, rig: Rig, camera: int) -> DistortedView:
        """Precompute the view of one camera of a rig."""
        width, height = (int(s) for s in rig.sizes[camera])
        x, y = np.meshgrid(np.arange(width + 1.0), np.arange(height + 1.0))
        origin, directions = rig.rays(camera, np.column_stack([x.ravel(), y.ravel()]))
        directions = directions / (directions @ rig.viewing_directions[camera])[:, None]
        if not np.isfinite(directions).all():
            raise CalibrationError(f"camera {rig.names[camera]}: its distortion can't be inverted over the whole image")
        return cls(origin, directions.reshape(height + 1, width + 1, 3))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.corners.shape[1] - 1, self.corners.shape[0] - 1

    def rays(self, pixels: np.ndarray, samples: int) -> np.ndarray:
        """Cast `samples`² rays through each of these pixels, on a regular grid about the pixel's centre.

        Parameters
        ----------
        pixels : (N,) int
            Row-major pixel numbers.

        Returns
        -------
        rays : (N, samples², 6) float32
            Origin and direction of depth 1, so that a ray's parameter is the depth.
        """
        return _rays(self.corners, self.origin, np.asarray(pixels, dtype=np.int64), samples)


@njit(cache=True, nogil=True, error_model="numpy")
def _rays(corners: np.ndarray, origin: np.ndarray, pixels: np.ndarray, samples: int) -> np.ndarray:
    width = corners.shape[1] - 1
    rays = np.empty((len(pixels), samples * samples, 6), dtype=np.float32)
    for n in range(len(pixels)):
        row, column = pixels[n] // width, pixels[n] % width
        for j in range(samples):
            b = (j + 0.5) / samples
            for i in range(samples):
                a = (i + 0.5) / samples
                for k in range(3):
                    top = (1 - a) * corners[row, column, k] + a * corners[row, column + 1, k]
                    bottom = (1 - a) * corners[row + 1, column, k] + a * corners[row + 1, column + 1, k]
                    rays[n, j * samples + i, k] = origin[k]
                    rays[n, j * samples + i, 3 + k] = (1 - b) * top + b * bottom
    return rays


def look_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pose [R | t], (3, 4), of an upright camera at `center` that looks at `target`; metres, world z up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight up or down
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([R, -R @ center])


def framing_distance(
    camera: pycolmap.Camera,
    place: Callable[[float], tuple[np.ndarray, np.ndarray]],
    points: np.ndarray,
    fill: float,
    closest: float,
) -> tuple[np.ndarray, float]:
    """Find the smallest distance from which a camera sees all points within the fraction `fill` of its image.

    Parameters
    ----------
    place : callable
        Distance in metres to (centre (3,), target (3,)) of the camera.
    points : (N, 3) float, metres, world
    fill : float
        Fraction of the image's half width and height within which all must lie.
    closest : float
        Distance not to go below, metres.

    Returns
    -------
    pose : (3, 4) float
    distance : float, metres
    """
    half = np.array([camera.width, camera.height]) / 2

    def attempt(distance: float) -> tuple[np.ndarray, float]:
        """Aim so that the points' image is centred; return the pose and how far they reach (1: to the border)."""
        center, target = place(distance)
        pose = look_at(center, target)
        reach = np.inf
        for _ in range(6):
            seen = points @ pose[:, :3].T + pose[:, 3]
            if seen[:, 2].min() < 0.05:
                return pose, np.inf
            pixels = camera.img_from_cam(seen)
            middle = (pixels.min(axis=0) + pixels.max(axis=0)) / 2
            reach = float((np.abs(pixels - half) / half).max())
            ray = np.append(np.asarray(camera.cam_from_img(middle[None]))[0], 1.0)
            depth = float((target - center) @ pose[2, :3])
            pose = look_at(center, center + depth * (ray @ pose[:, :3]))
        return pose, reach

    low, high = closest, closest
    while attempt(high)[1] > fill:
        low, high = high, high * 1.5
        if high > 1e6:
            raise CalibrationError("no distance shows the whole motion; choose a wider angle (hfov_deg)")
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if attempt(middle)[1] > fill else (low, middle)
    return attempt(high)[0], high
