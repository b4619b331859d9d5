"""Bringing another system's clock and world onto a run's, without knowing which marker is which.

Candidates for the time offset come from what no rigid motion changes: how spread out the points are and how fast they
move. For each, and for the rotations that lay the principal axes of the two clouds of trajectories on each other,
trajectories are matched and the rigid motion is fitted in turn, as iterative closest points (Besl & McKay 1992) do with
points. Each is refined, offset and rigid motion together, and the best is taken. A motion that repeats itself fits at
several offsets: among the equally good the smallest offset counts.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize_scalar

from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.marker_track import MarkerTrack
from geomocap.evaluation.result import Alignment, EvaluationError
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.rotations import rigid_motion

Pairs = list[tuple[int, int]]

CANDIDATE_OFFSETS = 10
ROUNDS, FEW_ROUNDS = 30, 8
FEW_FRAMES = 24
KEPT_STARTS = 2  # of the 24
TIE, TIE_M = 0.05, 0.002  # fits that are worse by no more than this are as good as the best
START_LIMIT, END_LIMIT = 0.5, 0.15  # fractions of the diagonal within which trajectories match, narrowing
FEWEST_FRAMES = 3


def align_trajectories(
    found: np.ndarray,
    times: np.ndarray,
    track: MarkerTrack,
    settings: EvaluationSettings,
    diagonal: float,
    pairs: Pairs | None = None,
) -> Alignment:
    """Find the time offset and the rigid motion that lay the truth on the run, as far as the settings ask for them.

    Parameters
    ----------
    found : (T, J, 3) float, metres
        NaN in gaps.
    times : (T,) float, seconds
    track : MarkerTrack
        The truth, at any time.
    settings : EvaluationSettings
    diagonal : float, metres
        Size of the subject.
    pairs : list of (joint, marker), optional
        Where it is known which marker is which joint.

    Raises
    ------
    EvaluationError
        If the recordings are too short, or nothing fits.
    """
    still = Alignment(np.eye(3), np.zeros(3), settings.offset)
    if not settings.align and not settings.find_offset:
        return still
    offsets = candidate_offsets(found, times, track, settings.max_offset) if settings.find_offset else [settings.offset]
    fits = []
    for offset in offsets:
        fit = _fit_at(offset, found, times, track, settings, diagonal, pairs)
        if fit is not None:
            fits.append(fit)
    if not fits:
        raise EvaluationError(
            "no time offset and alignment was found at which run and truth match; name the pairs in a TOML (--matches) "
            "or state the offset (--offset)"
        )
    good_enough = min(fit.cost for fit in fits) * (1 + TIE) + TIE_M
    return min((fit for fit in fits if fit.cost <= good_enough), key=lambda f: abs(f.alignment.time_offset)).alignment


@dataclass(frozen=True)
class _Fit:
    """An alignment, the trajectories that it matches, and their mean distance, metres, capped for the unmatched."""

    cost: float
    alignment: Alignment
    pairs: Pairs


def _fit_at(
    offset: float,
    found: np.ndarray,
    times: np.ndarray,
    track: MarkerTrack,
    settings: EvaluationSettings,
    diagonal: float,
    pairs: Pairs | None,
) -> _Fit | None:
    """Find the best alignment near a time offset: from all starts on a few frames, then from the best on all."""
    other = track.at(times + offset)
    starts = _starts(found, other) if settings.align else [Alignment(np.eye(3), np.zeros(3), offset)]
    if len(starts) > 1:
        few = evenly_chosen(len(found), FEW_FRAMES)
        tried = [_match_and_fit(found[few], other[few], s, diagonal, True, pairs, rounds=FEW_ROUNDS) for s in starts]
        ranked = sorted((fit for fit in tried if fit is not None), key=lambda fit: fit.cost)
        starts = [fit.alignment for fit in ranked[:KEPT_STARTS]]
    fits = [_match_and_fit(found, other, s, diagonal, settings.align, pairs) for s in starts]
    fit = min((f for f in fits if f is not None), key=lambda f: f.cost, default=None)
    if fit is None:
        return None
    alignment = replace(fit.alignment, time_offset=offset)
    for _ in range(2):
        if settings.find_offset:
            alignment = _refine_offset(found, times, track, alignment, fit.pairs, settings.align)
        other = track.at(times + alignment.time_offset)
        again = _match_and_fit(found, other, alignment, diagonal, settings.align, pairs, start_limit=END_LIMIT)
        if again is None:
            break
        fit, alignment = again, again.alignment
    return replace(fit, alignment=alignment)


def candidate_offsets(found: np.ndarray, times: np.ndarray, track: MarkerTrack, largest: float) -> list[float]:
    """Offsets at which spread and speed of the two sets of points run most alike, best first.

    They are looked for in steps of half a frame of the run, at least half of the shorter recording overlapping.
    """
    step = (times[1] - times[0]) / 2 if len(times) > 1 else 0.0
    if step == 0.0:
        raise EvaluationError("the run has one frame; a time offset can't be found from it")
    ours = _features(found, 2 * step)
    least = max(FEWEST_FRAMES + 2, 0.5 * min(len(times), track.duration / (2 * step)))
    grid = np.arange(-np.ceil(largest / step), np.ceil(largest / step) + 1) * step
    score = np.full(len(grid), -np.inf)
    for g, offset in enumerate(grid):
        theirs = _features(track.at(times + offset), 2 * step)
        both = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
        if both.sum() >= least:
            a, b = (x[both] - x[both].mean(axis=0) for x in (ours, theirs))
            norm = np.linalg.norm(a, axis=0) * np.linalg.norm(b, axis=0)
            score[g] = np.mean(np.sum(a * b, axis=0) / np.maximum(norm, 1e-12))
    usable = np.isfinite(score)
    if not usable.any():
        raise EvaluationError(
            f"run and truth overlap by less than half at every time offset up to {largest:g} s; "
            "allow more (--max_offset)"
        )
    padded = np.concatenate([[-np.inf], score, [-np.inf]])
    peaks = np.flatnonzero(usable & (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    order = peaks[np.argsort(-score[peaks], kind="stable")][:CANDIDATE_OFFSETS]
    return [float(grid[g]) for g in order]


def _features(positions: np.ndarray, frame_time: float) -> np.ndarray:
    """Spread of the points and mean speed, (T, 2): what no rigid motion of the world changes; NaN where unknown."""
    seen = np.isfinite(positions).all(axis=-1)
    count = np.maximum(seen.sum(axis=1), 1)
    filled = np.where(seen[..., None], positions, 0.0)
    centre = filled.sum(axis=1) / count[:, None]
    square = np.where(seen, ((filled - centre[:, None]) ** 2).sum(axis=-1), 0.0)
    spread = np.sqrt(square.sum(axis=1) / count)
    step = np.full(seen.shape, np.nan)
    step[1:-1] = np.linalg.norm(positions[2:] - positions[:-2], axis=-1) / (2 * frame_time)
    moves = np.isfinite(step)
    speed = np.where(moves, step, 0.0).sum(axis=1) / np.maximum(moves.sum(axis=1), 1)
    features = np.stack([spread, speed], axis=1)
    features[~seen.any(axis=1) | ~moves.any(axis=1)] = np.nan
    return features


def _starts(found: np.ndarray, other: np.ndarray) -> list[Alignment]:
    """Rigid motions that lay the principal axes of all points over time on each other, in all 24 proper ways."""
    both = np.isfinite(found).all(-1).any(1) & np.isfinite(other).all(-1).any(1)
    if both.sum() < FEWEST_FRAMES:
        return []
    ours, theirs = (x[both][np.isfinite(x[both]).all(-1)] for x in (found, other))
    a, b = ours.mean(axis=0), theirs.mean(axis=0)
    axes_a, axes_b = (np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2] for x in (ours, theirs))
    starts = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            R = axes_a.T @ (np.array(signs)[:, None] * np.eye(3)[list(order)]) @ axes_b
            if np.linalg.det(R) > 0:
                starts.append(Alignment(R, a - R @ b, 0.0))
    return starts


def _match_and_fit(
    found: np.ndarray,
    other: np.ndarray,
    start: Alignment,
    diagonal: float,
    align: bool,
    pairs: Pairs | None,
    *,
    start_limit: float = START_LIMIT,
    rounds: int = ROUNDS,
) -> _Fit | None:
    """Match trajectories and fit the rigid motion in turn."""
    R, t = start.rotation, start.translation
    limits = np.geomspace(start_limit, END_LIMIT, rounds) * diagonal
    seen = np.isfinite(found).all(-1)[:, :, None] & np.isfinite(other).all(-1)[:, None]
    count = seen.sum(axis=0)
    if not (count >= FEWEST_FRAMES).any():
        return None
    matched: Pairs = []
    for limit in limits:
        distance = np.where(seen, np.linalg.norm(found[:, :, None] - (other @ R.T + t)[:, None], axis=-1), 0.0)
        mean = np.where(count >= FEWEST_FRAMES, distance.sum(axis=0) / np.maximum(count, 1), np.inf)
        if pairs is None:
            row, column = linear_sum_assignment(np.minimum(mean, limit))
            now = [(int(i), int(j)) for i, j in zip(row, column, strict=True) if mean[i, j] < limit]
        else:
            now = [(i, j) for i, j in pairs if np.isfinite(mean[i, j])]
        if len(now) < min(3, *mean.shape) or not align:
            matched = now
            break
        source, target = _paired(found, other, now)
        R_new, t_new = rigid_motion(source, target, _robust(target - (source @ R.T + t)))
        if now == matched and np.allclose(R_new, R, atol=1e-9) and np.allclose(t_new, t, atol=1e-9):
            if limit <= limits[-1] or pairs is not None:
                break
        R, t, matched = R_new, t_new, now
    if not matched:
        return None
    cap = END_LIMIT * diagonal
    distance = np.where(seen, np.linalg.norm(found[:, :, None] - (other @ R.T + t)[:, None], axis=-1), 0.0)
    mean = distance.sum(axis=0) / np.maximum(count, 1)
    costs = [min(mean[i, j], cap) for i, j in matched]
    unmatched = min(mean.shape) - len(matched) if pairs is None else 0
    cost = (sum(costs) + unmatched * cap) / (len(costs) + unmatched)
    return _Fit(float(cost), Alignment(R, t, start.time_offset), matched)


def _paired(found: np.ndarray, other: np.ndarray, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """All points of the pairs that are there in both: source (truth) and target (run), (N, 3) each."""
    i, j = np.array(pairs).T
    target, source = found[:, i].reshape(-1, 3), other[:, j].reshape(-1, 3)
    good = np.isfinite(target).all(-1) & np.isfinite(source).all(-1)
    return source[good], target[good]


def _robust(residuals: np.ndarray) -> np.ndarray:
    """Huber weights of residuals (N, 3), with three times their median as the limit."""
    length = np.linalg.norm(residuals, axis=1)
    limit = max(3 * float(np.median(length)), 1e-9)
    return np.minimum(1.0, limit / np.maximum(length, 1e-12))


def _refine_offset(
    found: np.ndarray, times: np.ndarray, track: MarkerTrack, start: Alignment, pairs: Pairs, align: bool
) -> Alignment:
    """Move the offset by up to a frame so that the best rigid motion leaves least; the same points count throughout."""
    frame = times[1] - times[0]

    def fit(offset: float) -> tuple[float, np.ndarray, np.ndarray]:
        source, target = _paired(found, track.at(times + offset), pairs)
        if len(source) < FEWEST_FRAMES:
            return np.inf, start.rotation, start.translation
        R, t = start.rotation, start.translation
        if align:
            R, t = rigid_motion(source, target, _robust(target - (source @ R.T + t)))
        length = np.linalg.norm(target - (source @ R.T + t), axis=1)
        limit = max(3 * float(np.median(length)), 1e-9)
        return float(np.minimum(length, limit).mean()), R, t

    found_offset = minimize_scalar(
        lambda x: fit(x)[0],
        bounds=(start.time_offset - frame, start.time_offset + frame),
        method="bounded",
        options={"xatol": frame / 1000},
    ).x
    cost, R, t = fit(float(found_offset))
    return Alignment(R, t, float(found_offset)) if cost <= fit(start.time_offset)[0] else start
