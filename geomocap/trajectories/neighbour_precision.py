"""Standard deviations of trajectories as their neighbours show them.

What an alignment of images tells of its precision is what noise and misfit of one frame do. It knows nothing of what
builds up with time: shade that stays where the light is, shapes that are not quite right and show it when they turn,
templates taken where a patch had drifted to. But a surface is rigid piece by piece: carried by the rigid motion of the
nearest points since it was placed, a point should be where it was measured. By how much these misses exceed what was
predicted, as the surface turns, is the factor that all standard deviations lack (the variance of unit weight of an
adjustment); what a point misses more than others of its precision is its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from geomocap.model.trajectories import LOW_PRECISION, Trajectories
from geomocap.scheduling import map_here

_NEIGHBOURS = 12
_EVERY = 3  # frames between two looks
_BINS = 8  # of turns, with as many misses in each
_LEAST = 300  # misses by which a factor is known
_CHI2_MEDIAN = 2.366  # of three freedoms
_LEAST_FACTOR = 0.25  # neighbours share some of what is wrong
_PRIOR = 3.0  # freedoms that the common factor has against those of a miss of its own


@dataclass(frozen=True)
class Misses:
    """What points miss of where their neighbours carry them.

    Attributes
    ----------
    point, frame : (M,) int
    square : (M,) float
        Square of the miss by the predicted variance of a coordinate; 3 is expected.
    turn : (M,) float, radians
        Of the surface round the point since it was placed.
    """

    point: np.ndarray
    frame: np.ndarray
    square: np.ndarray
    turn: np.ndarray


def with_observed_precision(tracks: Trajectories) -> Trajectories:
    """Return trajectories with standard deviations that their neighbours bear out.

    Those of positions that a single camera measured stay, as their depths come from the neighbours.
    """
    misses = neighbour_misses(tracks)
    if len(misses.point) < _LEAST:
        return tracks
    several = tracks.measured & ~tracks.ray.any(axis=2)
    factor = _common(misses, turns(tracks)) * _own(misses, several)
    return replace(tracks, sigma=np.where(several, tracks.sigma * factor, tracks.sigma))


def clear_unsure(tracks: Trajectories, limit: float) -> None:
    """Take away, in place, what several cameras measured with a larger standard deviation than `limit` (m)."""
    end, start = tracks.end, tracks.start
    with np.errstate(invalid="ignore"):
        tracks.clear((tracks.sigma > limit) & ~tracks.ray.any(axis=2))
    tracks.end_reason[tracks.end < end] = LOW_PRECISION
    tracks.begin_reason[tracks.start > start] = LOW_PRECISION


def turns(tracks: Trajectories) -> np.ndarray:
    """Angles by which the surface has turned since the points were placed, (N, T) float, radians; 0 if not known."""
    first = tracks.rotations[np.arange(len(tracks)), tracks.placed]
    trace = np.einsum("ntij,nij->nt", tracks.rotations, first)
    return np.nan_to_num(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def neighbour_misses(tracks: Trajectories) -> Misses:
    """Compare points with where the rigid motion of the nearest ones since they were placed leads, in some frames."""
    has = tracks.measured & ~tracks.ray.any(axis=2)
    turned = turns(tracks)

    def placed_in(begin: int) -> list[tuple[np.ndarray, ...]]:
        parts: list[tuple[np.ndarray, ...]] = []
        for frame in range(0, tracks.n_frames, _EVERY):
            there = np.flatnonzero(has[:, begin] & has[:, frame])
            new = there[tracks.placed[there] == begin]
            if frame == begin or len(there) <= _NEIGHBOURS or not len(new):
                continue
            old, now = tracks.positions[:, begin], tracks.positions[:, frame]
            near = there[cKDTree(old[there]).query(old[new], _NEIGHBOURS + 1)[1]]
            order = np.argsort(near == new[:, None], axis=1, kind="stable")  # the point itself last, and cut off
            near = np.take_along_axis(near, order, axis=1)[:, :-1]
            miss = now[new] - carried_by(old[new], old[near], now[near])
            variance = tracks.sigma[new, frame] ** 2 + 2 * (tracks.sigma[near, frame] ** 2).mean(axis=1) / _NEIGHBOURS
            square = (miss**2).sum(axis=1) / variance
            parts.append((new, np.full(len(new), frame), square, turned[new, frame]))
        return parts

    none = np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0)
    parts: list[tuple[np.ndarray, ...]] = [none]
    parts += [part for some in map_here(placed_in, np.unique(tracks.placed).tolist()) for part in some]
    return Misses(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def carried_by(points: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Move points (M, 3) by the rigid motions (Kabsch 1976) that take places `old` (M, K, 3) to `new` (M, K, 3)."""
    middle, moved = old.mean(axis=1), new.mean(axis=1)
    products = np.swapaxes(new - moved[:, None], 1, 2) @ (old - middle[:, None])
    u, _, vt = np.linalg.svd(products)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return moved + np.einsum("mij,mj->mi", u @ vt, points - middle)


def _common(misses: Misses, turned: np.ndarray) -> np.ndarray:
    """Factor of standard deviations by turn: medians of misses, between which it goes straight; like `turned`."""
    bins = _by_turn(misses)
    turn = np.array([np.median(misses.turn[b]) for b in bins])
    factor = np.array([np.sqrt(np.median(misses.square[b]) / _CHI2_MEDIAN) for b in bins])
    return np.interp(turned, turn, np.maximum(factor, _LEAST_FACTOR))


def _by_turn(misses: Misses) -> list[np.ndarray]:
    return np.array_split(np.argsort(misses.turn, kind="stable"), _BINS)


def _own(misses: Misses, measured: np.ndarray) -> np.ndarray:
    """Factors of single points, (N, T): expected variance given their misses, with the common one as prior.

    Between two frames with misses it goes straight; it is 1 for points that have none.
    """
    expected = np.empty(len(misses.point))
    for b in _by_turn(misses):
        expected[b] = max(np.median(misses.square[b]) / _CHI2_MEDIAN, _LEAST_FACTOR**2)
    factor = np.sqrt((_PRIOR + misses.square / expected) / (_PRIOR + 3))
    out = np.ones(measured.shape)
    frames = np.arange(measured.shape[1])
    by_point = np.lexsort((misses.frame, misses.point))
    points, first = np.unique(misses.point[by_point], return_index=True)
    for point, rows in zip(points, np.split(by_point, first[1:]), strict=True):
        out[point] = np.interp(frames, misses.frame[rows], factor[rows])
    return out
