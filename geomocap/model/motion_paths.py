"""Motion paths: points of a surface followed through time, whatever followed them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geomocap.errors import GeometryError

LEAST_FRAMES = 2
DEPTH_FRACTION = 0.1  # of what is missed along a ray, counts
_GIVE = 0.001  # diagonals; what surfaces give although they belong to a rigid body


@dataclass(frozen=True)
class MotionPaths:
    """N samples of a surface over T frames: tracked nodes, patches, trajectories, ellipsoids or vertices.

    Attributes
    ----------
    positions : (N, T, 3) float, metres, world
        NaN where a sample was not followed.
    rotations : (N, T, 3, 3) float, optional
        Turn of each sample since frame 0, world axes; NaN where not known. All samples of one rigid body have the same.
    sigma : (N,) or (N, T) float, optional
        Standard deviation of the positions, metres.
    ray : (N, T, 3) float, optional
        Unit vectors along which positions are unsure, as of those that a single camera sees: what is missed along them
        counts a tenth. 0: sure in all directions.
    parts : (N,) int, optional
        Rigid parts, from 0, that the samples are known to move with; bodies are joined of these.
    """

    positions: np.ndarray
    rotations: np.ndarray | None = None
    sigma: np.ndarray | None = None
    ray: np.ndarray | None = None
    parts: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.positions.ndim != 3 or self.positions.shape[2] != 3:
            raise GeometryError(f"motion paths: positions have shape {self.positions.shape}, expected (N, T, 3)")
        count, frames = self.positions.shape[:2]
        if frames < LEAST_FRAMES:
            raise GeometryError(f"motion paths: {frames} frames; at least {LEAST_FRAMES} are needed to see motion")
        optional = {
            "rotations": (self.rotations, [(count, frames, 3, 3)]),
            "sigma": (self.sigma, [(count,), (count, frames)]),
            "ray": (self.ray, [(count, frames, 3)]),
            "parts": (self.parts, [(count,)]),
        }
        for name, (array, shapes) in optional.items():
            if array is not None and array.shape not in shapes:
                raise GeometryError(f"motion paths: {name} have shape {array.shape}, expected {shapes[-1]}")
        if self.sigma is not None and (self.sigma < 0).any():
            least = float(np.nanmin(self.sigma))
            raise GeometryError(f"motion paths: sigma is {least:g} m somewhere; standard deviations aren't below 0")
        if not np.isfinite(self.positions).all(axis=2).any(axis=1).all():
            raise GeometryError("motion paths: a sample without any position; leave such samples out")

    @cached_property
    def seen(self) -> np.ndarray:
        """Where a sample has a position, (N, T) bool."""
        return np.isfinite(self.positions).all(axis=2)

    @property
    def count(self) -> int:
        """Number of samples N."""
        return self.positions.shape[0]

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return self.positions.shape[1]

    @property
    def diagonal(self) -> float:
        """Diagonal of the box around the samples, metres: that of the fullest frame."""
        fullest = int(np.argmax(self.seen.sum(axis=0)))
        return float(np.linalg.norm(np.ptp(self.positions[self.seen[:, fullest], fullest], axis=0)))

    def typical_sigma(self) -> np.ndarray:
        """Standard deviation of each sample's positions, (N,) float, metres: median over the frames; 0: not stated."""
        if self.sigma is None:
            return np.zeros(self.count)
        given = np.asarray(self.sigma, float).reshape(self.count, -1)
        stated = np.where(np.isfinite(given), given, 0.0)
        return np.median(stated, axis=1)

    def weights(self) -> np.ndarray:
        """Weight of each position, (N, T) float: 1 for the median precision, at most 4; 0 where not seen.

        No surface is rigid to better than a small fraction of its diagonal: what is more precise doesn't count more.
        Where a body turns most its samples are known worst, and yet say most about it.
        """
        if self.sigma is None:
            return self.seen.astype(float)
        sigma = np.broadcast_to(self.sigma if self.sigma.ndim == 2 else self.sigma[:, None], self.seen.shape)
        known = self.seen & np.isfinite(sigma) & (sigma > 0)
        give = (_GIVE * self.diagonal) ** 2
        middle = float(np.median(sigma[known])) if known.any() else 1.0
        variance = np.where(known, sigma, middle) ** 2 + give
        return np.where(known, np.minimum((middle**2 + give) / variance, 4.0), self.seen * 0.25)


def sure_part(misses: np.ndarray, ray: np.ndarray | None) -> np.ndarray:
    """What of misses (…, 3) counts: all of it across the rays (…, 3), a tenth along them."""
    if ray is None:
        return misses
    return misses - (1.0 - DEPTH_FRACTION) * (misses * ray).sum(axis=-1, keepdims=True) * ray
