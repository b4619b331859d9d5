"""Key-points: points put anywhere on or in the subject, moved by the trajectories around them.

A key-point is a centre and a radius at one frame. It moves with the trajectories inside (D'Apuzzo 2003: by their mean
displacement); here by the rigid motion that fits them best, which is their mean displacement for a point amid them
and right for one at their side, and robustly, so that a single drifting trajectory has no say. Trajectories that come
into the region later take part from then on if they move alike: an arm that swings past a hip doesn't. Where none is
measured inside, the body that the point sits on (all within three radii) bridges the gap, and the frame is marked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError
from geomocap.tracking.trajectories import Trajectories

_BODY = 3.0  # radii within which trajectories bridge gaps
_LEAST = 3  # trajectories that a rigid motion needs
_OTHER = 0.03  # m; misfit from which a trajectory is taken for one of another body
_ALIKE = 0.003  # m; largest shift within one frame, in the key-point's axes, of a trajectory that joins in
_SCALE = 0.004  # m; misfit from which a trajectory counts less


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
        Trajectories that it was moved by.
    """

    positions: np.ndarray
    bridged: np.ndarray
    n_tracks: np.ndarray


def follow_keypoints(tracks: Trajectories, centers: np.ndarray, radii: np.ndarray, frame: int) -> KeyPointPaths:
    """Follow key-points from one frame forward and backward.

    Parameters
    ----------
    tracks : Trajectories
    centers : (K, 3) float, metres, world
        Places at `frame`.
    radii : (K,) float, metres
    frame : int

    Raises
    ------
    GeometryError
        If the frame doesn't exist or the arrays don't fit.
    """
    T = tracks.n_frames
    centers, radii = np.asarray(centers, float).reshape(-1, 3), np.asarray(radii, float).ravel()
    if not 0 <= frame < T:
        raise GeometryError(f"key-points are placed in frame {frame}, but there are frames 0 to {T - 1}")
    if len(radii) != len(centers) or not (radii > 0).all():
        raise GeometryError(f"{len(centers)} key-points and radii {radii.tolist()}: each needs a radius above 0 m")
    K = len(centers)
    positions, bridged, count = np.full((T, K, 3), np.nan), np.zeros((T, K), bool), np.zeros((T, K), int)
    for k in range(K):
        for order in (range(frame, T), range(frame, -1, -1)):
            _follow(tracks, centers[k], float(radii[k]), order, positions[:, k], bridged[:, k], count[:, k])
    return KeyPointPaths(positions, bridged, count)


def _follow(
    tracks: Trajectories,
    center: np.ndarray,
    radius: float,
    order: range,
    positions: np.ndarray,
    bridged: np.ndarray,
    count: np.ndarray,
) -> None:
    """Follow one key-point through the frames of `order`, the first of which it was placed in."""
    N = len(tracks)
    turn, place = np.eye(3), center.copy()
    # places of trajectories in the key-point's own axes, and whether they were there from the beginning
    local = np.full((N, 3), np.nan)
    first = np.zeros(N, bool)
    before = np.full((N, 3), np.nan)
    for t in order:
        x = tracks.positions[:, t]
        seen = tracks.measured[:, t]
        known = seen & np.isfinite(local[:, 0])
        inside = known & (np.linalg.norm(np.nan_to_num(local), axis=1) <= radius)
        if t == order[0]:
            moved = True
        else:
            voters, moved = inside, True
            for choice in (inside & first, inside, known & first, known):
                voters = choice
                if choice.sum() >= _LEAST:
                    break
            else:
                moved = bool(voters.any())
            if moved:
                turn, place = _rigid(local[voters], x[voters], turn)
                bridged[t] = not inside[voters].all()
                count[t] = int(voters.sum())
        if moved:
            positions[t] = place
            here = (x - place) @ turn
            # who has come to move otherwise sits on another body; who moves alike and is near takes part
            with np.errstate(invalid="ignore"):
                local[np.linalg.norm(here - local, axis=1) > _OTHER] = np.nan
                near = ~np.isfinite(local[:, 0]) & (np.linalg.norm(here, axis=1) <= _BODY * radius)
                near &= (np.linalg.norm(here - before, axis=1) < _ALIKE) | (t == order[0])
            local[near] = here[near]
            before = here
            if t == order[0]:
                first |= near
                count[t] = int((near & (np.linalg.norm(np.nan_to_num(local), axis=1) <= radius)).sum())
                bridged[t] = count[t] < _LEAST


def _rigid(local: np.ndarray, world: np.ndarray, last_turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit world = R local + t robustly: R (3, 3), t (3,). With fewer than three points R stays as it was."""
    weight = np.ones(len(local))
    turn = last_turn
    place = np.median(world - local @ turn.T, axis=0)
    for _ in range(5):
        total = weight.sum()
        a, b = weight @ local / total, weight @ world / total
        if len(local) >= _LEAST:
            # the last turn steadies directions that the points hardly determine
            steady = (0.25 * _SCALE) ** 2 * total
            U, _, Vt = np.linalg.svd(((world - b) * weight[:, None]).T @ (local - a) + steady * last_turn)
            turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        place = b - turn @ a
        miss = np.linalg.norm(world - local @ turn.T - place, axis=1)
        weight = 1 / (1 + (miss / _SCALE) ** 2)
    return turn, place
