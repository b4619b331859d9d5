"""Nearest points, exactly, by cells of space: for points of surfaces with normals and colours beside their places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

# A surface meets few of the cells: one to four points are in those that it does. With 4 the nearest points of a
# galloping stag take a tenth longer, making the grid included; with 1 the twelve nearest ones in space do.
_CELLS_PER_POINT = 2


@dataclass(frozen=True)
class PointGrid:
    """Points by cell of their first three coordinates.

    The further coordinates only add to a distance: cells whose distance in space exceeds that of the best points so
    far need no look. A tree divides all coordinates alike, which tells little in nine of them. Distances and order are
    those of `scipy.spatial.cKDTree` bit for bit, ties aside. Points far from all others make the cells coarse, and the
    search slow, not wrong.

    Attributes
    ----------
    data : (M, D) float
        The points; D is at least 3.
    by_cell : (M, D) float
        The points, cell by cell.
    order : (M,) int
        Their indices.
    starts : (cells + 1,) int
        Where each cell's points begin.
    low : (3,) float
    shape : (3,) int
    cell : float
    """

    data: np.ndarray
    by_cell: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    low: np.ndarray
    shape: np.ndarray
    cell: float

    @classmethod
    def of(cls, points: np.ndarray) -> PointGrid:
        """Sort points (M, D), D at least 3, into cells.

        Raises
        ------
        ValueError
            If some are not finite.
        """
        points = _finite(points)
        places = points[:, :3]
        low, high = (places.min(axis=0), places.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
        cell, shape = _cells(high - low, _CELLS_PER_POINT * max(len(points), 1))
        order, starts = sort_by_cell(points, low, cell, shape)
        return cls(points, points[order], order, starts, low, shape, cell)

    @property
    def n(self) -> int:
        """Number of points."""
        return len(self.data)

    def query(self, x: np.ndarray, k: int = 1, reach: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Distances and indices of the k points nearest to each x (Q, D) within reach, nearest first.

        Both are (Q,) for k = 1 and (Q, k) else; where there are fewer points, distances are infinite and indices M.

        Raises
        ------
        ValueError
            If some x are not finite.
        """
        x = _finite(x)
        distances, indices = nearest_points(
            x, k, reach, self.by_cell, self.order, self.starts, self.low, self.shape, self.cell
        )
        return (distances[:, 0], indices[:, 0]) if k == 1 else (distances, indices)


def _finite(points: np.ndarray) -> np.ndarray:
    points = np.ascontiguousarray(points, float)
    if not np.isfinite(points).all():
        raise ValueError("points must be finite")
    return points


def _cells(size: np.ndarray, most: int) -> tuple[float, np.ndarray]:
    """Edge of cubes and their numbers (3,) in a box of a size (3,), of which there are about `most`."""
    size = size.clip(1e-6 * size.max())
    if not size.any():
        return 1.0, np.ones(3, int)
    # flat boxes and rods have one layer of cells, or one row
    for dimensions in (3, 2, 1):
        longest = np.sort(size)[-dimensions:]
        cell = float((np.prod(longest) / most) ** (1 / dimensions))
        if longest[0] >= cell:
            break
    return cell, np.floor(size / cell).astype(int) + 1


@njit(cache=True, nogil=True, error_model="numpy")
def sort_by_cell(points, low, cell, shape):
    """Indices of points (M, D) cell by cell, (M,), and where each cell's begin, (cells + 1,)."""
    at = np.empty(len(points), np.int64)
    starts = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    for m in range(len(points)):
        c = 0
        for d in range(3):
            c = c * shape[d] + min(int((points[m, d] - low[d]) / cell), shape[d] - 1)
        at[m] = c
        starts[c + 1] += 1
    for c in range(len(starts) - 1):
        starts[c + 1] += starts[c]
    order, filled = np.empty(len(points), np.int64), starts[:-1].copy()
    for m in range(len(points)):
        order[filled[at[m]]] = m
        filled[at[m]] += 1
    return order, starts


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_points(x, k, reach, points, order, starts, low, shape, cell):
    """Distances and indices (Q, k) of points within reach of x (Q, D): shells of cells, until all others are farther.

    `points`, `order`, `starts`, `low`, `shape` and `cell` are those of a `PointGrid`.
    """
    distances, indices = np.full((len(x), k), reach * reach), np.full((len(x), k), len(points))
    home = np.empty(3, np.int64)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for q in range(len(x)):
        best, index = distances[q], indices[q]
        for d in range(3):
            home[d] = int(min(max((x[q, d] - low[d]) / cell, 0.0), shape[d] - 1.0))
        shell = 0
        while True:
            # cells not looked at are beyond a side of the box that was
            beyond = np.inf
            for d in range(3):
                first[d], last[d] = max(home[d] - shell, 0), min(home[d] + shell, shape[d] - 1)
                if home[d] - shell > 0:
                    beyond = min(beyond, x[q, d] - (low[d] + first[d] * cell))
                if home[d] + shell < shape[d] - 1:
                    beyond = min(beyond, low[d] + (last[d] + 1) * cell - x[q, d])
            for i in range(first[0], last[0] + 1):
                side = _outside(x[q, 0], low[0] + i * cell, cell)
                for j in range(first[1], last[1] + 1):
                    if side + _outside(x[q, 1], low[1] + j * cell, cell) > best[k - 1]:
                        continue
                    row = (i * shape[1] + j) * shape[2]
                    if abs(i - home[0]) == shell or abs(j - home[1]) == shell:
                        _look(x[q], starts[row + first[2]], starts[row + last[2] + 1], points, order, best, index)
                        continue
                    if home[2] - shell >= 0:
                        c = row + home[2] - shell
                        _look(x[q], starts[c], starts[c + 1], points, order, best, index)
                    if home[2] + shell < shape[2]:
                        c = row + home[2] + shell
                        _look(x[q], starts[c], starts[c + 1], points, order, best, index)
            if beyond == np.inf or (beyond > 0 and beyond * beyond > best[k - 1]):
                break
            shell += 1
        for n in range(k):
            best[n] = np.sqrt(best[n]) if index[n] < len(points) else np.inf
    return distances, indices


@njit(cache=True, nogil=True, error_model="numpy")
def _outside(x, low, cell):
    """Squared distance of x from an interval that begins at low."""
    away = max(low - x, x - low - cell, 0.0)
    return away * away


@njit(cache=True, nogil=True, error_model="numpy")
def _look(x, start, end, points, order, best, index):
    """Keep the nearest ones of points from start to end, by squared distance, in order."""
    D, k = len(x), len(best)
    for m in range(start, end):
        # four sums side by side, as in SciPy
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        whole = D - D % 4
        for d in range(0, whole, 4):
            e0, e1 = x[d] - points[m, d], x[d + 1] - points[m, d + 1]
            e2, e3 = x[d + 2] - points[m, d + 2], x[d + 3] - points[m, d + 3]
            s0, s1, s2, s3 = s0 + e0 * e0, s1 + e1 * e1, s2 + e2 * e2, s3 + e3 * e3
            if s0 + s1 + s2 + s3 >= best[k - 1]:
                break
        s = s0 + s1 + s2 + s3
        for d in range(whole, D):
            e = x[d] - points[m, d]
            s += e * e
        if s >= best[k - 1]:
            continue
        n = k - 1
        while n > 0 and best[n - 1] > s:
            best[n], index[n] = best[n - 1], index[n - 1]
            n -= 1
        best[n], index[n] = s, order[m]
