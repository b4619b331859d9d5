"""How well bodies and their blends explain samples, sixteen side by side: each as it would come out alone."""

from __future__ import annotations

import numba
import numpy as np

from geomocap.model.motion_paths import DEPTH_FRACTION
from geomocap.model.small_systems import solve_symmetric

LANES = 16  # samples
_AT_ONCE = 20  # frames


# Samples are worked on in lanes, last in all arrays; L are `LANES` of them. Each adds up as its sample alone would.
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(samples, rows, positions, weights, ray, seen, share, total):
    """Fill in what is known of samples[rows]: (T, 6 L) positions and rays, (T, L) weights, and their sums, (L,)."""
    for q in range(LANES):
        total[q] = 1e-12
        for t in range(len(share)):
            share[t, q] = 0.0
            for c in range(6):
                seen[t, LANES * c + q] = 0.0
            if q < len(rows):
                n = samples[rows[q]]
                share[t, q] = weights[n, t]
                total[q] += weights[n, t]
                for c in range(3):
                    seen[t, LANES * c + q] = positions[n, t, c]
                    if ray is not None:
                        seen[t, 3 * LANES + LANES * c + q] = ray[n, t, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _places_in_lanes(seen, share, total, ray, rotations, translations, places):
    """Fill in the places (3, L) of samples at rest by one body's motion, as `_place_at_rest` does."""
    part = 1.0 - DEPTH_FRACTION**2
    S, sums = np.zeros((9, LANES)), np.empty(LANES)
    for q in range(LANES):
        sums[q] = total[q]
    for t in range(len(share)):
        now, weight = seen[t], share[t]
        a, b, c = translations[t, 0], translations[t, 1], translations[t, 2]
        r0, r1, r2 = rotations[t, 0, 0], rotations[t, 0, 1], rotations[t, 0, 2]
        r3, r4, r5 = rotations[t, 1, 0], rotations[t, 1, 1], rotations[t, 1, 2]
        r6, r7, r8 = rotations[t, 2, 0], rotations[t, 2, 1], rotations[t, 2, 2]
        for q in range(LANES):
            w = weight[q] / sums[q]
            x, y, z = now[q] - a, now[LANES + q] - b, now[2 * LANES + q] - c
            if ray is not None:
                k, m, n = now[3 * LANES + q], now[4 * LANES + q], now[5 * LANES + q]
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
    for q in range(LANES):
        for c in range(3):
            place[c] = S[c, q]
        if ray is not None:
            normal[0, 0], normal[0, 1], normal[0, 2] = S[3, q], S[4, q], S[5, q]
            normal[1, 1], normal[1, 2], normal[2, 2] = S[6, q], S[7, q], S[8, q]
            solve_symmetric(normal, place, place)
        for c in range(3):
            places[c, q] = place[c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _misses_in_lanes(seen, share, total, ray, rotations, translations, places, cap, misses, costs):
    """Fill in what one body misses of samples, (T, 3 L), observed minus carried, and its costs (L,)."""
    part = 1.0 - DEPTH_FRACTION
    P, sums = np.empty((3, LANES)), np.zeros(LANES)
    for c in range(3):
        for q in range(LANES):
            P[c, q] = places[c, q]
    for t in range(len(share)):
        now, weight, miss = seen[t], share[t], misses[t]
        a, b, c = translations[t, 0], translations[t, 1], translations[t, 2]
        r0, r1, r2 = rotations[t, 0, 0], rotations[t, 0, 1], rotations[t, 0, 2]
        r3, r4, r5 = rotations[t, 1, 0], rotations[t, 1, 1], rotations[t, 1, 2]
        r6, r7, r8 = rotations[t, 2, 0], rotations[t, 2, 1], rotations[t, 2, 2]
        for q in range(LANES):
            x = now[q] - (a + r0 * P[0, q] + r1 * P[1, q] + r2 * P[2, q])
            y = now[LANES + q] - (b + r3 * P[0, q] + r4 * P[1, q] + r5 * P[2, q])
            z = now[2 * LANES + q] - (c + r6 * P[0, q] + r7 * P[1, q] + r8 * P[2, q])
            if ray is not None:
                k, m, n = now[3 * LANES + q], now[4 * LANES + q], now[5 * LANES + q]
                along = x * k + y * m + z * n
                x, y, z = x - part * along * k, y - part * along * m, z - part * along * n
            miss[q] = x
            miss[LANES + q] = y
            miss[2 * LANES + q] = z
            sums[q] += weight[q] * min(x * x + y * y + z * z, cap)
    for q in range(LANES):
        costs[q] = sums[q] / total[q]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _blend_in_lanes(first, second, share, total, penalty, cap, most, fraction, costs):
    """Fill in the best weights of the first of two bodies, (L,), -1: none, and costs that are right if below `most`.

    Misses of the bodies are (T, 3 L), `most` is (2, L): where the first, or the second body is the main one.
    """
    S, w = np.zeros((6, LANES)), np.empty(LANES)
    for q in range(LANES):
        S[3, q] = 1e-18
    for t in range(len(share)):
        one, other, weight = first[t], second[t], share[t]
        for q in range(LANES):
            # observed = w carried by the first + (1 - w) carried by the second: linear in w
            # three sums each, of which none waits for another
            v = weight[q]
            d = other[q] - one[q]
            e = other[LANES + q] - one[LANES + q]
            f = other[2 * LANES + q] - one[2 * LANES + q]
            S[0, q] += v * other[q] * d
            S[1, q] += v * other[LANES + q] * e
            S[2, q] += v * other[2 * LANES + q] * f
            S[3, q] += v * d * d
            S[4, q] += v * e * e
            S[5, q] += v * f * f
    # of w² below - 2 w above + constant + 4 w (1 - w) penalty: the least in [0, 1]
    for q in range(LANES):
        above, below = S[0, q] + S[1, q] + S[2, q], S[3, q] + S[4, q] + S[5, q]
        curve = below / total[q] - 4.0 * penalty
        w[q] = (above / total[q] - 2.0 * penalty) / curve if curve > 1e-18 else -1.0
        fraction[q] = w[q] if w[q] > 0.0 and w[q] < 1.0 else -1.0
        S[0, q] = 0.0
        S[1, q] = most[0, q] if w[q] >= 0.5 else most[1, q]
    for begin in range(0, len(share), _AT_ONCE):
        open_still = False  # costs only grow from frame to frame
        for q in range(LANES):
            costs[q] = S[0, q] / total[q] + 4.0 * w[q] * (1.0 - w[q]) * penalty
            open_still |= fraction[q] >= 0.0 and costs[q] < S[1, q]
        if not open_still:
            return
        for t in range(begin, min(begin + _AT_ONCE, len(share))):
            one, other, weight = first[t], second[t], share[t]
            for q in range(LANES):
                x = w[q] * one[q] + (1.0 - w[q]) * other[q]
                y = w[q] * one[LANES + q] + (1.0 - w[q]) * other[LANES + q]
                z = w[q] * one[2 * LANES + q] + (1.0 - w[q]) * other[2 * LANES + q]
                S[0, q] += weight[q] * min(x * x + y * y + z * z, cap)
    for q in range(LANES):
        costs[q] = S[0, q] / total[q] + 4.0 * w[q] * (1.0 - w[q]) * penalty


@numba.njit(cache=True, nogil=True, error_model="numpy")
def explain_samples(
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
    """Fill the rows `order[L * begin : L * end]` of the results, see `explain`; `ray` is None where there are none."""
    bodies, frames = len(rotations), weights.shape[1]
    seen, share, total = np.empty((frames, 6 * LANES)), np.empty((frames, LANES)), np.empty(LANES)
    misses, places = np.empty((bodies, frames, 3 * LANES)), np.empty((3, LANES))
    cost, part, most = np.empty(LANES), np.empty(LANES), np.empty((2, LANES))
    for low in range(LANES * begin, min(LANES * end, len(order)), LANES):
        rows = order[low : low + LANES]
        _gather(samples, rows, positions, weights, ray, seen, share, total)
        for b in range(bodies):
            asked, unsure = False, False
            for row in rows:
                asked |= allowed[row, b]
                unsure |= allowed[row, b] and not certain[samples[row]]
            if not asked:
                continue
            if unsure:
                _places_in_lanes(seen, share, total, ray, rotations[b], translations[b], places)
            for q in range(LANES):
                n = samples[rows[min(q, len(rows) - 1)]]
                if certain[n]:
                    for c in range(3):
                        places[c, q] = rest[n, c]
            _misses_in_lanes(seen, share, total, ray, rotations[b], translations[b], places, cap, misses[b], cost)
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
                for q in range(len(rows), LANES):
                    most[0, q] = most[1, q] = -1.0
                _blend_in_lanes(misses[a], misses[b], share, total, penalty, cap, most, part, cost)
                for q, row in enumerate(rows):
                    main, other, w = (a, b, part[q]) if part[q] >= 0.5 else (b, a, 1.0 - part[q])
                    if part[q] > 0.0 and cost[q] < (most[0, q] if main == a else most[1, q]):
                        costs[row, main] = cost[q]
                        partner[row, main] = other
                        fraction[row, main] = w
