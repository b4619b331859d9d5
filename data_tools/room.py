"""The static room in which a synthetic capture is taken: box-shaped, textured, lit like the subject."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from data_tools.camera_views import DistortedView
from data_tools.solid_noise import gradient_noise


@dataclass(frozen=True)
class Light:
    """Two distant lights and ambient light.

    Attributes
    ----------
    key_direction, fill_direction : (3,) float
        Unit vectors towards the lights, world.
    ambient, key, fill : float
        Strengths; a surface turned to both lights gets their sum.
    key_size : float
        Diameter of the key light over its distance: how soft its shadows are.
    """

    key_direction: np.ndarray
    fill_direction: np.ndarray
    ambient: float = 0.5
    key: float = 0.5
    fill: float = 0.22
    key_size: float = 0.3

    @classmethod
    def studio(cls) -> Light:
        """A large key light high at the front left, a weak fill light from behind on the right."""
        key, fill = np.array([-0.45, -0.6, 1.1]), np.array([0.7, 0.8, 0.35])
        return cls(key / np.linalg.norm(key), fill / np.linalg.norm(fill))

    @property
    def vector(self) -> np.ndarray:
        """As kernels take it, (9,) float: key direction, fill direction, ambient, key, fill."""
        return np.array([*self.key_direction, *self.fill_direction, self.ambient, self.key, self.fill])

    @property
    def key_fraction_on_floor(self) -> float:
        """How much of the floor's light a full shadow of the key light takes away."""
        key = self.key * max(0.0, self.key_direction[2])
        return float(key / (key + self.ambient + self.fill * max(0.0, self.fill_direction[2])))


@dataclass(frozen=True)
class Room:
    """Inside of a box.

    Attributes
    ----------
    low, high : (3,) float
        Corners, metres, world; the floor is at low[2].
    seed : int
        Of the texture.
    """

    low: np.ndarray
    high: np.ndarray
    seed: int = 0

    def render(self, view: DistortedView, light: Light, samples: int = 3) -> np.ndarray:
        """Render the empty room, antialiased with `samples`² rays a pixel: (H, W, 3) float32, grey levels."""
        return _render(view.corners, view.origin, self.low, self.high, light.vector, samples, self.seed)

    def floor_positions(self, view: DistortedView) -> np.ndarray:
        """Where each pixel's centre meets the floor: (H, W, 2) float32, metres, NaN where it meets a wall."""
        width, height = view.size
        rays = view.rays(np.arange(width * height), 1)[:, 0].astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self.low[2] - rays[:, 2]) / rays[:, 5]
            xy = rays[:, :2] + depth[:, None] * rays[:, 3:5]
        inside = (depth > 0) & np.all((xy > self.low[:2]) & (xy < self.high[:2]), axis=1)
        xy[~inside] = np.nan
        return xy.reshape(height, width, 2).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy", parallel=False)
def _render(
    corners: np.ndarray,
    origin: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    light: np.ndarray,
    samples: int,
    seed: int,
) -> np.ndarray:
    height, width = corners.shape[0] - 1, corners.shape[1] - 1
    image = np.empty((height, width, 3), dtype=np.float32)
    d, p, n = np.empty(3), np.empty(3), np.empty(3)
    for row in range(height):
        for column in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            for s in range(samples * samples):
                a, b = (s % samples + 0.5) / samples, (s // samples + 0.5) / samples
                for k in range(3):
                    top = (1 - a) * corners[row, column, k] + a * corners[row, column + 1, k]
                    bottom = (1 - a) * corners[row + 1, column, k] + a * corners[row + 1, column + 1, k]
                    d[k] = (1 - b) * top + b * bottom
                # The wall that the ray leaves the box through
                depth, axis = 1e30, len(d) - 1  # no literal: Numba would compile walls for it, too
                for k in range(3):
                    if d[k] != 0.0:
                        t = ((high[k] if d[k] > 0 else low[k]) - origin[k]) / d[k]
                        if t < depth:
                            depth, axis = t, k
                for k in range(3):
                    p[k] = origin[k] + depth * d[k]
                    n[k] = 0.0
                n[axis] = -1.0 if d[axis] > 0 else 1.0
                level = light[6]
                level += light[7] * max(0.0, n[0] * light[0] + n[1] * light[1] + n[2] * light[2])
                level += light[8] * max(0.0, n[0] * light[3] + n[1] * light[4] + n[2] * light[5])
                if axis == 2 and d[2] < 0:
                    r, g, c = _floor(p, seed)
                else:
                    r, g, c = _wall(p, axis, low[2], seed)
                red += level * r
                green += level * g
                blue += level * c
            count = samples * samples
            image[row, column, 0] = 255.0 * red / count
            image[row, column, 1] = 255.0 * green / count
            image[row, column, 2] = 255.0 * blue / count
    return image


@njit(cache=True, nogil=True, error_model="numpy")
def _floor(p: np.ndarray, seed: int) -> tuple[float, float, float]:
    """Colour of the floor, 0 … 1: tiles of 60 cm, each a little different, with joints and stains."""
    u, v = p[0] / 0.6, p[1] / 0.6
    tile = gradient_noise(np.floor(u) * 0.71 + 0.37, np.floor(v) * 0.71 + 0.21, 0.5, seed + 11)
    edge = min(abs(u - np.rint(u)), abs(v - np.rint(v))) * 0.6
    joint = 1.0 - 0.35 * max(0.0, 1.0 - edge / 0.008)
    stains = gradient_noise(p[0] / 0.45, p[1] / 0.45, 0.3, seed + 12) + 0.7 * gradient_noise(
        p[0] / 0.09, p[1] / 0.09, 0.3, seed + 13
    )
    level = joint * (0.42 + 0.08 * tile + 0.06 * stains)
    return level, 0.97 * level, 0.9 * level


@njit(cache=True, nogil=True, error_model="numpy")
def _wall(p: np.ndarray, axis: int, floor: float, seed: int) -> tuple[float, float, float]:
    """Colour of a wall or the ceiling, 0 … 1: panels of a metre with grain, a darker skirting board."""
    along, up = (p[1] if axis == 0 else p[0]), (p[1] if axis == 2 else p[2] - floor)
    side = 3 * axis + (1 if p[axis] > 0 else 0)
    u, v = along / 1.1, up / 1.4
    panel = gradient_noise(np.floor(u) * 0.63 + 0.4, np.floor(v) * 0.63 + 0.3, side + 0.5, seed + 21)
    edge = min(abs(u - np.rint(u)) * 1.1, abs(v - np.rint(v)) * 1.4)
    joint = 1.0 - 0.3 * max(0.0, 1.0 - edge / 0.012)
    grain = gradient_noise(along / 0.5, up / 0.12, side + 0.5, seed + 22) + 0.6 * gradient_noise(
        along / 0.1, up / 0.1, side + 0.5, seed + 23
    )
    level = joint * (0.36 + 0.12 * panel + 0.06 * grain)
    if axis != 2 and up < 0.1:
        level *= 0.5
    return 0.86 * level, 0.98 * level, 1.08 * level
