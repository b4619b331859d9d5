"""Which samples of a moving surface are neighbours: those that stay near each other all the time."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from geomocap.model.even_choice import evenly_chosen
from geomocap.scheduling import spread

_FRAMES = 20  # looked at
_FAR = np.float32(1e9)
_BRIDGE = 3.0  # times the usual distance of neighbours


@dataclass(frozen=True)
class SurfaceGraph:
    """Neighbourhood of N samples.

    Attributes
    ----------
    adjacency : (N, N) csr_matrix of float, metres
        Symmetric; distance in the reference, of samples that are neighbours on the surface.
    lasting : (N, N) float32, metres
        Lasting distance of each two samples: the third largest over the frames looked at (the largest of few frames).
    spacing : float, metres
        Median lasting distance of nearest neighbours.
    """

    adjacency: csr_matrix
    lasting: np.ndarray
    spacing: float

    @property
    def neighbours(self) -> np.ndarray:
        """Which samples are neighbours, (N, N) bool."""
        dense = np.zeros(self.adjacency.shape, bool)
        dense[self.adjacency.nonzero()] = True
        return dense

    def geodesics(self, limit: float) -> np.ndarray:
        """Distances along the surface, (N, N) float, metres; infinite beyond the limit."""
        return dijkstra(self.adjacency, directed=False, limit=limit)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distances_of(i, positions, rank, result):
    """Fill row i and column i as far as the diagonal."""
    best = np.empty(rank)
    for j in range(i):
        best[:] = 0.0
        for t in range(positions.shape[1]):
            x = positions[i, t, 0] - positions[j, t, 0]
            y = positions[i, t, 1] - positions[j, t, 1]
            z = positions[i, t, 2] - positions[j, t, 2]
            square = x * x + y * y + z * z
            if square > best[0]:  # best holds the largest so far, smallest of them first
                k = 0
                while k + 1 < rank and best[k + 1] < square:
                    best[k] = best[k + 1]
                    k += 1
                best[k] = square
        result[i, j] = result[j, i] = np.sqrt(best[0])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lasting_distances(begin, end, positions, rank, result):
    for i in range(begin, end):
        _distances_of(i, positions, rank, result)


def lasting_distances(positions: np.ndarray) -> np.ndarray:
    """Distance that two samples reach again and again: the third largest of those in up to 20 frames.

    A hand that rests on a hip for a while is far from it at other times; that is how false contacts are told from
    surface. The two largest distances are left to faults of the tracking.

    Parameters
    ----------
    positions : (N, T, 3) float, metres
        Complete.

    Returns
    -------
    (N, N) float32, metres
    """
    looked_at = evenly_chosen(positions.shape[1], _FRAMES)
    rank = 3 if len(looked_at) >= 12 else 1
    result = np.zeros((len(positions), len(positions)), np.float32)
    some = np.ascontiguousarray(positions[:, looked_at], np.float64)
    spread(_lasting_distances, len(some), some, rank, result)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bridges_of(i, apart, limit, result):
    """Fill row i."""
    count = len(apart)
    for j in range(count):
        distance = apart[i, j]
        if j == i or distance > min(limit[i], limit[j]):
            continue
        between = False
        for k in range(count):
            if max(apart[i, k], apart[k, j]) < distance:
                between = True
                break
        result[i, j] = not between


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bridges(begin, end, apart, limit, result):
    for i in range(begin, end):
        _bridges_of(i, apart, limit, result)


def bridges(apart: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Pairs of samples with no third one nearer to both: neighbours across gaps (relative neighbourhood graph).

    Where samples are dense on both sides of a strip without any, none across the strip is among the nearest of one.

    Parameters
    ----------
    apart : (N, N) float32, metres
        Symmetric.
    limit : (N,) float, metres
        Farthest that a sample reaches; a pair needs both.

    Returns
    -------
    (N, N) bool
        Symmetric.
    """
    result = np.zeros(apart.shape, bool)
    spread(_bridges, len(apart), apart, limit.astype(np.float32), result)
    return result


def surface_graph(positions: np.ndarray, reference: np.ndarray, neighbours: int, max_stretch: float) -> SurfaceGraph:
    """Connect each sample with those nearest to it in lasting distance, and across gaps with no sample in between.

    Parameters
    ----------
    positions : (N, T, 3) float, metres
        Complete.
    reference : (N, 3) float, metres
    neighbours : int
        Neighbours of a sample, before symmetry.
    max_stretch : float
        Pairs whose lasting distance is more than this many times both their samples' usual distance of neighbours are
        no neighbours.
    """
    lasting = lasting_distances(positions)
    count = len(lasting)
    neighbours = min(neighbours, count - 1)
    apart = lasting + np.diag(np.full(count, _FAR))
    order = np.argpartition(apart, neighbours - 1, axis=1)[:, :neighbours]
    near = np.sort(np.take_along_axis(apart, order, axis=1), axis=1)
    usual = near[:, min(5, neighbours - 1)]
    rows = np.repeat(np.arange(count), neighbours)
    columns = order.ravel()
    limit = max_stretch * np.minimum(usual[rows], usual[columns])
    # the three nearest stay connected in any case
    rank = np.argsort(np.argsort(np.take_along_axis(apart, order, axis=1), axis=1), axis=1).ravel()
    keep = (apart[rows, columns] <= limit) | (rank < 3)
    linked = bridges(apart, _BRIDGE * usual)
    linked[rows[keep], columns[keep]] = True
    rows, columns = np.nonzero(linked)
    lengths = np.linalg.norm(reference[rows] - reference[columns], axis=1) + 1e-9
    one_way = csr_matrix((lengths, (rows, columns)), shape=(count, count))
    return SurfaceGraph(one_way.maximum(one_way.T).tocsr(), lasting, float(np.median(near[:, 0])))
