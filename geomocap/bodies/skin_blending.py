"""How samples follow one body or a blend of two: soft skin near a joint is no body of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from geomocap.model.motion_paths import DEPTH_FRACTION
from geomocap.model.small_systems import solve_symmetric
from geomocap.scheduling import spread

_FEW_POSITIONS = 20_000  # that are not worth waking other threads for
L = 16  # samples
_AT_ONCE = 20  # frames


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


# Samples are worked on in 16 lanes L, last in all arrays: each lane adds up as its sample alone would.
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(samples, positions, weights, ray, seen, share, total):
    """Fill in what is known of some samples: (T, 6 L) positions and rays, (T, L) weights, and their sums, (L,)."""
    total[:] = 1e-12
    for q in range(L):
        for t in range(len(share)):
            share[t, q] = 0.0
            for c in range(6):
                seen[t, L * c + q] = 0.0
            if q < len(samples):
                n = samples[q]
                share[t, q] = weights[n, t]
                total[q] += weights[n, t]
                for c in range(3):
                    seen[t, L * c + q] = positions[n, t, c]
                    if ray.shape[1]:
                        seen[t, 3 * L + L * c + q] = ray[n, t, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _places_in_lanes(seen, share, total, with_rays, rotations, translations, places):
    """Fill in the places (3, L) of samples at rest by one body's motion, as `_place_at_rest` does."""
    part = 1.0 - DEPTH_FRACTION**2
    S, sums = np.zeros((9, L)), np.empty(L)
    for q in range(L):
        sums[q] = total[q]
    for t in range(len(share)):
        now, weight = seen[t], share[t]
        a, b, c = translations[t, 0], translations[t, 1], translations[t, 2]
        r0, r1, r2 = rotations[t, 0, 0], rotations[t, 0, 1], rotations[t, 0, 2]
        r3, r4, r5 = rotations[t, 1, 0], rotations[t, 1, 1], rotations[t, 1, 2]
        r6, r7, r8 = rotations[t, 2, 0], rotations[t, 2, 1], rotations[t, 2, 2]
        for q in range(L):
            w = weight[q] / sums[q]
            x, y, z = now[q] - a, now[L + q] - b, now[2 * L + q] - c
            if with_rays:
                k, m, n = now[3 * L + q], now[4 * L + q], now[5 * L + q]
                along = part * x * k + part * y * m + part * z * n
                x, y, z = x - along * k, y - along * m, z - along * n
                d, e, f = r0 * k + r3 * m + r6 * n, r1 * k + r4 * m + r7 * n, r2 * k + r5 * m + r8 * n
                v = w * part
                S[3, q] = S[3, q] + w - v * d * d
                S[4, q] = S[4, q] - v * d * e
                S[5, q] = S[5, q] - v * d * f
                S[6, q] = S[6, q] + w - v * e * e
                S[7, q] = S[7, q] - v * e * f
                S[8, q] = S[8, q] + w - v * f * f
            S[0, q] = S[0, q] + w * r0 * x + w * r3 * y + w * r6 * z
            S[1, q] = S[1, q] + w * r1 * x + w * r4 * y + w * r7 * z
            S[2, q] = S[2, q] + w * r2 * x + w * r5 * y + w * r8 * z
    normal, place = np.empty((3, 3)), np.empty(3)
    for q in range(L):
        for c in range(3):
            place[c] = S[c, q]
        if with_rays:
            normal[0, 0], normal[0, 1], normal[0, 2] = S[3, q], S[4, q], S[5, q]
            normal[1, 1], normal[1, 2], normal[2, 2] = S[6, q], S[7, q], S[8, q]
            solve_symmetric(normal, place, place)
        for c in range(3):
            places[c, q] = place[c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _misses_in_lanes(seen, share, total, with_rays, rotations, translations, places, cap, misses, costs):
    """Fill in what one body misses of samples, (T, 3 L), observed minus carried, and its costs (L,)."""
    part = 1.0 - DEPTH_FRACTION
    P, sums = np.empty((3, L)), np.zeros(L)
    for c in range(3):
        for q in range(L):
            P[c, q] = places[c, q]
    for t in range(len(share)):
        now, weight, miss = seen[t], share[t], misses[t]
        a, b, c = translations[t, 0], translations[t, 1], translations[t, 2]
        r0, r1, r2 = rotations[t, 0, 0], rotations[t, 0, 1], rotations[t, 0, 2]
        r3, r4, r5 = rotations[t, 1, 0], rotations[t, 1, 1], rotations[t, 1, 2]
        r6, r7, r8 = rotations[t, 2, 0], rotations[t, 2, 1], rotations[t, 2, 2]
        for q in range(L):
            x = now[q] - (a + r0 * P[0, q] + r1 * P[1, q] + r2 * P[2, q])
            y = now[L + q] - (b + r3 * P[0, q] + r4 * P[1, q] + r5 * P[2, q])
            z = now[2 * L + q] - (c + r6 * P[0, q] + r7 * P[1, q] + r8 * P[2, q])
            if with_rays:
                k, m, n = now[3 * L + q], now[4 * L + q], now[5 * L + q]
                along = x * k + y * m + z * n
                x, y, z = x - part * along * k, y - part * along * m, z - part * along * n
            miss[q] = x
            miss[L + q] = y
            miss[2 * L + q] = z
            sums[q] += weight[q] * min(x * x + y * y + z * z, cap)
    for q in range(L):
        costs[q] = sums[q] / total[q]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _blend_in_lanes(first, second, share, total, penalty, cap, most, fraction, costs):
    """Fill in the best weights of the first of two bodies, (L,), -1: none, and costs that are right if below `most`.

    Misses of the bodies are (T, 3 L), `most` is (2, L): where the first, or the second body is the main one.
    """
    S, w = np.zeros((6, L)), np.empty(L)
    S[3] = 1e-18
    for t in range(len(share)):
        one, other, weight = first[t], second[t], share[t]
        for q in range(L):
            # observed = w carried by the first + (1 - w) carried by the second: linear in w
            # three sums each, of which none waits for another
            v = weight[q]
            d = other[q] - one[q]
            e = other[L + q] - one[L + q]
            f = other[2 * L + q] - one[2 * L + q]
            S[0, q] += v * other[q] * d
            S[1, q] += v * other[L + q] * e
            S[2, q] += v * other[2 * L + q] * f
            S[3, q] += v * d * d
            S[4, q] += v * e * e
            S[5, q] += v * f * f
    # of w² below - 2 w above + constant + 4 w (1 - w) penalty: the least in [0, 1]
    for q in range(L):
        above, below = S[0, q] + S[1, q] + S[2, q], S[3, q] + S[4, q] + S[5, q]
        curve = below / total[q] - 4.0 * penalty
        w[q] = (above / total[q] - 2.0 * penalty) / curve if curve > 1e-18 else -1.0
        fraction[q] = w[q] if w[q] > 0.0 and w[q] < 1.0 else -1.0
        S[0, q] = 0.0
        S[1, q] = most[0, q] if w[q] >= 0.5 else most[1, q]
    for begin in range(0, len(share), _AT_ONCE):
        open_still = False  # costs only grow from frame to frame
        for q in range(L):
            costs[q] = S[0, q] / total[q] + 4.0 * w[q] * (1.0 - w[q]) * penalty
            open_still |= fraction[q] >= 0.0 and costs[q] < S[1, q]
        if not open_still:
            return
        for t in range(begin, min(begin + _AT_ONCE, len(share))):
            one, other, weight = first[t], second[t], share[t]
            for q in range(L):
                x = w[q] * one[q] + (1.0 - w[q]) * other[q]
                y = w[q] * one[L + q] + (1.0 - w[q]) * other[L + q]
                z = w[q] * one[2 * L + q] + (1.0 - w[q]) * other[2 * L + q]
                S[0, q] += weight[q] * min(x * x + y * y + z * z, cap)
    for q in range(L):
        costs[q] = S[0, q] / total[q] + 4.0 * w[q] * (1.0 - w[q]) * penalty


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _explain(
    begin,
    end,
    order,
    samples,
    positions,
    weights,
    ray,
    rest,
    certain,
    rotations,
    translations,
    allowed,
    adjacent,
    penalty,
    cap,
    costs,
    partner,
    fraction,
):
    """Fill the rows `order[L * begin : L * end]` of the results, see `explain`."""
    bodies, frames = len(rotations), weights.shape[1]
    with_rays = ray.shape[1] > 0
    seen, share, total = np.empty((frames, 6 * L)), np.empty((frames, L)), np.empty(L)
    misses, places = np.empty((bodies, frames, 3 * L)), np.empty((3, L))
    cost, part, most = np.empty(L), np.empty(L), np.empty((2, L))
    for low in range(L * begin, min(L * end, len(order)), L):
        rows = order[low : low + L]
        _gather(samples[rows], positions, weights, ray, seen, share, total)
        for b in range(bodies):
            asked, unsure = False, False
            for row in rows:
                asked |= allowed[row, b]
                unsure |= allowed[row, b] and not certain[samples[row]]
            if not asked:
                continue
            if unsure:
                _places_in_lanes(seen, share, total, with_rays, rotations[b], translations[b], places)
            for q in range(L):
                n = samples[rows[min(q, len(rows) - 1)]]
                if certain[n]:
                    for c in range(3):
                        places[c, q] = rest[n, c]
            _misses_in_lanes(seen, share, total, with_rays, rotations[b], translations[b], places, cap, misses[b], cost)
            for q, row in enumerate(rows):
                if allowed[row, b]:
                    costs[row, b] = cost[q]
        for a in range(bodies):
            for b in range(a):
                if not (adjacent[a, b] or adjacent[b, a]):
                    continue
                asked = False
                for q, row in enumerate(rows):
                    both = allowed[row, a] and allowed[row, b]
                    asked |= both
                    most[0, q] = costs[row, a] if both and adjacent[a, b] else -1.0
                    most[1, q] = costs[row, b] if both and adjacent[b, a] else -1.0
                if not asked:
                    continue
                for q in range(len(rows), L):
                    most[0, q] = most[1, q] = -1.0
                _blend_in_lanes(misses[a], misses[b], share, total, penalty, cap, most, part, cost)
                for q, row in enumerate(rows):
                    main, other, w = (a, b, part[q]) if part[q] >= 0.5 else (b, a, 1.0 - part[q])
                    if part[q] > 0.0 and cost[q] < (most[0, q] if main == a else most[1, q]):
                        costs[row, main] = cost[q]
                        partner[row, main] = other
                        fraction[row, main] = w


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
    groups = -(-len(samples) // L)
    spread(
        _explain,
        groups,
        order,
        samples,
        positions,
        weights,
        ray,
        np.ascontiguousarray(rest),
        certain,
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
