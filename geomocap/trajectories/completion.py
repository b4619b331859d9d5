"""Gaps in motion paths filled by the motion of the neighbours."""

from __future__ import annotations

import numba
import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.even_choice import evenly_chosen
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.small_systems import nearest_turn
from geomocap.scheduling import map_here, spread

_COMPANIONS = 48  # of those, mostly few are seen where a sample is not
_CANDIDATES = 24
_STEEPNESS = 4  # of positions filled in eight hard captures the worst tenth erred least with 3 or 4, of 2, 3 and 4
_LEAST_COMMON = 6


def nearest_companions(
    positions: np.ndarray, seen: np.ndarray, wanted: int, across_gaps: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Samples that are near and keep their distance while both are seen.

    Each sample is compared with the nearest in up to 20 of the frames in which it is seen; `across_gaps` also with the
    nearest of those that are seen longer than most: where a side of a turning body goes out of sight, all that is near
    goes with it.

    Returns
    -------
    companions : (N, wanted) int
        The best first; the sample itself where there are no more.
    costs : (N, wanted) float, metres
        Mean distance and four times its standard deviation; more where they are seldom seen together, infinite for the
        sample itself.
    """
    count, frames = seen.shape
    lengths = seen.sum(axis=1)
    long = lengths >= np.median(lengths)
    rows_list, columns_list = [], []
    for t in evenly_chosen(frames, 20):
        alive = np.flatnonzero(seen[:, t])
        for others in (alive, alive[long[alive]])[: 1 + across_gaps]:
            near = min(_CANDIDATES + 1, len(others))
            if near < 2:
                continue
            found = cKDTree(positions[others, t]).query(positions[alive, t], near)[1]
            rows_list.append(np.repeat(alive, near))
            columns_list.append(others[found].ravel())
    result, costs = np.tile(np.arange(count)[:, None], (1, wanted)), np.full((count, wanted), np.inf)
    if not rows_list:
        return result, costs
    keys = np.unique(np.concatenate(rows_list) * count + np.concatenate(columns_list))
    pairs = np.stack(np.divmod(keys, count), axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    cost = np.empty(len(pairs))
    spread(_pair_costs, len(pairs), positions, seen, pairs[:, 0].copy(), pairs[:, 1].copy(), cost)
    order = np.lexsort((cost, pairs[:, 0]))
    pairs = pairs[order]
    first = np.searchsorted(pairs[:, 0], np.arange(count))
    rank = np.arange(len(pairs)) - first[pairs[:, 0]]
    kept = rank < wanted
    result[pairs[kept, 0], rank[kept]] = pairs[kept, 1]
    costs[pairs[kept, 0], rank[kept]] = cost[order[kept]]
    return result, costs


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pair_cost(i, j, positions, seen):
    """Mean distance of two samples plus four times how much it varies; more where they are seldom seen together."""
    total, squares, common = 0.0, 0.0, 0
    for t in range(seen.shape[1]):
        if seen[i, t] and seen[j, t]:
            square = 0.0
            for c in range(3):
                square += (positions[i, t, c] - positions[j, t, c]) ** 2
            total += np.sqrt(square)
            squares += square
            common += 1
    mean = total / max(common, 1)
    spread = np.sqrt(max(squares / max(common, 1) - mean * mean, 0.0))
    return (mean + 4.0 * spread) * (1.0 if common >= _LEAST_COMMON else 3.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pair_costs(begin, end, positions, seen, first, second, result):
    for p in range(begin, end):
        result[p] = _pair_cost(first[p], second[p], positions, seen)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carry_on(
    positions: np.ndarray,
    known: np.ndarray,
    certainty: np.ndarray,
    companions: np.ndarray,
    shares: np.ndarray,
    order: np.ndarray,
    fade: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill frames one after another: a missing sample moves as its companions do between two frames."""
    count, frames = known.shape
    filled = positions.copy()
    sure = certainty.copy()
    done = known.copy()
    rotation = np.empty((3, 3))
    for step in range(1, frames):
        before, now = order[step - 1], order[step]
        # twice: those with companions seen in both frames, then those that only have filled ones
        for turn in range(2):
            for i in range(count):
                if done[i, now] or not done[i, before]:
                    continue
                total = 0.0
                a = np.zeros(3)
                b = np.zeros(3)
                number = 0
                for q in range(companions.shape[1]):
                    j = companions[i, q]
                    if j == i or not done[j, before] or not done[j, now]:
                        continue
                    w = shares[i, q] * sure[j, before] * sure[j, now]
                    total += w
                    number += 1
                    for c in range(3):
                        a[c] += w * filled[j, before, c]
                        b[c] += w * filled[j, now, c]
                if number < 3 and (turn == 0 or number == 0):
                    continue
                for c in range(3):
                    a[c] /= total
                    b[c] /= total
                moment = np.zeros((3, 3))
                for q in range(companions.shape[1]):
                    j = companions[i, q]
                    if j == i or not done[j, before] or not done[j, now]:
                        continue
                    w = shares[i, q] * sure[j, before] * sure[j, now] / total
                    for c in range(3):
                        for d in range(3):
                            moment[c, d] += w * (filled[j, now, c] - b[c]) * (filled[j, before, d] - a[d])
                trace = moment[0, 0] + moment[1, 1] + moment[2, 2]
                for c in range(3):
                    moment[c, c] += 0.02 * abs(trace) + 1e-12
                nearest_turn(moment, rotation)
                for c in range(3):
                    value = b[c]
                    for d in range(3):
                        value += rotation[c, d] * (filled[i, before, d] - a[d])
                    filled[i, now, c] = value
                sure[i, now] = sure[i, before] * fade
                done[i, now] = True
    for i in range(count):
        for t in range(frames):
            if not done[i, t]:
                sure[i, t] = 0.0
    return filled, sure


def complete_tracks(paths: MotionPaths) -> tuple[np.ndarray, np.ndarray]:
    """Positions of all samples in all frames.

    A sample that is not seen is carried from the frame before (and from the one after) by the rigid motion of its
    companions: samples that are near and keep their distance, these most. Both directions are averaged with weights
    that fade from where the sample was seen last; what companions never reach stands still.

    Parameters
    ----------
    paths : MotionPaths

    Returns
    -------
    positions : (N, T, 3) float, metres
    certainty : (N, T) float
        1 where seen; less, the longer a gap; 0 where nothing is known.
    """
    seen = paths.seen
    if seen.all():
        return np.array(paths.positions, float), np.ones(seen.shape)
    start = np.where(seen[..., None], paths.positions, 0.0)
    companions, costs = nearest_companions(start, seen, _COMPANIONS, across_gaps=True)
    nearest = np.maximum(np.where(np.isfinite(costs[:, :1]), costs[:, :1], 1.0), 1e-12)  # 1: of itself alone
    shares = (nearest / np.maximum(costs, nearest)) ** _STEEPNESS
    frames = paths.frames
    forward, backward = np.arange(frames), np.arange(frames)[::-1].copy()
    fade = 0.9
    given = seen.astype(float)
    ways = map_here(lambda order: _carry_on(start, seen, given, companions, shares, order, fade), [forward, backward])
    (ahead, sure_ahead), (back, sure_back) = ways
    # samples that were filled in one direction only help to fill the rest in the other
    total = sure_ahead + sure_back
    known = total > 0
    fraction = np.where(known, sure_ahead / np.where(known, total, 1.0), 0.0)[..., None]
    filled = np.where(seen[..., None], start, fraction * ahead + (1.0 - fraction) * back)
    certainty = np.where(seen, 1.0, np.maximum(sure_ahead, sure_back))
    if not known.all():
        ahead, sure_ahead = _carry_on(filled, known, certainty, companions, shares, forward, fade)
        filled, certainty = _carry_on(ahead, sure_ahead > 0, sure_ahead, companions, shares, backward, fade)
    lost = certainty <= 0
    if lost.any():
        filled = _stand_still(filled, ~lost)
    return filled, certainty


def _stand_still(positions: np.ndarray, known: np.ndarray) -> np.ndarray:
    frames = np.arange(known.shape[1])
    result = positions.copy()
    for i in np.flatnonzero(~known.all(axis=1)):
        at = frames[known[i]]
        for c in range(3):
            result[i, :, c] = np.interp(frames, at, positions[i, at, c])
    return result
