"""What is known of the world's frame, and the datum that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.calibration.bundle_adjustment import AdjustedNetwork
from geomocap.calibration.datum import (
    Datum,
    datum_from_cameras,
    datum_from_floor,
    datum_from_gravity,
    datum_from_l_shape,
    datum_from_points,
    datum_from_rig,
)
from geomocap.model.rig import Rig


@dataclass(frozen=True)
class WorldKnowledge:
    """What is known of the world's frame; the first of these that is given counts.

    Attributes
    ----------
    rig : Rig, optional
        An existing calibration to align with.
    points_pixels, points_world : (C, N, 2) and (N, 3) float, optional
        Points with known coordinates, COLMAP pixels (NaN where not seen) and metres.
    l_shape : (C, 3, 2) float, optional
        The three targets of an L-shaped reference in each camera, in any order, with `arms`.
    arms : (float, float)
        Long and short arm of it, metres.
    floor : tuple of int
        Frames in which the bar lies on the floor.
    gravity : (camera, (x, y, z)), optional
        Downwards in a camera's axes.
    up : {"x", "y", "z"}
    """

    rig: Rig | None = None
    points_pixels: np.ndarray | None = None
    points_world: np.ndarray | None = None
    l_shape: np.ndarray | None = None
    arms: tuple[float, float] = (0.0, 0.0)
    floor: tuple[int, ...] = ()
    gravity: tuple[str, tuple[float, float, float]] | None = None
    up: str = "z"

    def datum(self, adjusted: AdjustedNetwork, target_radius: float) -> Datum:
        """Find the world of an adjusted network."""
        network = adjusted.network
        if self.rig is not None:
            return datum_from_rig(network, self.rig)
        if self.points_pixels is not None and self.points_world is not None:
            return datum_from_points(network, self.points_pixels, self.points_world)
        if self.l_shape is not None:
            return datum_from_l_shape(network, self.l_shape, *self.arms, self.up)
        if self.floor:
            return datum_from_floor(network, self.floor, self.up, target_radius)
        if self.gravity is not None:
            return datum_from_gravity(network, self.gravity[0], np.array(self.gravity[1]), self.up)
        return datum_from_cameras(network, self.up)

    def doubts(self, frames: np.ndarray) -> tuple[str, ...]:
        """Return what of this can't be meant, in words, for a recording with these frame numbers, (T,) int."""
        absent = sorted(set(self.floor) - set(frames.tolist()))
        if not absent:
            return ()
        there = f"{len(frames)} frames, {frames.min()} to {frames.max()}"
        return (
            f"floor: {len(absent)} of the {len(set(self.floor))} frames named, {absent[0]} to {absent[-1]}, are not in "
            f"the recording, which has {there}; name only those in which the bar lies on the floor",
        )
