"""The merge stage of the first frame: neighbouring ellipsoids whose union is still a good ellipsoid become one."""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.model.ellipsoids import eigen_axes, equivalent_length, error_terms
from geomocap.segmentation.contacts import count_contacts
from geomocap.segmentation.ellipsoid_splitting import SplitFrame

_NONE = 1e30


@njit(cache=True, nogil=True, error_model="numpy")
def _union_error(
    points: np.ndarray, starts: np.ndarray, after: np.ndarray, moments: np.ndarray, i: int, j: int, limit: float
) -> float:
    """Error of one ellipsoid for the sets i and j; `_NONE` if it is above the limit."""
    m = moments[i] + moments[j]
    variances = np.empty(3)
    axes = np.empty((3, 3))
    eigen_axes(m, variances, axes)
    total = 0.0
    enough = limit**2.5 * m[0] * (1.0 + 1e-9)
    for first in (i, j):
        leaf = first
        while leaf >= 0:
            total += error_terms(points, starts[leaf], starts[leaf + 1], m, variances, axes)
            if total > enough:
                return _NONE
            leaf = after[leaf]
    return equivalent_length(total / m[0])


@njit(cache=True, nogil=True, error_model="numpy")
def merge_leaves(
    points: np.ndarray, starts: np.ndarray, moments: np.ndarray, contacts: np.ndarray, limit: float
) -> np.ndarray:
    """Merge neighbouring sets, lowest error of the union first, while it is below the limit (section 5.2.2).

    Parameters
    ----------
    points : (N, 3) float, grid units
        Points leaf by leaf.
    starts : (L + 1,) int
        Leaf k is points[starts[k]:starts[k + 1]].
    moments : (L, 10) float, grid units
    contacts : (L, L) int
        Non-zero where two leaves touch.
    limit : float
        Equivalent length, grid units.

    Returns
    -------
    (L,) int32
        Merged set of each leaf, numbered in the order of the first leaves.
    """
    n = moments.shape[0]
    moments = moments.copy()
    touches = contacts > 0
    alive = np.ones(n, np.bool_)
    tail = np.arange(n)
    after = np.full(n, -1, np.int64)
    errors = np.full((n, n), _NONE)
    for i in range(n):
        for j in range(i + 1, n):
            if touches[i, j]:
                errors[i, j] = _union_error(points, starts, after, moments, i, j, limit)
    while True:
        a, b, best = n, n, limit
        for i in range(n):
            if alive[i]:
                for j in range(i + 1, n):
                    if errors[i, j] < best:
                        a, b, best = i, j, errors[i, j]
        if a == n:
            break
        moments[a] += moments[b]
        after[tail[a]] = b
        tail[a] = tail[b]
        alive[b] = False
        for j in range(n):
            errors[min(b, j), max(b, j)] = _NONE
            if j == a or not alive[j]:
                continue
            if touches[a, j] or touches[b, j]:
                touches[a, j] = touches[j, a] = True
                errors[min(a, j), max(a, j)] = _union_error(points, starts, after, moments, a, j, limit)
    merged = np.empty(n, np.int32)
    count = 0
    for i in range(n):
        if alive[i]:
            leaf = i
            while leaf >= 0:
                merged[leaf] = count
                leaf = after[leaf]
            count += 1
    return merged


def merge_frame(split: SplitFrame, limit: float) -> np.ndarray:
    """Merge the leaves of the first frame.

    Parameters
    ----------
    split : SplitFrame
    limit : float
        Greatest error of a merged ellipsoid, equivalent length, spacings.

    Returns
    -------
    (L,) int32
        Merged set of each leaf.
    """
    contacts = count_contacts(split.points, split.leaves, len(split.errors))
    return merge_leaves(split.points, split.starts.astype(np.int64), split.moments, contacts, limit)
