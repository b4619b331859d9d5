"""Speckle images whose warps are exact: sums of Gaussians, evaluated analytically under any affine warp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Speckle:
    """A sum of Gaussians in the template's pixels."""

    centers: np.ndarray
    amplitudes: np.ndarray
    sigma: float

    @classmethod
    def random(cls, height: int, width: int, seed: int = 0, sigma: float = 1.8, contrast: float = 50.0) -> Speckle:
        """Make a pattern of standard deviation `contrast` (grey levels), reaching beyond the image on all sides."""
        rng = np.random.default_rng(seed)
        margin = 40
        count = int((height + 2 * margin) * (width + 2 * margin) / (3.4 * sigma * sigma))
        centers = rng.uniform([-margin, -margin], [width + margin, height + margin], (count, 2))
        density = count / ((height + 2 * margin) * (width + 2 * margin))
        amplitude = contrast / np.sqrt(density * np.pi * sigma**2)
        return cls(centers, rng.choice([-amplitude, amplitude], count), sigma)

    def render(self, height: int, width: int, affine=None, shift=(0.0, 0.0), center=(0.0, 0.0)) -> np.ndarray:
        """Image in which template pixel p is seen at affine (p − center) + center + shift: (H, W) float, mean 128."""
        A = np.eye(2) if affine is None else np.asarray(affine)
        inverse = np.linalg.inv(A)
        metric = inverse.T @ inverse / (2 * self.sigma**2)
        seen = (self.centers - center) @ A.T + center + shift
        reach = int(np.ceil(6.0 * self.sigma * np.linalg.norm(A, 2)))
        steps = np.arange(-reach, reach + 1)
        first = np.floor(seen).astype(int)
        image = np.zeros((height + 2 * reach, width + 2 * reach))
        usable = ((first >= 0 - reach) & (first < [width + reach, height + reach])).all(axis=1)
        padded = np.pad(image, reach)
        for part in np.array_split(np.flatnonzero(usable), max(1, usable.sum() // 2000)):
            x = first[part, 0, None, None] + steps[None, None, :]
            y = first[part, 1, None, None] + steps[None, :, None]
            dx = x + 0.5 - seen[part, 0, None, None]
            dy = y + 0.5 - seen[part, 1, None, None]
            power = metric[0, 0] * dx * dx + 2 * metric[0, 1] * dx * dy + metric[1, 1] * dy * dy
            value = self.amplitudes[part, None, None] * np.exp(-power)
            np.add.at(padded, (y + 2 * reach + 0 * x, x + 2 * reach + 0 * y), value)
        return padded[2 * reach : 2 * reach + height, 2 * reach : 2 * reach + width] + 128.0


def recorded(image: np.ndarray, noise: float, seed: int = 1, gain: float = 1.0, offset: float = 0.0) -> np.ndarray:
    """Return what a camera makes of it: gain, noise (grey levels), rounding and clipping to 8 bits."""
    rng = np.random.default_rng(seed)
    values = gain * image + offset + rng.normal(0, noise, image.shape) if noise else gain * image + offset
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
