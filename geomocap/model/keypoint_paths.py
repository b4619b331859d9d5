"""Key-points: regions on the subject with a name, and their ways through time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError


@dataclass(frozen=True)
class KeyPointPaths:
    """Key-points through time.

    Attributes
    ----------
    positions : (T, K, 3) float, metres, world
        NaN where nothing near was measured.
    bridged : (T, K) bool
        Carried by the body round the point instead of the trajectories inside.
    n_tracks : (T, K) int
        Trajectories that it was moved by: those inside, where it is bridged those around.
    std : (T, K) float, metres
        Standard deviation of the place against that in the frame where it was put.
    """

    positions: np.ndarray
    bridged: np.ndarray
    n_tracks: np.ndarray
    std: np.ndarray

    def __post_init__(self) -> None:
        if self.positions.ndim != 3 or self.positions.shape[2] != 3:
            raise GeometryError(f"key-points: positions have shape {self.positions.shape}, expected (T, K, 3)")
        for name in ("bridged", "n_tracks", "std"):
            if getattr(self, name).shape != self.positions.shape[:2]:
                raise GeometryError(
                    f"key-points: {name} has shape {getattr(self, name).shape}, expected {self.positions.shape[:2]}"
                )


@dataclass(frozen=True)
class KeyPoints:
    """Key-points with their names.

    Attributes
    ----------
    names : (K,) str
    radius : (K,) float, metres
    paths : KeyPointPaths
    links : (L, 2) int
        Key-points that a line joins.
    velocities, accelerations : (T, K, 3) float, m/s and m/s², optional
    fps : float, optional
    """

    names: tuple[str, ...]
    radius: np.ndarray
    paths: KeyPointPaths
    links: np.ndarray
    velocities: np.ndarray | None = None
    accelerations: np.ndarray | None = None
    fps: float | None = None

    def __post_init__(self) -> None:
        shape = self.paths.positions.shape
        if len(self.names) != shape[1] or self.radius.shape != shape[1:2]:
            raise GeometryError(
                f"key-points: {len(self.names)} names, {len(self.radius)} radii, but positions of {shape[1]}"
            )
        for name in ("velocities", "accelerations"):
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise GeometryError(f"key-points: {name} has shape {array.shape}, expected {shape}")
        if self.links.ndim != 2 or self.links.shape[1] != 2 or not ((self.links >= 0) & (self.links < shape[1])).all():
            raise GeometryError(f"key-points: links name others than key-points 0 to {shape[1] - 1}")
