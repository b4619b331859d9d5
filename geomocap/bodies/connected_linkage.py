"""Average linkage of samples that only joins neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

_NEVER = np.inf


@dataclass(frozen=True)
class Dendrogram:
    """A tree of merges of N samples.

    Attributes
    ----------
    merges : (N - C, 2) int32
        Clusters joined, by one of their samples: the second becomes part of the first. C: unconnected parts.
    heights : (N - C,) float
        Mean distance between the two.
    count : int
        Number of samples N.
    """

    merges: np.ndarray
    heights: np.ndarray
    count: int

    def cut(self, height: float) -> np.ndarray:
        """Labels 0 … K - 1, (N,) int32, numbered by first sample; merges up to the first that exceeds the height."""
        above = np.flatnonzero(self.heights > height)
        return self._labels(int(above[0]) if len(above) else len(self.heights))

    def cut_count(self, clusters: int) -> np.ndarray:
        """Labels of a given number of clusters, or as near to it as unconnected parts allow."""
        return self._labels(max(0, min(self.count - clusters, len(self.heights))))

    def _labels(self, merges: int) -> np.ndarray:
        parent = np.arange(self.count)
        for a, b in self.merges[:merges]:
            parent[b] = a
        while True:
            upper = parent[parent]
            if np.array_equal(upper, parent):
                break
            parent = upper
        _, first, inverse = np.unique(parent, return_index=True, return_inverse=True)
        return np.argsort(np.argsort(first))[inverse].astype(np.int32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _nearest(row: np.ndarray, linked: np.ndarray, alive: np.ndarray, i: int) -> tuple[int, float]:
    best, at = _NEVER, -1
    for j in range(len(row)):
        if j != i and linked[j] and alive[j] and row[j] < best:
            best, at = row[j], j
    return at, best


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _link(distances: np.ndarray, linked: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count = len(distances)
    alive = np.ones(count, np.bool_)
    nearest = np.empty(count, np.int64)
    gap = np.empty(count)
    for i in range(count):
        nearest[i], gap[i] = _nearest(distances[i], linked[i], alive, i)
    merges = np.empty((max(count - 1, 0), 2), np.int32)
    heights = np.empty(max(count - 1, 0))
    done = 0
    while True:
        a = 0
        for i in range(count):
            if alive[i] and (not alive[a] or gap[i] < gap[a]):
                a = i
        if not alive[a] or nearest[a] < 0:
            break
        b = nearest[a]
        if b < a:
            a, b = b, a
        merges[done, 0], merges[done, 1] = a, b
        heights[done] = distances[a, b]
        done += 1
        alive[b] = False
        fraction = sizes[a] / (sizes[a] + sizes[b])
        sizes[a] += sizes[b]
        for j in range(count):
            if alive[j] and j != a:
                mean = fraction * distances[a, j] + (1.0 - fraction) * distances[b, j]
                distances[a, j] = mean
                distances[j, a] = mean
                if linked[b, j]:
                    linked[a, j] = True
                    linked[j, a] = True
        nearest[a], gap[a] = _nearest(distances[a], linked[a], alive, a)
        for j in range(count):
            if alive[j] and j != a and linked[j, a]:
                if nearest[j] == a or nearest[j] == b:
                    nearest[j], gap[j] = _nearest(distances[j], linked[j], alive, j)
                elif distances[j, a] < gap[j]:
                    nearest[j], gap[j] = a, distances[j, a]
    return merges[:done], heights[:done]


def connected_linkage(distances: np.ndarray, linked: np.ndarray, sizes: np.ndarray | None = None) -> Dendrogram:
    """Join the two neighbouring clusters of least mean distance, again and again.

    Parameters
    ----------
    distances : (N, N) float
        Symmetric.
    linked : (N, N) bool
        Which samples are neighbours; symmetric.
    sizes : (N,) float, optional
        Weight of each sample; 1 if not given.

    Returns
    -------
    Dendrogram
        Equal distances are decided by the lower number, so the result repeats.
    """
    sizes = np.ones(len(distances)) if sizes is None else np.array(sizes, float)
    merges, heights = _link(np.array(distances, np.float64), np.array(linked, bool), sizes)
    return Dendrogram(merges, heights, len(distances))
