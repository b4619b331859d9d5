"""The result of a segmentation: ellipsoids, rigid bodies and their motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.ellipsoids import Ellipsoids


@dataclass(frozen=True)
class Segmentation:
    """A sequence of T frames divided into K ellipsoids, these grouped into B rigid bodies.

    Bodies are numbered in the order in which they were found. A single frame has no motion to tell bodies by: it has
    its ellipsoids, B = 0, and every ellipsoid's body is -1.

    Attributes
    ----------
    ellipsoids : Ellipsoids
        (T, K, …); ellipsoid k is the same piece of surface in all frames.
    body : (K,) int32
        Body of each ellipsoid; -1: none.
    point_ellipsoids : tuple of T arrays (N_t,) int16
        Ellipsoid of every point.
    bodies : Ellipsoids
        (T, B, …): one for all points of each body; errors are NaN.
    body_rotations : (T, B, 3, 3) float
        Rotation since frame 0, world axes.
    body_positions : (T, B, 3) float, metres, world
        Centres of the bodies; where tracked points lead them if `carried`.
    carried : bool
        Whether tracked points carried the ellipsoids: turns are known then.
    contacts : (B, B) float
        Neighbouring pairs of points between two bodies, mean over the frames looked at.
    touching : (B, B) float
        Fraction of the frames looked at in which two bodies touch.
    seeds : (B,) int32
        Ellipsoid from which each body was found.
    integrals : (K, K) float, metres
        Mean distance over time of each two relative paths.
    threshold : float, metres
        T_sb, the integral up to which ellipsoids belong to one body.
    repaired : (T,) int32
        Ellipsoids split in matching, a measure of how unsteady the frames are.
    spacing : float, metres
        Distance of neighbouring points.
    """

    ellipsoids: Ellipsoids
    body: np.ndarray
    point_ellipsoids: tuple[np.ndarray, ...]
    bodies: Ellipsoids
    body_rotations: np.ndarray
    body_positions: np.ndarray
    carried: bool
    contacts: np.ndarray
    touching: np.ndarray
    seeds: np.ndarray
    integrals: np.ndarray
    threshold: float
    repaired: np.ndarray
    spacing: float

    @property
    def body_count(self) -> int:
        """Number of bodies B."""
        return self.bodies.counts.shape[1]

    def body_labels(self, frame: int) -> np.ndarray:
        """Body of every point of a frame, (N,) int32; -1: none."""
        return self.body[self.point_ellipsoids[frame]]

    @property
    def labels(self) -> tuple[np.ndarray, ...]:
        """Body of every point of every frame, T arrays (N_t,) int32."""
        return tuple(self.body_labels(frame) for frame in range(len(self.point_ellipsoids)))
