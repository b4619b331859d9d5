"""What a moving surface misses of rigid motion everywhere: noise of its positions, and how samples share it.

The motion of the samples in a ring around a sample, a little wider than the smallest body, predicts where that sample
goes. What it misses is noise of the positions, white or shared with those nearby, and what the surface gives; at joints
it is motion, too. Noise is everywhere and joints are not: the quarter of the samples that are predicted best tell how
large it is, whatever the subject. The misses also tell how far samples err together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from geomocap.bodies.body_settings import FOLLOWED
from geomocap.bodies.rigid_motions import fit_rigid_motion
from geomocap.bodies.surface_graph import SurfaceGraph
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.motion_paths import sure_part
from geomocap.model.rotations import nearest_rotation
from geomocap.scheduling import spread

_RING = (0.03, 0.06)  # diagonals; a disc of the inner radius is about a hundredth of the surface of a person
_SPACINGS = 5.0  # the ring's outer radius is at least so many times the distance of neighbours
_QUANTILE = 0.25
# Errors that go together over more than a ring show in it in part: against the truth, nodes of silhouettes alone (six
# subjects, eight cameras) err 2.4 to 6.7 times as much as rings show, and state 5 to 17 times as much. With 1, 1.5 and
# 2 times, and as stated, these came in 1.20, 1.09, 1.03 and 0.41 of their bodies, with 0.39, 0.35, 0.34 and 0.12 of
# their edges and core indices of 0.69, 0.70, 0.71 and 0.65. What patches state is 0.4 to 1.6 times what rings show.
_BEYOND = 1.5
_FRAMES = 40
_LEAST = 4  # samples in a ring
_ASKED = 300  # samples whose rings are asked, where rays make that slow
_ROUNDS = 2
_BINS = 64
_BIN = 1.5  # spacings


@dataclass(frozen=True)
class SurfaceNoise:
    """Noise of the positions of samples.

    Attributes
    ----------
    variance : float, metres²
        Mean square distance by which a sample is missed, all three directions together.
    correlation : (K,) float
        Of the misses of two samples, by their distance; 0 from the first zero on.
    step : float, metres
        Distances of `correlation` are 0 to 1, 1 to 2, … times this.
    """

    variance: float
    correlation: np.ndarray
    step: float

    def independent(self, places: np.ndarray, count: int) -> float:
        """Effective number of samples that err on their own, of `count` that lie as `places` (n, 3), metres, do.

        The square of their number over the sum of the correlations of all pairs.
        """
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)
        shared = self.correlation[np.minimum((apart / self.step).astype(int), len(self.correlation) - 1)]
        pairs = max(len(places) * (len(places) - 1), 1)
        mean = (shared.sum() - np.trace(shared)) / pairs
        return float(count / (1.0 + (count - 1) * mean))

    def calibrated(self, stated: np.ndarray) -> np.ndarray:
        """Reduce standard deviations of the samples' coordinates, (N,), metres, to the scale that the surface shows.

        What is stated says how much surer one sample is than another. How much the surest quarter may state is what the
        quarter that is predicted best shows, and half as much more: where it states more, all are reduced alike.
        """
        best, most = float(np.quantile(stated, _QUANTILE)), _BEYOND * math.sqrt(self.variance / 3.0)
        return stated * (most / best) if best > most else stated


def surface_noise(
    positions: np.ndarray,
    weights: np.ndarray,
    reference: np.ndarray,
    ray: np.ndarray | None,
    graph: SurfaceGraph,
    diagonal: float,
) -> SurfaceNoise:
    """Noise of samples, by what rings around them miss of their motion.

    Parameters
    ----------
    positions, weights : (N, T, 3) float, metres; (N, T) float
        Complete; weights of what was not seen are small.
    reference : (N, 3) float, metres
    ray : (N, T, 3) float, optional
        See `MotionPaths`; what is missed along it counts a tenth.
    graph : SurfaceGraph
    diagonal : float, metres
    """
    looked_at = evenly_chosen(positions.shape[1], _FRAMES)
    positions, weights = np.ascontiguousarray(positions[:, looked_at]), np.ascontiguousarray(weights[:, looked_at])
    outer = max(_RING[1] * diagonal, _SPACINGS * graph.spacing)
    geodesics = graph.geodesics(outer)
    ring = (geodesics <= outer) & (geodesics > outer * _RING[0] / _RING[1])
    known = ring.sum(axis=1) >= _LEAST
    if ray is None or not ray.any():
        misses = ring_misses(positions, weights, reference, ring)
    else:
        ray = np.ascontiguousarray(ray[:, looked_at])
        asked = np.flatnonzero(known)[:: max(1, int(known.sum()) // _ASKED)]
        known = np.isin(np.arange(len(known)), asked)
        misses = np.zeros_like(positions)
        for i in asked:
            misses[i] = _miss_across(i, np.flatnonzero(ring[i]), positions, weights, reference, ray)
        misses = sure_part(misses, ray)
    step = _BIN * graph.spacing
    give = 3.0 * (FOLLOWED * diagonal) ** 2
    if not known.any():
        return SurfaceNoise(give, np.zeros(_BINS), step)
    misses, weights = misses[known], weights[known]
    square = (weights * (misses**2).sum(axis=2)).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-12)
    correlation = _correlation((np.sqrt(weights)[..., None] * misses).reshape(len(misses), -1), reference[known], step)
    return SurfaceNoise(max(float(np.quantile(square, _QUANTILE)), give), correlation, step)


def _correlation(misses: np.ndarray, places: np.ndarray, step: float) -> np.ndarray:
    """Mean cosine of misses (n, M) of pairs of samples by their distance, (K,), 0 from its first zero on."""
    total, number = np.zeros(_BINS), np.zeros(_BINS, np.int64)
    correlation_sums(misses @ misses.T, np.linalg.norm(misses, axis=1) + 1e-12, places, step, total, number)
    mean = total / np.maximum(number, 1)
    over = np.flatnonzero((mean <= 0) & (number > 0))
    mean[over[0] if len(over) else _BINS - 1 :] = 0.0
    return np.clip(mean, 0.0, 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def correlation_sums(products, length, places, step, total, number):
    """Add up the cosines of pairs of samples by their distance, (K,), and their number.

    Parameters
    ----------
    products : (n, n) float
        Of the misses of two samples.
    length : (n,) float
    places : (n, 3) float, metres
    step : float, metres
    total, number : (K,) float, (K,) int
        Added to; the last one is of all farther pairs, too.
    """
    for i in range(len(length)):
        for j in range(i + 1, len(length)):
            x, y, z = places[i, 0] - places[j, 0], places[i, 1] - places[j, 1], places[i, 2] - places[j, 2]
            k = min(int(np.sqrt(x * x + y * y + z * z) / step), len(total) - 1)
            total[k] += products[i, j] / (length[i] * length[j])
            number[k] += 1


def _miss_across(
    i: int, members: np.ndarray, positions: np.ndarray, weights: np.ndarray, reference: np.ndarray, ray: np.ndarray
) -> np.ndarray:
    """By what the motion of a ring misses a sample, (T, 3), where rays leave depths open."""
    motion = fit_rigid_motion(positions[members], reference[members], weights[members], 0.0, _ROUNDS, ray[members])
    rotations, translations = motion[:2]
    away = ((positions[i] - translations)[:, None] @ rotations)[:, 0]
    place = (weights[i, :, None] * away).sum(axis=0) / max(float(weights[i].sum()), 1e-12)
    return positions[i] - translations - rotations @ place


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments_of(i, positions, weights, reference, first, members, center, start, moments):
    """Fill row i: weighted means of a ring now and at rest, and the moments about these."""
    for t in range(weights.shape[1]):
        total = 1e-12
        for q in range(first[i], first[i + 1]):
            j = members[q]
            total += weights[j, t]
            for c in range(3):
                center[i, t, c] += weights[j, t] * positions[j, t, c]
                start[i, t, c] += weights[j, t] * reference[j, c]
        for c in range(3):
            center[i, t, c] /= total
            start[i, t, c] /= total
        for q in range(first[i], first[i + 1]):
            j = members[q]
            w = weights[j, t] / total
            for a in range(3):
                moved = w * (positions[j, t, a] - center[i, t, a])
                for b in range(3):
                    moments[i, t, a, b] += moved * (reference[j, b] - start[i, t, b])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ring_moments(begin, end, positions, weights, reference, first, members, center, start, moments):
    for i in range(begin, end):
        _moments_of(i, positions, weights, reference, first, members, center, start, moments)


def ring_misses(positions: np.ndarray, weights: np.ndarray, reference: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """By what the motion of the ring around each sample misses it, from the place at rest that suits it best.

    Parameters
    ----------
    positions, weights : (N, T, 3) float, metres; (N, T) float
    reference : (N, 3) float, metres
    ring : (N, N) bool
        Row i: samples of the ring around sample i.

    Returns
    -------
    (N, T, 3) float, metres
    """
    members = np.nonzero(ring)[1]
    first = np.concatenate([[0], np.cumsum(ring.sum(axis=1))])
    center, start = np.zeros_like(positions), np.zeros_like(positions)
    moments = np.zeros((*weights.shape, 3, 3))
    arrays = positions, weights, np.ascontiguousarray(reference), first, members, center, start, moments
    spread(_ring_moments, len(weights), *arrays)
    rotations = nearest_rotation(moments + 1e-12 * np.eye(3))
    away = ((positions - center)[:, :, None] @ rotations)[:, :, 0] + start
    fraction = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    place = (fraction[:, :, None] * away).sum(axis=1)[:, None] - start
    return positions - center - (rotations @ place[..., None])[..., 0]
