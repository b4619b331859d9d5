"""Which sets of points touch: neighbours in a grid whose cells are as large as the point spacing."""

from __future__ import annotations

import numpy as np
from numba import njit


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
    known = labels >= 0
    if not known.any():
        return np.zeros((count, count), np.int32)
    # one empty layer around, so that a neighbour's key never wraps into the next row
    cells = np.floor(points - points.min(axis=0) + 0.5).astype(np.int64) + 1
    shape = cells.max(axis=0) + 2
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    keys = cells[known] @ strides
    order = np.argsort(keys, kind="stable")
    return _count_neighbours(keys[order], labels[known][order], strides, count)


@njit(cache=True, nogil=True, error_model="numpy")
def _count_neighbours(keys, labels, strides, count):
    """Count the neighbouring pairs of points by their labels, from the keys of their cells (N,), ascending."""
    contacts = np.zeros((count, count), np.int32)
    for a in range(2):
        for b in range(-1, 2):
            for c in range(-1, 2):
                step, first = a * strides[0] + b * strides[1] + c * strides[2], 0
                if step < 0:
                    continue  # each two cells once
                for n in range(len(keys)):
                    while first < len(keys) and keys[first] < keys[n] + step:
                        first += 1
                    at = first if step > 0 else n + 1  # a point's own cell, too
                    while at < len(keys) and keys[at] == keys[n] + step:
                        contacts[labels[n], labels[at]] += 1
                        contacts[labels[at], labels[n]] += 1
                        at += 1
    np.fill_diagonal(contacts, 0)
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
