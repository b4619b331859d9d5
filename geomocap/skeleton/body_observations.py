"""What is seen of the points of an articulated subject, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.motion_paths import DEPTH_FRACTION

INFLUENCES = 4  # bodies that may move a point, at most
LEAST_FRACTION = 0.01  # of a point; what follows a body less does not follow it


@dataclass(frozen=True)
class SkinPoints:
    """N points of the surface at rest, each following a body or a blend of some (linear blend skinning).

    Attributes
    ----------
    rest : (N, 3) float, metres, world
    bodies : (N, C) int32
        The largest fraction first.
    fractions : (N, C) float
        They sum to one; 0: does not follow.
    """

    rest: np.ndarray
    bodies: np.ndarray
    fractions: np.ndarray

    @classmethod
    def of_weights(cls, rest: np.ndarray, weights: np.ndarray) -> SkinPoints:
        """Points that follow the bodies of largest weight, of weights (N, B)."""
        order = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
        fractions = np.take_along_axis(weights, order, axis=1)
        fractions = np.where(fractions < LEAST_FRACTION, 0.0, fractions)
        total = fractions.sum(axis=1, keepdims=True)
        if (total <= 0).any():
            raise GeometryError("skin points: a point without weights; leave such points out")
        return cls(np.asarray(rest, float), order.astype(np.int32), fractions / total)

    def __len__(self) -> int:
        return len(self.rest)

    def joined(self, other: SkinPoints) -> SkinPoints:
        """Return these points, then those of another."""
        most = max(self.bodies.shape[1], other.bodies.shape[1])
        bodies, fractions = (
            np.concatenate([np.pad(a, ((0, 0), (0, most - a.shape[1]))) for a in both])
            for both in ((self.bodies, other.bodies), (self.fractions, other.fractions))
        )
        return SkinPoints(np.concatenate([self.rest, other.rest]), bodies, fractions)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What kernels take."""
        return self.rest, self.bodies, self.fractions

    def weights(self, count: int) -> np.ndarray:
        """Skin weights (N, count) of all bodies."""
        result = np.zeros((len(self), count))
        np.add.at(result, (np.arange(len(self))[:, None], self.bodies), self.fractions)
        return result

    @property
    def body(self) -> np.ndarray:
        """Body that a point follows most, (N,) int."""
        return self.bodies[:, 0]


@dataclass(frozen=True)
class Observations:
    """M observations of points in T frames, sorted by frame.

    Attributes
    ----------
    start : (T + 1,) int64
        Observations of frame t are those from start[t] to start[t + 1].
    point : (M,) int32
    target : (M, 3) float, metres, world
        Where the point was seen.
    normal : (M, 3) float
        Unit direction of `across`.
    isotropic : (M,) float, 1 / metres²
        Weight of the distance from the target in all directions.
    across : (M,) float, 1 / metres²
        Weight of the distance along the normal, in addition; negative where that is known worse.
    """

    start: np.ndarray
    point: np.ndarray
    target: np.ndarray
    normal: np.ndarray
    isotropic: np.ndarray
    across: np.ndarray

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.start) - 1

    @property
    def frame(self) -> np.ndarray:
        """Frame of each observation, (M,) int."""
        return np.repeat(np.arange(self.frames), np.diff(self.start))

    def arrays(self, frames: slice) -> tuple[np.ndarray, ...]:
        """Return what kernels take, for some frames: all observations, and where those of each frame begin."""
        start = self.start[frames.start : frames.stop + 1]
        return start, self.point, self.target, self.normal, self.isotropic, self.across

    @classmethod
    def of_paths(
        cls,
        positions: np.ndarray,
        sigma: np.ndarray,
        first_point: int = 0,
        ray: np.ndarray | None = None,
        depth: float = DEPTH_FRACTION,
    ) -> Observations:
        """Observations of points along their paths.

        Parameters
        ----------
        positions : (N, T, 3) float, metres
            NaN where not seen.
        sigma : (N, T) float, metres
        first_point : int
            Number of the first path's point.
        ray : (N, T, 3) float, optional
            Directions along which positions are unsure, see `MotionPaths`.
        depth : float
            Fraction of what is missed along these that counts.
        """
        frame, point = np.nonzero(np.isfinite(positions[:, :, 0]).T)
        start = np.searchsorted(frame, np.arange(positions.shape[1] + 1))
        target = positions[point, frame]
        weight = 1.0 / sigma[point, frame] ** 2
        numbers = (point + first_point).astype(np.int32)
        if ray is None:
            up = np.tile([0.0, 0.0, 1.0], (len(target), 1))  # no view: kernels would be compiled for both
            return cls(start, numbers, target, up, weight, np.zeros(len(weight)))
        return cls(start, numbers, target, ray[point, frame], weight, (depth**2 - 1.0) * weight)

    @classmethod
    def of_frames(cls, frames: Sequence[tuple[np.ndarray, ...]]) -> Observations:
        """Observations from their (point, target, normal, isotropic, across) of each frame."""
        start = np.concatenate([[0], np.cumsum([len(f[0]) for f in frames])])
        point, target, normal, isotropic, across = (np.concatenate([f[k] for f in frames]) for k in range(5))
        return cls(start, point.astype(np.int32), target, normal, isotropic, across)

    def renumbered(self, first_point: int) -> Observations:
        """The same of points that are counted from another number on."""
        return replace(self, point=self.point + np.int32(first_point))

    def joined(self, other: Observations) -> Observations:
        """Both, frame by frame."""
        order = np.argsort(np.concatenate([self.frame, other.frame]), kind="stable")
        names = ("point", "target", "normal", "isotropic", "across")
        both = [np.concatenate([getattr(self, n), getattr(other, n)])[order] for n in names]
        return Observations(self.start + other.start, *both)
