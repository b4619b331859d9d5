"""How far the motions of two bodies carry their best common point apart: what `body_joints` asks for all pairs."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from geomocap.model.small_systems import solve_symmetric


@njit(cache=True, nogil=True, error_model="numpy")
def parting_of(rotations, translations, first, second, known, place, ridge, apart):
    """How two bodies' motions carry their best common point near a place apart.

    Parameters
    ----------
    rotations, translations : (B, T, 3, 3), (B, T, 3) float
    first, second : int
    known : (K,) int
        Frames that count.
    place : (3,) float, metres
    ridge : float
        Cost of a point off the place, mean square of the turn that moves it as far.
    apart : (K, 3) float, metres
        Filled.

    Returns
    -------
    float
        Mean square, metres².
    """
    count = len(known)
    normal, right, moved = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    turned = np.empty((3, 3))
    for k in range(count):
        t = known[k]
        for i in range(3):
            apart[k, i] = translations[first, t, i] - translations[second, t, i]
            for j in range(3):
                turned[i, j] = rotations[first, t, i, j] - rotations[second, t, i, j]
                apart[k, i] += turned[i, j] * place[j]
        for i in range(3):
            for j in range(3):
                right[i] -= turned[j, i] * apart[k, j]
                for m in range(i + 1):
                    normal[i, m] += turned[j, i] * turned[j, m]
    for i in range(3):
        right[i] /= count
        for m in range(i + 1):
            normal[i, m] /= count
            normal[m, i] = normal[i, m]
        normal[i, i] += ridge
    solve_symmetric(normal, right, moved)
    square = 0.0
    for k in range(count):
        t = known[k]
        for i in range(3):
            for j in range(3):
                apart[k, i] += (rotations[first, t, i, j] - rotations[second, t, i, j]) * moved[j]
            square += apart[k, i] * apart[k, i]
    return square / count


@njit(cache=True, nogil=True, error_model="numpy")
def frames_of(known, first, second, least, frames):
    """Put the frames that show both bodies of `known` (B, T) into `frames` (T,), all where they are fewer than `least`.

    Returns their number.
    """
    count = 0
    for t in range(known.shape[1]):
        if known[first, t] and known[second, t]:
            frames[count] = t
            count += 1
    if count >= min(least, known.shape[1]):
        return count
    for t in range(known.shape[1]):
        frames[t] = t
    return known.shape[1]


@njit(cache=True, nogil=True, error_model="numpy")
def joint_costs(bodies, body, rotations, translations, known, contacts, places, ridge, variance, least):
    """Log of how far bodies part where they touch each other or a given one, as multiples of the noise.

    Parameters
    ----------
    bodies : (n,) int
    body : int
        Where two others touched it, they may meet.
    rotations, translations : (B, T, 3, 3), (B, T, 3) float
    known : (B, T) bool
        Frames that show each body.
    contacts : (B, B) int
    places : (B, B, 3) float, metres
        Where bodies touch.
    ridge : float
        See `parting_of`.
    variance : float, metres²
        Of the noise.
    least : int
        Frames that must show two bodies; otherwise all frames count.

    Returns
    -------
    (n, n) float
        Symmetric; 0 on the diagonal.
    """
    n, T = len(bodies), known.shape[1]
    frames, apart = np.empty(T, np.int64), np.empty((T, 3))
    costs = np.zeros((n, n))
    for i in range(1, n):
        for k in range(i):
            a, b = bodies[i], bodies[k]
            count = frames_of(known, a, b, least, frames)
            miss = np.inf
            for at in range(3):
                if at == 0:
                    if contacts[a, b] == 0:
                        continue
                    place = places[a, b]
                elif body in (a, b):
                    continue
                else:
                    place = places[body, a] if at == 1 else places[body, b]
                miss = min(
                    miss,
                    parting_of(rotations, translations, a, b, frames[:count], place, ridge, apart[:count]),
                )
            costs[i, k] = costs[k, i] = math.log1p(miss / variance)
    return costs


@njit(cache=True, nogil=True, error_model="numpy")
def tree_cost(costs):
    """Sum of the edges of the minimum spanning tree of a complete graph, (n, n) costs (Prim 1957)."""
    n = len(costs)
    if n < 2:
        return 0.0
    nearest = costs[0].copy()
    left = np.ones(n, np.bool_)
    left[0] = False
    total = 0.0
    for _ in range(n - 1):
        best = -1
        for k in range(n):
            if left[k] and (best < 0 or nearest[k] < nearest[best]):
                best = k
        total += nearest[best]
        left[best] = False
        for k in range(n):
            nearest[k] = min(nearest[k], costs[best, k])
    return total
