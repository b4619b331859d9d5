"""Trajectories of the same surface point joined: a patch placed while an older one was lost, which was found again."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.rotations import nearest_rotation
from geomocap.model.trajectories import Trajectories
from geomocap.scheduling import map_here

_NEAR = 0.75  # of the typical distance of neighbours: nearer than patches are placed
_STEADY = 0.1  # of the same: how much the one may move against the other
_COMMON = 3  # frames in which both are measured


def join_broken(tracks: Trajectories) -> Trajectories:
    """Join trajectories that keep their places in one another's frames.

    Of two that are nearer than patches are placed, the one with fewer frames is given up where in all frames that both
    have (at least three) it stays where it is in the patch frame of the other; its further frames go over to the
    other, carried by its shift and turn. Those that add most go first. The standard deviation of what was taken over
    has that of the relative place added.

    The arrays of `tracks` are worked on in place, as those of a long recording fill the memory: it is of no use
    afterwards.
    """
    if not len(tracks):
        return tracks
    typical = _typical_distance(tracks)
    arrays = {f.name: getattr(tracks, f.name) for f in fields(tracks)}
    measured = tracks.measured
    alive = np.ones(len(tracks), bool)
    pairs = _near_pairs(tracks, _NEAR * typical)
    first, second = pairs.T
    swap = measured[first].sum(axis=1) < measured[second].sum(axis=1)
    keep, give = np.where(swap, second, first), np.where(swap, first, second)
    gain = (measured[give] & ~measured[keep]).sum(axis=1)
    for n in np.argsort(-gain, kind="stable"):
        i, j = int(keep[n]), int(give[n])
        if not (alive[i] and alive[j]):
            continue
        has, other = measured[i].copy(), measured[j]
        common, extra = has & other, other & ~has
        if common.sum() < _COMMON:
            continue
        turn = arrays["rotations"][j]
        arm = np.einsum("tji,tj->ti", turn[common], arrays["positions"][i, common] - arrays["positions"][j, common])
        middle = np.median(arm, axis=0)
        spread = float(np.sqrt(((arm - middle) ** 2).sum(axis=1).mean()))
        if spread > _STEADY * typical:
            continue
        alive[j] = False
        measured[i] |= extra
        between = nearest_rotation((np.swapaxes(turn[common], 1, 2) @ arrays["rotations"][i, common]).sum(axis=0))
        arrays["positions"][i, extra] = arrays["positions"][j, extra] + turn[extra] @ middle
        arrays["rotations"][i, extra] = turn[extra] @ between
        arrays["sigma"][i, extra] = np.hypot(arrays["sigma"][j, extra], spread / np.sqrt(3))
        for name in ("correlation", "n_views", "ray"):
            arrays[name][i, extra] = arrays[name][j, extra]
        ends = np.flatnonzero(extra)
        if len(ends) and ends[-1] > np.flatnonzero(has)[-1]:
            arrays["end_reason"][i] = arrays["end_reason"][j]
        if len(ends) and ends[0] < np.flatnonzero(has)[0]:
            arrays["begin_reason"][i] = arrays["begin_reason"][j]
    return tracks.narrowed(np.flatnonzero(alive))


def _typical_distance(tracks: Trajectories) -> float:
    """Median distance of the nearest neighbour in the frame with the most points, metres; 0 without neighbours."""
    frame = int(tracks.measured.sum(axis=0).argmax())
    points = tracks.positions[tracks.measured[:, frame], frame]
    return float(np.median(cKDTree(points).query(points, 2)[0][:, 1])) if len(points) > 1 else 0.0


def _near_pairs(tracks: Trajectories, distance: float) -> np.ndarray:
    """Pairs of trajectories that come nearer than `distance` in some frame, (P, 2) int, ascending."""
    measured = tracks.measured

    def at(t: int) -> np.ndarray:
        rows = np.flatnonzero(measured[:, t])
        if len(rows) < 2:
            return np.zeros((0, 2), int)
        pairs = cKDTree(tracks.positions[rows, t]).query_pairs(distance, output_type="ndarray")
        return np.sort(rows[pairs], axis=1)

    return np.unique(np.concatenate([np.zeros((0, 2), int), *map_here(at, range(tracks.n_frames))]), axis=0)
