"""How samples follow one body or a blend of two: soft skin near a joint is no body of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from geomocap.bodies.blend_kernel import LANES, explain_samples
from geomocap.model.motion_paths import DEPTH_FRACTION
from geomocap.model.small_systems import solve_symmetric
from geomocap.scheduling import spread

_FEW_POSITIONS = 20_000  # that are not worth waking other threads for


@dataclass(frozen=True)
class Blends:
    """What each sample follows best.

    Attributes
    ----------
    costs : (n, B) float, metres²
        Least cost of explaining the sample with body b as the (main) one; infinite where not allowed.
    partner : (n, B) int32
        The second body of that explanation; -1: none, the body alone.
    fraction : (n, B) float
        Weight of the main body, 0.5 to 1.
    """

    costs: np.ndarray
    partner: np.ndarray
    fraction: np.ndarray


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place_at_rest(positions, weights, total, ray, rotations, translations, place):
    """Place of a sample at rest by one body's motion, least squares over the frames; weights sum to `total`."""
    place[:] = 0.0
    normal = np.zeros((3, 3))
    away = np.empty(3)
    direction = np.empty(3)
    for t in range(len(weights)):
        w = weights[t] / total
        for c in range(3):
            away[c] = positions[t, c] - translations[t, c]
        if len(ray):
            along = 0.0
            for c in range(3):
                along += (1.0 - DEPTH_FRACTION**2) * away[c] * ray[t, c]
            for c in range(3):
                away[c] -= along * ray[t, c]
                direction[c] = 0.0
                for d in range(3):
                    direction[c] += rotations[t, d, c] * ray[t, d]
            for c in range(3):
                normal[c, c] += w
                for d in range(3):
                    normal[c, d] -= w * (1.0 - DEPTH_FRACTION**2) * direction[c] * direction[d]
        for c in range(3):
            for d in range(3):
                place[d] += w * rotations[t, c, d] * away[c]
    if len(ray):
        solve_symmetric(normal, place, place)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _places_at_rest(begin, end, samples, label, positions, weights, ray, rotations, translations, places):
    for k in range(begin, end):
        i, b = samples[k], label[samples[k]]
        total = weights[i].sum()
        if total > 1e-12:
            _place_at_rest(positions[i], weights[i], total, ray[i], rotations[b], translations[b], places[k])


def places_at_rest(
    samples: np.ndarray,
    label: np.ndarray,
    positions: np.ndarray,
    weights: np.ndarray,
    ray: np.ndarray | None,
    rotations: np.ndarray,
    translations: np.ndarray,
) -> np.ndarray:
    """Places that the motion of each sample's body carries best to its positions, least squares over the frames.

    Parameters
    ----------
    samples : (n,) int
        Those of the N that are asked for.
    label : (N,) int
        Bodies.
    positions, weights, ray, rotations, translations
        See `explain`.

    Returns
    -------
    (n, 3) float, metres
        0 where all weights are.
    """
    places = np.zeros((len(samples), 3))
    arrays = _arrays(positions, weights, ray, rotations, translations)
    few = len(samples) if len(samples) * weights.shape[1] < _FEW_POSITIONS else 1
    spread(_places_at_rest, len(samples), samples, label, *arrays, places, few=few)
    return places


@numba.njit(cache=True, nogil=True, error_model="numpy")
def blend_spans(main, partner, weights, rest, rotations, translations):
    """Mean square by which the two bodies of their blends carry samples apart, (n,), metres²; 0 without a second.

    Parameters
    ----------
    main, partner : (n,) int
        Bodies; a partner below 0: none.
    weights : (n, T) float
    rest : (n, 3) float, metres
    rotations, translations : (B, T, 3, 3), (B, T, 3) float
    """
    count, frames = weights.shape
    result, apart = np.zeros(count), np.empty((frames, 3))
    for n in range(count):
        a, b = main[n], partner[n]
        if b < 0:
            continue
        total = max(weights[n].sum(), 1e-12)
        middle = np.zeros(3)
        for t in range(frames):
            for i in range(3):
                apart[t, i] = translations[a, t, i] - translations[b, t, i]
                for j in range(3):
                    apart[t, i] += (rotations[a, t, i, j] - rotations[b, t, i, j]) * rest[n, j]
                middle[i] += weights[n, t] / total * apart[t, i]
        for t in range(frames):
            for i in range(3):
                result[n] += weights[n, t] / total * (apart[t, i] - middle[i]) ** 2
    return result


def explain(
    samples: np.ndarray,
    positions: np.ndarray,
    weights: np.ndarray,
    ray: np.ndarray | None,
    rest: np.ndarray,
    certain: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    allowed: np.ndarray,
    adjacent: np.ndarray,
    penalty: float,
    cap: float,
) -> Blends:
    """Explain samples by one body each, or by a linear blend of two adjacent ones (linear blend skinning).

    The cost is the mean squared residual plus 4 w (1 - w) penalty² for a blend of weights w and 1 - w.

    Parameters
    ----------
    samples : (n,) int
        Those of the N that are asked for.
    positions, weights : (N, T, 3) float, metres; (N, T) float
    ray : (N, T, 3) float, optional
        Directions along which positions are unsure, see `MotionPaths`.
    rest : (N, 3) float, metres
    certain : (N,) bool
        Where `rest` is known; elsewhere each body may put the sample where it fits best.
    rotations, translations : (B, T, 3, 3), (B, T, 3) float
        Motions of the bodies since the reference.
    allowed : (n, B) bool
        Bodies that may explain a sample.
    adjacent : (B, B) bool
        Bodies (rows) that may be the main one of a blend with another (columns).
    penalty : float, metres
    cap : float, metres
        Larger residuals of single frames count as this.
    """
    positions, weights, ray, rotations, translations = _arrays(positions, weights, ray, rotations, translations)
    shape = (len(samples), len(rotations))
    blends = Blends(np.full(shape, np.inf), np.full(shape, -1, np.int32), np.ones(shape))
    # samples of like bodies side by side
    order = np.argsort(allowed @ 0.5 ** np.arange(len(rotations)), kind="stable")
    groups = -(-len(samples) // LANES)
    spread(
        explain_samples,
        groups,
        order,
        samples,
        positions,
        weights,
        ray if ray.size else None,  # what rays take isn't compiled without any
        np.ascontiguousarray(rest),
        np.ascontiguousarray(certain),
        rotations,
        translations,
        allowed,
        adjacent,
        penalty**2,
        cap**2,
        blends.costs,
        blends.partner,
        blends.fraction,
        few=groups if len(samples) * weights.shape[1] < _FEW_POSITIONS else 1,
    )
    return blends


def _arrays(
    positions: np.ndarray, weights: np.ndarray, ray: np.ndarray | None, rotations: np.ndarray, translations: np.ndarray
) -> tuple[np.ndarray, ...]:
    """The same as kernels take them; (N, 0, 3): no rays."""
    ray = np.zeros((len(weights), 0, 3)) if ray is None else ray
    positions, weights, ray, rotations, translations = (
        np.ascontiguousarray(a, float) for a in (positions, weights, ray, rotations, translations)
    )
    return positions, weights, ray, rotations, translations
