"""The network of a bar recording: cameras, views, bars and the rays between them, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.calibration.projection import camera_of
from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig


@dataclass(frozen=True)
class Network:
    """Unknowns and observations of the adjustment.

    A view is a pose; it belongs to a camera, whose interior orientation its views share. Normally there is one view a
    camera; a camera that was moved during the recording has two.

    Attributes
    ----------
    names : tuple of C str
    sizes : (C, 2) int
        Image sizes, pixels.
    interior : (C, 13) float
        Interior parameters, see `projection`.
    view_camera : (V,) int
    rotation : (V, 3, 3) float
    translation : (V, 3) float
        x_cam = R x_world + t, metres.
    bars : (P, 2, 3) float
        Bar ends, metres, world.
    frames : (P,) int
        Frame of each bar.
    bar, view, end : (M,) int
        Which bar end each observation is of, in which view; sorted by bar, then view, then end.
    pixels : (M, 2) float
        Observed COLMAP pixels.
    sigmas : (M,) float
        Standard deviation of an observed coordinate, pixels.
    length, length_sigma : float
        Known distance of the bar's ends and its standard deviation, metres.
    """

    names: tuple[str, ...]
    sizes: np.ndarray
    interior: np.ndarray
    view_camera: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    bars: np.ndarray
    frames: np.ndarray
    bar: np.ndarray
    view: np.ndarray
    end: np.ndarray
    pixels: np.ndarray
    sigmas: np.ndarray
    length: float
    length_sigma: float

    def __post_init__(self) -> None:
        order = self.bar * 2 * len(self.view_camera) + self.view * 2 + self.end
        if np.any(np.diff(order) <= 0):
            raise CalibrationError("observations must be sorted by bar, view and end, each once")

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.view_camera)

    def with_state(
        self, interior: np.ndarray, rotation: np.ndarray, translation: np.ndarray, bars: np.ndarray
    ) -> Network:
        """Return the network with these values of the unknowns."""
        return replace(self, interior=interior, rotation=rotation, translation=translation, bars=bars)

    def with_observations(self, keep: np.ndarray) -> Network:
        """Return the network with these observations only, without bars of which an end is left with one ray.

        Parameters
        ----------
        keep : (M,) bool
        """
        keep = np.array(keep, dtype=bool)
        rays = np.zeros((len(self.bars), 2), dtype=np.int64)
        np.add.at(rays, (self.bar[keep], self.end[keep]), 1)
        good: np.ndarray = np.asarray((rays >= 2).all(axis=1))
        keep = keep & good[self.bar]
        number = np.cumsum(good) - 1
        return replace(
            self,
            bars=self.bars[good],
            frames=self.frames[good],
            bar=number[self.bar[keep]],
            view=self.view[keep],
            end=self.end[keep],
            pixels=self.pixels[keep],
            sigmas=self.sigmas[keep],
        )

    def with_bars(self, keep: np.ndarray) -> Network:
        """Return the network with these bars (P,) bool only."""
        return self.with_observations(np.asarray(keep, dtype=bool)[self.bar])

    def transformed(self, rotation: np.ndarray, translation: np.ndarray) -> Network:
        """Return the network in another world: x_new = rotation x_world + translation, nothing else changes."""
        R = self.rotation @ rotation.T
        return replace(
            self,
            rotation=R,
            translation=self.translation - R @ translation,
            bars=self.bars @ rotation.T + translation,
        )

    def rig(self) -> Rig:
        """Return the calibrated cameras; of a camera with several views, the last one."""
        last = {int(c): v for v, c in enumerate(self.view_camera)}
        poses = np.array(
            [np.column_stack([self.rotation[last[c]], self.translation[last[c]]]) for c in range(len(self.names))]
        )
        cameras = tuple(camera_of(q, (int(w), int(h))) for q, (w, h) in zip(self.interior, self.sizes, strict=True))
        return Rig(self.names, cameras, poses)


def rotated(rotation: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Apply small rotation vectors (V, 3) on the left of rotations (V, 3, 3), keeping them orthonormal."""
    return (Rotation.from_rotvec(vectors) * Rotation.from_matrix(rotation)).as_matrix()
