"""Trajectories: points of the surface through time, with gaps, precision, and why they ended."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields

import numpy as np

from geomocap.errors import GeometryError

REASONS = (
    "followed to the last frame",
    "seen by too few cameras",
    "low correlation",
    "low precision",
    "apart from its neighbours",
    "too fast",
    "accelerated too much",
    "unlike the motion around it",
    "too short",
    "outside the silhouettes",
    "beside an older one",
)
"""Why a trajectory ends (or begins no earlier), by number."""

_AT_ONCE = 2048  # rows that are moved

LAST_FRAME, UNSEEN, LOW_CORRELATION, LOW_PRECISION, APART, TOO_FAST, TOO_JERKY, UNLIKE, TOO_SHORT, OUTSIDE, DOUBLE = (
    range(11)
)


@dataclass(frozen=True)
class Trajectories:
    """N points over T frames.

    Attributes
    ----------
    positions : (N, T, 3) float, metres, world
        NaN where a point was not measured.
    rotations : (N, T, 3, 3) float
        Turn of the surface round the point since its first frame, world axes; NaN where not measured.
    sigma : (N, T) float, metres
        Standard deviation of a coordinate.
    correlation : (N, T) float
        Mean correlation over the cameras that saw it.
    n_views : (N, T) int
        Cameras that saw it, 0 where it was not measured.
    ray : (N, T, 3) float
        Unit vectors from the only camera that saw it, along which its depth is unsure; 0 where several did, or none.
    normals : (N, 3) float
        Outward normal of the surface in the frame `placed`.
    placed : (N,) int
        Frame in which the point was put on the surface; it is followed forward and backward from there.
    end_reason, begin_reason : (N,) int
        Why it was not followed further, forward and backward: number in `REASONS`.
    """

    positions: np.ndarray
    rotations: np.ndarray
    sigma: np.ndarray
    correlation: np.ndarray
    n_views: np.ndarray
    ray: np.ndarray
    normals: np.ndarray
    placed: np.ndarray
    end_reason: np.ndarray
    begin_reason: np.ndarray

    def __post_init__(self) -> None:
        if self.positions.ndim != 3 or self.positions.shape[2] != 3:
            raise GeometryError(f"trajectories: positions have shape {self.positions.shape}, expected (N, T, 3)")
        N, T = self.positions.shape[:2]
        shapes = {
            "rotations": (N, T, 3, 3),
            "sigma": (N, T),
            "correlation": (N, T),
            "n_views": (N, T),
            "ray": (N, T, 3),
            "normals": (N, 3),
            "placed": (N,),
            "end_reason": (N,),
            "begin_reason": (N,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise GeometryError(f"trajectories: {name} has shape {getattr(self, name).shape}, expected {shape}")

    @classmethod
    def of_positions(cls, positions: np.ndarray, **known: np.ndarray) -> Trajectories:
        """Return trajectories of which only the positions (N, T, 3) are known, and what else is named."""
        if positions.ndim != 3:
            raise GeometryError(f"trajectories: positions have shape {positions.shape}, expected (N, T, 3)")
        count, frames = positions.shape[:2]
        unknown = {
            "rotations": np.broadcast_to(np.nan, (count, frames, 3, 3)),
            "sigma": np.broadcast_to(np.nan, (count, frames)),
            "correlation": np.broadcast_to(np.nan, (count, frames)),
            "n_views": np.isfinite(positions).all(axis=2).astype(int),
            "ray": np.broadcast_to(0.0, (count, frames, 3)),
            "normals": np.zeros((count, 3)),
            "placed": np.zeros(count, int),
            "end_reason": np.full(count, LAST_FRAME),
            "begin_reason": np.full(count, LAST_FRAME),
        }
        return cls(positions, **{**unknown, **known})

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def n_frames(self) -> int:
        """Number of frames T."""
        return self.positions.shape[1]

    @property
    def measured(self) -> np.ndarray:
        """Where points have a position, (N, T) bool."""
        return np.isfinite(self.positions[:, :, 0])

    @property
    def start(self) -> np.ndarray:
        """First frame with a position, (N,) int; T where there is none."""
        found = self.measured
        return np.where(found.any(axis=1), found.argmax(axis=1), self.n_frames)

    @property
    def end(self) -> np.ndarray:
        """Last frame with a position, (N,) int; −1 where there is none."""
        found = self.measured
        return np.where(found.any(axis=1), self.n_frames - 1 - found[:, ::-1].argmax(axis=1), -1)

    @property
    def lengths(self) -> np.ndarray:
        """Number of frames with a position, (N,) int."""
        return self.measured.sum(axis=1)

    def select(self, which: np.ndarray) -> Trajectories:
        """Return some of them, by a mask or by positions."""
        return Trajectories(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def narrowed(self, which: np.ndarray) -> Trajectories:
        """Return some of them, ascending positions, in the memory of these, which are of no use afterwards.

        Long recordings have many trajectories: there is no room for both.
        """
        return Trajectories(**{f.name: _moved_up(getattr(self, f.name), which) for f in fields(self)})

    def clear(self, drop: np.ndarray) -> None:
        """Take away, in place, what was measured where `drop` (N, T) is true."""
        for values in (self.positions, self.rotations, self.sigma, self.correlation):
            values[drop] = np.nan
        for values in (self.n_views, self.ray):
            values[drop] = 0

    def reasons(self) -> dict[str, int]:
        """Count why the trajectories end."""
        found = Counter(int(r) for r in self.end_reason)
        return {REASONS[r]: found[r] for r in sorted(found)}


def _moved_up(values: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Rows `which`, ascending, of an array, moved to its beginning; a copy of them where it can't be written to."""
    if not values.flags.writeable:
        return values[which]
    for begin in range(0, len(which), _AT_ONCE):
        some = which[begin : begin + _AT_ONCE]
        values[begin : begin + len(some)] = values[some]
    return values[: len(which)]


@dataclass(frozen=True)
class TracksByFrame:
    """N points over T frames, as each frame shows them: what isn't measured takes no memory.

    Attributes
    ----------
    who : (M,) int
        Number of the point of each position; frame after frame, ascending within one.
    positions : (M, 3) float, metres, world
    sigma : (M,) float, metres
        Standard deviation of a coordinate; NaN where not known.
    begin : (T + 1,) int
        Where each frame begins among them.
    count : int
        Number of points N.
    """

    who: np.ndarray
    positions: np.ndarray
    sigma: np.ndarray
    begin: np.ndarray
    count: int

    @classmethod
    def of(cls, tracks: Trajectories) -> TracksByFrame:
        """Arrange trajectories by frame."""
        frame, who = np.nonzero(tracks.measured.T)
        begin = np.searchsorted(frame, np.arange(tracks.n_frames + 1))
        return cls(who, tracks.positions[who, frame], tracks.sigma[who, frame], begin, len(tracks))

    @property
    def n_frames(self) -> int:
        """Number of frames T."""
        return len(self.begin) - 1

    def at(self, frame: int) -> slice:
        """Return where the positions of a frame are."""
        return slice(int(self.begin[frame]), int(self.begin[frame + 1]))


@dataclass(frozen=True)
class PathDerivatives:
    """Smoothed motion of N points over T frames; NaN where too few frames are near.

    Attributes
    ----------
    velocities : (N, T, 3) float, m/s
    accelerations : (N, T, 3) float, m/s²
    velocity_std, acceleration_std : (N, T) float
        Standard deviation of each coordinate that the measurement's noise leaves.
    """

    velocities: np.ndarray
    accelerations: np.ndarray
    velocity_std: np.ndarray
    acceleration_std: np.ndarray


@dataclass(frozen=True)
class Tracks:
    """Trajectories as they are stored: filtered, with their motion.

    Attributes
    ----------
    trajectories : Trajectories
        (N, T, …), those that the filters left.
    motion : PathDerivatives
        Of the same points.
    unfiltered : (M, T, 3) float, metres, optional
        All trajectories before the filters.
    kept : (N,) int, optional
        Row of each trajectory in `unfiltered`.
    """

    trajectories: Trajectories
    motion: PathDerivatives
    unfiltered: np.ndarray | None = None
    kept: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = self.trajectories.positions.shape
        if self.motion.velocities.shape != shape:
            raise GeometryError(f"tracks: velocities have shape {self.motion.velocities.shape}, expected {shape}")
        if (self.unfiltered is None) != (self.kept is None):
            raise GeometryError("tracks: unfiltered trajectories go with the rows of those kept")
        if self.unfiltered is not None and self.kept is not None:
            if len(self.kept) != shape[0] or (self.kept >= len(self.unfiltered)).any():
                raise GeometryError(f"tracks: {len(self.kept)} rows of {len(self.unfiltered)} for {shape[0]} tracks")
