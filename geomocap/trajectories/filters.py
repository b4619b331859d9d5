"""Filters of trajectories: too fast, accelerated too much, unlike the motion around them; each with its reason.

What is measured from the first bad frame on, counted away from the frame in which the point was placed, is cut off;
trajectories that become too short are removed (D'Apuzzo 2003, thresholds on velocity and acceleration and local
uniformity of the trajectories in space and time). The motion around a point is that of its neighbours as small rigid
bodies, so that a turning limb is uniform although no two of its points move alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.trajectories import REASONS, TOO_FAST, TOO_JERKY, TOO_SHORT, UNLIKE, PathDerivatives, Trajectories
from geomocap.scheduling import map_here
from geomocap.trajectories.trajectory_settings import FilterSettings

_MOVING = 0.995  # fraction of all points whose speed and acceleration are certainly true
_UNIFORM = 0.95  # fraction that certainly moves like the surface around it
_LEAST_UNLIKE = 1e-6  # m; rounding isn't motion
_NEIGHBOURS = 8
_AGREEING = 3


@dataclass(frozen=True)
class Filtered:
    """What the filters left.

    Attributes
    ----------
    trajectories : Trajectories
        Those left, with the filters' reasons among theirs.
    kept : (M,) int
        Row of each in the unfiltered trajectories.
    cut : dict
        For each reason, how many trajectories it cut or removed.
    fastest, acceleration, unlike : float
        Limits that were used: m/s, m/s² and m.
    """

    trajectories: Trajectories
    kept: np.ndarray
    cut: dict[str, int]
    fastest: float
    acceleration: float
    unlike: float


def filter_trajectories(
    tracks: Trajectories, motion: PathDerivatives, settings: FilterSettings | None = None
) -> Filtered:
    """Cut trajectories where they can't be true.

    Those left are in the memory of `tracks`, which are of no use afterwards.

    Parameters
    ----------
    tracks : Trajectories
    motion : PathDerivatives
        Smoothed motion of the same points.
    settings : FilterSettings, optional
    """
    settings = settings or FilterSettings()
    if not settings.on:
        return Filtered(tracks, np.arange(len(tracks)), {}, np.inf, np.inf, np.inf)
    speed = np.linalg.norm(motion.velocities, axis=2)
    change = np.linalg.norm(motion.accelerations, axis=2)
    fastest = settings.fastest or _limit(speed, _MOVING, settings.beyond_data)
    acceleration = settings.acceleration or _limit(change, _MOVING, settings.beyond_data)
    away = departure(tracks, settings.window)
    unlike = settings.unlike or max(_limit(away, _UNIFORM, settings.beyond_data), _LEAST_UNLIKE)
    with np.errstate(invalid="ignore"):
        tests = (
            (TOO_FAST, speed > fastest),
            (TOO_JERKY, change > acceleration),
            (UNLIKE, away > unlike),
        )
    cut = {}
    left, end, begin = tracks.measured, tracks.end_reason, tracks.begin_reason
    for reason, bad in tests:
        after, before = _beyond(bad & left, tracks.placed)
        left = left & ~(after | before)
        end = np.where(after.any(axis=1), reason, end)
        begin = np.where(before.any(axis=1), reason, begin)
        cut[REASONS[reason]] = int((after | before).any(axis=1).sum())
    kept = np.flatnonzero(left.sum(axis=1) >= settings.least_frames)
    cut[REASONS[TOO_SHORT]] = len(tracks) - len(kept)
    rest = replace(tracks, end_reason=end, begin_reason=begin).narrowed(kept)
    rest.clear(~left[kept])
    return Filtered(rest, kept, cut, fastest, acceleration, unlike)


def departure(tracks: Trajectories, window: int) -> np.ndarray:
    """Measure how far points come from where the motion around them leads.

    For each frame t the motion from t − `window` is compared with the rigid motions of the eight nearest points; the
    third best counts, as a point at a joint shares its motion with the few on its own side.

    Parameters
    ----------
    tracks : Trajectories
    window : int
        Frames.

    Returns
    -------
    (N, T) float
        Metres; NaN where too few neighbours are measured in both frames. The larger one of the comparisons with the
        frame before and the frame after.
    """
    N, T = tracks.positions.shape[:2]
    out = np.full((N, T), np.nan)
    measured = tracks.measured

    def at(t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        rows = np.flatnonzero(measured[:, t] & measured[:, t - window])
        if len(rows) <= _NEIGHBOURS:
            return None
        old, new = tracks.positions[rows, t - window], tracks.positions[rows, t]
        near = cKDTree(old).query(old, _NEIGHBOURS + 1)[1][:, 1:]
        turn = tracks.rotations[rows, t] @ np.swapaxes(tracks.rotations[rows, t - window], 1, 2)
        led = new[near] + np.einsum("nkij,nkj->nki", turn[near], old[:, None] - old[near])
        away = np.sort(np.linalg.norm(led - new[:, None], axis=2), axis=1)[:, _AGREEING - 1]
        # the frame farther from where a point was placed is the one in doubt
        later = np.abs(t - tracks.placed[rows]) >= np.abs(t - window - tracks.placed[rows])
        return rows, np.where(later, t, t - window), away

    for known in map_here(at, range(window, T)):
        if known is not None:
            rows, frame, away = known
            out[rows, frame] = np.fmax(out[rows, frame], away)
    return out


def _limit(values: np.ndarray, fraction: float, factor: float) -> float:
    known = values[np.isfinite(values)]
    return factor * float(np.quantile(known, fraction)) if len(known) else float("inf")


def _beyond(bad: np.ndarray, placed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find what lies beyond bad frames, (N, T) bool, seen from the frame of placing (N,): after it, and before it."""
    after = np.arange(bad.shape[1])[None] >= placed[:, None]
    behind = np.logical_or.accumulate(bad & after, axis=1)
    before = np.logical_or.accumulate((bad & ~after)[:, ::-1], axis=1)[:, ::-1]
    return behind, before
