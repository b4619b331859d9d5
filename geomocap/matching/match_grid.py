"""The grid of points that are matched over a template image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_DIRECTIONS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))


@dataclass(frozen=True)
class MatchGrid:
    """Cells over the template image: where to match and who is whose neighbour.

    Attributes
    ----------
    pixels : (N, 2) float
        Cell positions in the template image, COLMAP pixels, row by row.
    row, column : (N,) int
        Places in the grid.
    shape : (rows, columns)
    neighbours : (N, 8) int
        Cells left, right, above, below, then the diagonals; -1 where there is none.
    step : float
        Distance of neighbouring cells, pixels.
    """

    pixels: np.ndarray
    row: np.ndarray
    column: np.ndarray
    shape: tuple[int, int]
    neighbours: np.ndarray
    step: float

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def over(cls, shape: tuple[int, int], step: float, mask: np.ndarray | None = None) -> MatchGrid:
        """Cover an image of shape (H, W), inside its mask, with cells `step` pixels apart."""
        xs = np.arange(0.5 + step / 2, shape[1], step)
        ys = np.arange(0.5 + step / 2, shape[0], step)
        inside = np.ones((len(ys), len(xs)), bool)
        if mask is not None:
            rows = np.minimum(ys.astype(int), shape[0] - 1)
            columns = np.minimum(xs.astype(int), shape[1] - 1)
            inside = np.asarray(mask)[rows[:, None], columns[None, :]] != 0
        row, column = np.nonzero(inside)
        number = np.full((len(ys) + 2, len(xs) + 2), -1, np.int64)
        number[row + 1, column + 1] = np.arange(len(row))
        neighbours = np.column_stack([number[row + 1 + dy, column + 1 + dx] for dy, dx in _DIRECTIONS])
        pixels = np.column_stack([xs[column], ys[row]])
        return cls(pixels, row, column, inside.shape, neighbours.reshape(-1, 8), step)

    def image(self, values: np.ndarray, fill: float = np.nan) -> np.ndarray:
        """Spread values (N, …) of the cells over the grid: (rows, columns, …)."""
        picture = np.full((*self.shape, *np.shape(values)[1:]), fill, dtype=np.result_type(values, type(fill)))
        picture[self.row, self.column] = values
        return picture
