"""The heaviest set of choices of which no two exclude each other: branch and bound on sets of bits."""

from __future__ import annotations

import numpy as np
from numba import njit

MOST_NODES = 3_000  # of the search; the best found so far is returned then


def heaviest_choices(
    weights: np.ndarray, groups: np.ndarray, kinds: np.ndarray, excluded: np.ndarray, above: float = -np.inf
) -> list[int] | None:
    """Choose at most one of each group and of each kind, none excluding another, with the greatest sum of weights.

    Parameters
    ----------
    weights : (N,) float
        Positive.
    groups, kinds : (N,) int
    excluded : (N, N) bool
        Symmetric; choices of one group or kind exclude each other whatever it says.
    above : float
        Only sums above are looked for.

    Returns
    -------
    list of int or None
        None: no sum is above.
    """
    order = np.argsort(-weights, kind="stable")[::-1]  # the heaviest of a set is its highest bit
    other_groups, other_kinds = (of[order, None] != of[order] for of in (groups, kinds))
    allowed = ~excluded[np.ix_(order, order)] & other_groups & other_kinds
    value = np.ascontiguousarray(weights[order], np.float64)
    taken = _search(value, _bits(allowed), _bits(other_groups), _bits(other_kinds), float(above), MOST_NODES)
    return None if taken[0] == _NOTHING else [int(order[i]) for i in taken if i >= 0]


_NOTHING = -2  # in place of the first choice: no sum is above


@njit(cache=True, nogil=True, error_model="numpy")
def _search(value, allowed, other_groups, other_kinds, above, most):
    """Search depth first for the choices with the greatest sum, the heaviest choice of what is left first.

    Parameters
    ----------
    value : (N,) float64
        Rising weights.
    allowed, other_groups, other_kinds : (N, W) uint64
        Bits of the choices that each one leaves possible, and of those of other groups and kinds.
    above : float
        Only sums above are looked for.
    most : int
        Nodes of the search.

    Returns
    -------
    (N + 1,) int64
        The choices, filled up with -1; _NOTHING first if no sum is above.
    """
    N, W = allowed.shape
    best = np.full(N + 1, -1)
    best[0] = _NOTHING
    stack = np.zeros((N + 2, W), np.uint64)  # what is left; each node leaves one more in place of itself, with less
    totals = np.zeros(N + 2)
    counts = np.zeros(N + 2, np.int64)
    taken = np.empty((N + 2, N + 1), np.int64)
    left, spare = np.zeros(W, np.uint64), np.zeros(W, np.uint64)
    for i in range(N):
        stack[0, i >> 6] |= np.uint64(1) << np.uint64(i & 63)
    greatest, top, nodes = above, 1, 0
    while top > 0 and nodes < most:
        nodes += 1
        top -= 1
        total, count = totals[top], counts[top]
        for w in range(W):  # assigning whole arrays would take seconds more to compile
            left[w] = stack[top, w]
        if total > greatest + 1e-12:
            greatest = total
            for i in range(N + 1):
                best[i] = taken[top, i] if i < count else -1
        least = greatest + 1e-12
        if not _exceeds(least, total, left, other_groups, value, spare):
            continue
        if not _exceeds(least, total, left, other_kinds, value, spare):
            continue
        first = _highest(left)
        stack[top, first >> 6] &= ~(np.uint64(1) << np.uint64(first & 63))
        for w in range(W):
            stack[top + 1, w] = left[w] & allowed[first, w]
        totals[top + 1] = total + value[first]
        for i in range(count):
            taken[top + 1, i] = taken[top, i]
        taken[top + 1, count] = first
        counts[top + 1] = count + 1
        top += 2
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _exceeds(least, total, left, others, value, spare):
    """Whether choices from what is left, one of each set, can bring the total above `least`.

    `others` tells for each choice those of all other sets.
    """
    for word in range(left.size):
        spare[word] = left[word]
    for word in range(left.size - 1, -1, -1):
        while spare[word]:
            first = 64 * word + _highest_of(spare[word])
            total += value[first]
            if total > least:
                return True
            for k in range(word + 1):
                spare[k] &= others[first, k]
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _highest(bits):
    """Number of the highest bit of (W,) uint64 that is set; -1 if none is."""
    for word in range(bits.size - 1, -1, -1):
        if bits[word]:
            return 64 * word + _highest_of(bits[word])
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def _highest_of(word):
    """Number of the highest bit of a uint64 that isn't 0."""
    place = 0
    for half in (32, 16, 8, 4, 2, 1):
        if word >> np.uint64(half):
            word >>= np.uint64(half)
            place += half
    return place


def _bits(rows: np.ndarray) -> np.ndarray:
    """Pack rows (N, N) bool into words of 64 bits, (N, W) uint64: bit k of word w stands for column 64 w + k."""
    padded = np.zeros((len(rows), max(1, -(-rows.shape[1] // 64)) * 64), bool)
    padded[:, : rows.shape[1]] = rows
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64)
