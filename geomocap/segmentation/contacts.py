"""Which sets of points touch: neighbours in a hashed grid whose cells are as large as the point spacing."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _slot(key: int, table: np.ndarray) -> int:
    """Place of a key in an open hash table, or the free place where it belongs; the table's length is a power of 2."""
    mask = table.shape[0] - 1
    place = (key * 0x9E3779B97F4A7C1) >> 20 & mask
    while table[place] != key and table[place] != -1:
        place = (place + 1) & mask
    return place


@njit(cache=True, nogil=True, error_model="numpy")
def count_contacts(points: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Count the neighbouring pairs of points between each two sets.

    Two points are neighbours if their cells are the same or among the 26 around.

    Parameters
    ----------
    points : (N, 3) float, grid units
        The first layer of points along each axis is centred in its layer of cells.
    labels : (N,) int
        Set of each point; negative: none.
    count : int
        Number of sets K.

    Returns
    -------
    (K, K) int32
        Symmetric; zero on the diagonal.
    """
    n = points.shape[0]
    contacts = np.zeros((count, count), np.int32)
    if n == 0:
        return contacts
    low = points[0].copy()
    high = points[0].copy()
    for i in range(n):
        for a in range(3):
            low[a] = min(low[a], points[i, a])
            high[a] = max(high[a], points[i, a])
    # one empty layer around, so that a neighbour's key never wraps into the next row
    ny = np.int64(np.floor(high[1] - low[1] + 0.5)) + 3
    nz = np.int64(np.floor(high[2] - low[2] + 0.5)) + 3
    size = 16
    while size < 2 * n:
        size *= 2
    table = np.full(size, -1, np.int64)
    first = np.full(size, -1, np.int32)
    after = np.full(n, -1, np.int32)
    keys = np.empty(n, np.int64)
    for i in range(n):
        x = np.int64(np.floor(points[i, 0] - low[0] + 0.5)) + 1
        y = np.int64(np.floor(points[i, 1] - low[1] + 0.5)) + 1
        z = np.int64(np.floor(points[i, 2] - low[2] + 0.5)) + 1
        keys[i] = (x * ny + y) * nz + z
        place = _slot(keys[i], table)
        table[place] = keys[i]
        after[i] = first[place]
        first[place] = i
    steps = np.empty(13, np.int64)
    filled = 0
    for dx in range(2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                if dx > 0 or dy > 0 or (dy == 0 and dz > 0):
                    steps[filled] = (dx * ny + dy) * nz + dz
                    filled += 1
    for i in range(n):
        a = labels[i]
        if a < 0:
            continue
        j = after[i]  # the rest of its own cell
        while j >= 0:
            b = labels[j]
            if b >= 0 and b != a:
                contacts[a, b] += 1
                contacts[b, a] += 1
            j = after[j]
        for s in range(13):
            place = _slot(keys[i] + steps[s], table)
            j = first[place]
            while j >= 0:
                b = labels[j]
                if b >= 0 and b != a:
                    contacts[a, b] += 1
                    contacts[b, a] += 1
                j = after[j]
    return contacts


def contacts_of_bodies(
    contacts: np.ndarray, touching: np.ndarray, body: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Contacts of bodies from those of their ellipsoids.

    Parameters
    ----------
    contacts, touching : (K, K) float
        Neighbouring pairs of points between two ellipsoids, and the fraction of the frames in which they touch.
    body : (K,) int
        Body of each ellipsoid; negative: none.
    count : int
        Number of bodies B.

    Returns
    -------
    contacts : (B, B) float
        Sums; zero on the diagonal.
    touching : (B, B) float
        Those of the pair of ellipsoids that touches most.
    """
    member = (body[None] == np.arange(count)[:, None]).astype(float)
    between = member @ contacts @ member.T
    np.fill_diagonal(between, 0.0)
    most = np.zeros((count, count))
    for a in range(count):
        for b in range(a):
            most[a, b] = most[b, a] = touching[np.ix_(body == a, body == b)].max(initial=0.0)
    return between, most
