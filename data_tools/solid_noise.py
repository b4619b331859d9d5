"""Solid noise: a random pattern defined everywhere in space, with which surfaces are textured."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lattice(x: int, y: int, z: int, seed: int) -> int:
    h = (x * 374761393 + y * 668265263 + z * 2147483647 + seed * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return h ^ (h >> 15)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _slope(h: int, x: float, y: float, z: float) -> float:
    """Dot product with one of the twelve directions to the edges of a cube (Perlin 2002)."""
    k = h & 15
    u = x if k < 8 else y
    v = y if k < 4 else (x if k in (12, 14) else z)
    return (u if (h & 1) == 0 else -u) + (v if (h & 2) == 0 else -v)


@njit(cache=True, nogil=True, error_model="numpy")
def gradient_noise(x: float, y: float, z: float, seed: int) -> float:
    """Perlin's improved gradient noise with cells of size 1, about -1 … 1, mean 0, standard deviation about 0.27.

    Source: K. Perlin, "Improving Noise", SIGGRAPH 2002.
    """
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    dx, dy, dz = x - fx, y - fy, z - fz
    wx = dx * dx * dx * (dx * (dx * 6.0 - 15.0) + 10.0)
    wy = dy * dy * dy * (dy * (dy * 6.0 - 15.0) + 10.0)
    wz = dz * dz * dz * (dz * (dz * 6.0 - 15.0) + 10.0)
    total = 0.0
    for i in range(2):
        a = wx if i else 1.0 - wx
        for j in range(2):
            b = a * (wy if j else 1.0 - wy)
            for k in range(2):
                c = b * (wz if k else 1.0 - wz)
                total += c * _slope(_lattice(ix + i, iy + j, iz + k, seed), dx - i, dy - j, dz - k)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def fabric_noise(x: float, y: float, z: float, cells: np.ndarray, weights: np.ndarray, seed: int) -> float:
    """Sum of octaves of gradient noise; `cells` are their cell sizes in the unit of the position."""
    total = 0.0
    for o in range(len(cells)):
        total += weights[o] * gradient_noise(x / cells[o], y / cells[o], z / cells[o], seed + o)
    return total
