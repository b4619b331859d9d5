"""Pictures of the posed subject in its room: ray cast, antialiased, with shadow, exposure and sensor noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from data_tools.camera_views import DistortedView
from data_tools.room import Light
from data_tools.shading import ShadedSurface
from geomocap.model.ray_casting import NOTHING, TriangleScene, touched_pixels
from geomocap.model.rig import Rig

SAMPLES, EDGE_SAMPLES = 2, 4  # rays a pixel are these squared: everywhere on the subject, and on its outline


@dataclass(frozen=True)
class PosedSubject:
    """The subject at one time, ready for ray casting.

    Attributes
    ----------
    vertices : (V, 3) float, metres, world
    normals : (V, 3) float
    scene : TriangleScene
    """

    vertices: np.ndarray
    normals: np.ndarray
    scene: TriangleScene

    @classmethod
    def of(cls, surface: ShadedSurface, vertices: np.ndarray) -> PosedSubject:
        """Build the ray casting scene (with one thread, so that the same rays always hit the same triangles)."""
        return cls(vertices, surface.normals(vertices), TriangleScene(vertices, surface.faces, threads=1))


@dataclass(frozen=True)
class FloorShadow:
    """Fraction of the key light that the subject takes from the floor, on a grid.

    Attributes
    ----------
    low : (2,) float
        Corner of the grid, metres.
    cell : float
        Distance of its points, metres.
    blocked : (Y, X) float32, 0 … 1
    """

    low: np.ndarray
    cell: float
    blocked: np.ndarray

    @classmethod
    def cast(cls, subject: PosedSubject, light: Light, resolution: int = 96) -> FloorShadow:
        """Cast rays from a grid on the floor, which the shadow fits into, to points spread over the key light."""
        v = subject.vertices
        slope = light.key_direction[:2] / light.key_direction[2]
        ends = np.concatenate([v[:, :2], v[:, :2] - v[:, 2:] * slope])
        reach = light.key_size * float(np.ptp(v[:, 2])) / light.key_direction[2]
        low, high = ends.min(axis=0) - reach, ends.max(axis=0) + reach
        cell = float((high - low).max()) / resolution
        nx, ny = (int(n) for n in np.ceil((high - low) / cell) + 1)
        gx, gy = np.meshgrid(low[0] + cell * np.arange(nx), low[1] + cell * np.arange(ny))
        # Points of a sunflower spiral over the light's disc
        k = np.arange(12)
        radius, turn = light.key_size / 2 * np.sqrt((k + 0.5) / len(k)), k * np.pi * (3 - np.sqrt(5))
        side = np.cross(light.key_direction, [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(light.key_direction, side)
        toward = light.key_direction + np.outer(radius * np.cos(turn), side) + np.outer(radius * np.sin(turn), other)
        rays = np.zeros((len(k), ny, nx, 6), dtype=np.float32)
        rays[..., 0], rays[..., 1], rays[..., 2] = gx, gy, 1e-4
        rays[..., 3:] = toward[:, None, None]
        blocked = subject.scene.occluded(rays).mean(axis=0, dtype=np.float32)
        return cls(low, cell, cv2.GaussianBlur(blocked, (0, 0), 1.0))

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Blocked fraction at floor positions (H, W, 2), 0 outside the grid and where NaN: (H, W) float32."""
        index = np.nan_to_num((positions - self.low.astype(np.float32)) / np.float32(self.cell), nan=-1e4)
        return cv2.remap(
            self.blocked,
            np.ascontiguousarray(index[..., 0]),
            np.ascontiguousarray(index[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )


@dataclass(frozen=True)
class Stage:
    """One camera's view of the empty room.

    Attributes
    ----------
    view : DistortedView
    background : (H, W, 3) float32, grey levels
    floor : (H, W, 2) float32
        Where the pixels' centres meet the floor, metres; NaN elsewhere.
    """

    view: DistortedView
    background: np.ndarray
    floor: np.ndarray


def render_subject(
    subject: PosedSubject, surface: ShadedSurface, rig: Rig, camera: int, view: DistortedView, light: Light
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render the subject alone.

    Returns
    -------
    pixels : (N,) int
        Row-major numbers of the pixels that it may touch.
    coverage : (N,) float32
        Fraction of each that it covers.
    colors : (N, 3) float32
        Its mean colour there, grey levels.
    """
    width, height = view.size
    corners = rig.select([rig.names[camera]]).project(subject.vertices)[0]
    pixels = np.flatnonzero(touched_pixels(corners, surface.faces, width, height))
    coverage, colors = _cast(subject, surface, view, light, pixels, SAMPLES)
    # The outline again, with more rays
    touched = np.zeros(width * height, dtype=np.uint8)
    full = np.zeros(width * height, dtype=np.uint8)
    touched[pixels], full[pixels] = coverage > 0, coverage == 1
    around = np.ones((3, 3), np.uint8)
    near = cv2.dilate(touched.reshape(height, width), around).ravel() > 0
    inner = cv2.erode(full.reshape(height, width), around).ravel() > 0
    again = (near & ~inner)[pixels]
    coverage[again], colors[again] = _cast(subject, surface, view, light, pixels[again], EDGE_SAMPLES)
    return pixels, coverage, colors


def _cast(
    subject: PosedSubject, surface: ShadedSurface, view: DistortedView, light: Light, pixels: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    if not len(pixels):
        return np.zeros(0, np.float32), np.zeros((0, 3), np.float32)
    _, triangle, uv = subject.scene.cast(view.rays(pixels, samples).reshape(-1, 6))
    hit = np.flatnonzero(triangle != NOTHING)
    shaded = surface.shade(subject.normals, triangle[hit].astype(np.int64), uv[hit], light.vector)
    return _average(hit // samples**2, shaded, len(pixels), samples**2)


@njit(cache=True, nogil=True, error_model="numpy")
def _average(owner: np.ndarray, colors: np.ndarray, count: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Fraction of a pixel's rays that hit, and their mean colour."""
    hits = np.zeros(count, dtype=np.float32)
    total = np.zeros((count, 3), dtype=np.float32)
    for i in range(len(owner)):
        hits[owner[i]] += 1
        for k in range(3):
            total[owner[i], k] += colors[i, k]
    for n in range(count):
        if hits[n] > 0:
            for k in range(3):
                total[n, k] /= hits[n]
        hits[n] /= samples
    return hits, total


def compose(
    stage: Stage,
    light: Light,
    shadow: FloorShadow | None,
    pixels: np.ndarray,
    coverage: np.ndarray,
    colors: np.ndarray,
) -> np.ndarray:
    """Put the subject and its shadow into the empty room: (H, W, 3) float32, grey levels, not clipped."""
    image = stage.background.copy()
    if shadow is not None:
        image *= (1 - np.float32(light.key_fraction_on_floor) * shadow.at(stage.floor))[:, :, None]
    flat = image.reshape(-1, 3)
    flat[pixels] += coverage[:, None] * (colors - flat[pixels])
    return image


def expose(image: np.ndarray, gain: float, noise: float, seed: tuple[int, ...]) -> np.ndarray:
    """Turn light into a picture: gain, Gaussian sensor noise (standard deviation in grey levels), rounding, clipping.

    The noise depends on the seed alone: (H, W, 3) uint8.
    """
    picture = image * np.float32(gain)
    if noise > 0:
        random = np.random.default_rng(seed)
        picture += np.float32(noise) * random.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
