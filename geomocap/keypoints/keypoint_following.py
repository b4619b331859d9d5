"""Key-points: points put anywhere on or in the subject, moved by the trajectories around them.

A key-point is a centre and a radius at one frame. It moves with the trajectories inside (D'Apuzzo 2003: by their mean
displacement); here by the rigid motion that fits them best, which is their mean displacement for a point amid them
and right for one at their side. Each trajectory counts by how well it can tell where the point is: less if it is far
(skin isn't rigid), if it came later, when the point's own place was no longer certain, and if it has moved otherwise
before: an arm that swings past a hip has no say. So where none is measured inside, those of the body that the point
sits on (within four radii) bridge the gap by themselves, and the frame is marked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.keypoint_paths import KeyPointPaths
from geomocap.model.rotations import rigid_motion
from geomocap.model.trajectories import TracksByFrame, Trajectories

REACH = 4.0
"""Radii within which trajectories bridge gaps."""

_LEAST = 3  # trajectories inside that a frame needs not to be bridged; those that a turn needs
_NOISE = 5e-4  # diagonals; what a trajectory drifts between frames that its stated precision doesn't know
_SOFT = 0.15  # standard deviation of skin against a rigid body, fraction of the distance; steeper beyond the radius
_MEMORY = 12.0  # weight of the largest misfit before in a trajectory's variance
_ALIKE = 1.5e-3  # diagonals; largest shift within one frame, in the key-point's axes, of a trajectory that joins in
_LOST = 0.5  # radii; standard deviation from which a key-point counts as lost
_STEADY = 5e-4  # diagonals; how far points may be apart to determine a turn, against the last one


@dataclass(frozen=True)
class Measured:
    """Trajectories frame by frame, as key-points read them.

    Attributes
    ----------
    tracks : TracksByFrame
    variance : (M,) float, metres²
        Of each of its positions.
    diagonal : float, metres
        Of the box around a frame's trajectories: the median of all frames.
    """

    tracks: TracksByFrame
    variance: np.ndarray
    diagonal: float

    @classmethod
    def of(cls, tracks: Trajectories | TracksByFrame) -> Measured:
        """Arrange trajectories by frame; unknown precision counts as good."""
        found = TracksByFrame.of(tracks) if isinstance(tracks, Trajectories) else tracks
        seen = [x for t in range(found.n_frames) if len(x := found.positions[found.at(t)])]
        diagonal = float(np.median([np.linalg.norm(np.ptp(x, axis=0)) for x in seen])) if seen else 0.0
        return cls(found, np.nan_to_num(found.sigma**2, nan=0.0) + (_NOISE * diagonal) ** 2, diagonal)

    @property
    def n_frames(self) -> int:
        """Number of frames T."""
        return self.tracks.n_frames


def follow_keypoints(
    tracks: Trajectories | Measured, centers: np.ndarray, radii: np.ndarray, frame: int
) -> KeyPointPaths:
    """Follow key-points from one frame forward and backward.

    Parameters
    ----------
    tracks : Trajectories or Measured
    centers : (K, 3) float, metres, world
        Places at `frame`.
    radii : (K,) float, metres
    frame : int

    Raises
    ------
    GeometryError
        If the frame doesn't exist or the arrays don't fit.
    """
    measured = tracks if isinstance(tracks, Measured) else Measured.of(tracks)
    T = measured.n_frames
    centers, radii = np.asarray(centers, float).reshape(-1, 3), np.asarray(radii, float).ravel()
    if not 0 <= frame < T:
        raise GeometryError(f"key-points are placed in frame {frame}, but there are frames 0 to {T - 1}")
    if len(radii) != len(centers) or not (radii > 0).all():
        raise GeometryError(f"{len(centers)} key-points and radii {radii.tolist()}: each needs a radius above 0 m")
    K = len(centers)
    paths = KeyPointPaths(
        np.full((T, K, 3), np.nan), np.zeros((T, K), bool), np.zeros((T, K), int), np.full((T, K), np.nan)
    )
    for k in range(K):
        for order in (range(frame, T), range(frame, -1, -1)):
            _follow(measured, centers[k], float(radii[k]), order, paths, k)
    return paths


@dataclass(frozen=True)
class _Placement:
    """Where the key-point is in a frame: its axes and place in the world, and the variance of the place."""

    turn: np.ndarray
    place: np.ndarray
    variance: float

    def local(self, points: np.ndarray) -> np.ndarray:
        """Return world points in the key-point's axes."""
        return (points - self.place) @ self.turn


def _follow(measured: Measured, center: np.ndarray, radius: float, order: range, paths: KeyPointPaths, k: int) -> None:
    """Follow one key-point through the frames of `order`, the first of which it was placed in."""
    tracks = measured.tracks
    local = np.full((tracks.count, 3), np.nan)  # places of trajectories in the key-point's axes
    # variance of the key-point's place when they joined; infinite for those that haven't
    joined = np.full(tracks.count, np.inf)
    misfit = np.zeros(tracks.count)  # largest so far, squared
    pose = _Placement(np.eye(3), center, 0.0)
    last: tuple[int, _Placement] | None = None
    for t in order:
        there = tracks.at(t)
        who, x = tracks.who[there], tracks.positions[there].astype(float)
        if last is None:
            paths.std[t, k] = 0.0
        else:
            here = np.flatnonzero(np.isfinite(joined[who]))
            known = who[here]
            if not len(known):
                continue
            a = local[known]
            distance = np.linalg.norm(a, axis=1)
            soft = (_SOFT * distance) ** 2 * (1 + (distance / radius) ** 2)
            variance = measured.variance[there][here] + joined[known] + _MEMORY * misfit[known] + soft
            moved, miss = _fit(a, x[here], variance, pose.turn, _STEADY * measured.diagonal)
            if moved.variance > (_LOST * radius) ** 2:
                continue
            pose = moved
            misfit[known] = np.maximum(misfit[known], miss**2)
            inside = int((distance <= radius).sum())
            paths.bridged[t, k] = inside < _LEAST
            paths.n_tracks[t, k] = len(known) if inside < _LEAST else inside
            paths.std[t, k] = np.sqrt(pose.variance)
        paths.positions[t, k] = pose.place
        distance = np.linalg.norm(x - pose.place, axis=1)
        new = np.flatnonzero((distance <= REACH * radius) & np.isinf(joined[who]))
        if last is None:
            inside = int((distance[new] <= radius).sum())
            paths.bridged[t, k] = inside < _LEAST
            paths.n_tracks[t, k] = len(new) if inside < _LEAST else inside
        else:  # who moves alike joins in
            shift = pose.local(x[new]) - last[1].local(_places(tracks, last[0], who[new]))
            new = new[np.linalg.norm(shift, axis=1) < _ALIKE * measured.diagonal]
        local[who[new]] = pose.local(x[new])
        joined[who[new]] = pose.variance
        last = t, pose


def _places(tracks: TracksByFrame, frame: int, who: np.ndarray) -> np.ndarray:
    """Positions of some points in a frame, (K, 3); NaN of those that it doesn't show."""
    there = tracks.at(frame)
    shown = tracks.who[there]
    found = np.full((len(who), 3), np.nan)
    at = np.minimum(np.searchsorted(shown, who), len(shown) - 1)
    has = shown[at] == who if len(shown) else np.zeros(len(who), bool)
    found[has] = tracks.positions[there][at[has]]
    return found


def _fit(
    local: np.ndarray, world: np.ndarray, variance: np.ndarray, last_turn: np.ndarray, steady: float
) -> tuple[_Placement, np.ndarray]:
    """Fit world = R local + t robustly, and return it with the misfits (N,). With fewer than three points R stays."""
    weight, turn = 1 / variance, last_turn
    for _ in range(6):
        if len(local) >= _LEAST:
            # the last turn steadies directions that the points hardly determine
            turn, place = rigid_motion(local, world, weight, prior=steady**2 * last_turn)
        else:
            place = weight @ (world - local @ turn.T) / weight.sum()
        miss = np.linalg.norm(world - local @ turn.T - place, axis=1)
        weight = 1 / (variance + miss**2)
    # trajectories all on one side share what the skin between does
    aside = float(np.linalg.norm(weight @ local)) / float(weight.sum())
    return _Placement(turn, place, 1 / float(weight.sum()) + (_SOFT * aside) ** 2), miss
