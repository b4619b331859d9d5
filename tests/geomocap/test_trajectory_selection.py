"""Choosing trajectories: evenly over the surface, long ones first."""

import numpy as np
from scipy.spatial import cKDTree

from geomocap.trajectories.selection import spread_out

FRAMES = 60


def trajectories(places: np.ndarray, lengths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) that stay, each seen for so many frames in a row: (N, T, 3), NaN elsewhere."""
    seen = np.full((len(places), FRAMES, 3), np.nan)
    for row, length in enumerate(lengths):
        begin = rng.integers(FRAMES - length + 1)
        seen[row, begin : begin + length] = places[row]
    return seen


def test_what_is_hardly_ever_seen_is_left_out() -> None:
    rng = np.random.default_rng(0)
    lengths = np.where(np.arange(300) % 2 == 0, 5, 30)
    chosen = spread_out(trajectories(rng.uniform(0, 1, (300, 3)), lengths, rng), 0.0)
    np.testing.assert_array_equal(chosen, np.arange(1, 300, 2))


def test_of_neighbours_the_longest_is_chosen() -> None:
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*3 * [np.arange(5.0)]), axis=-1).reshape(-1, 3)
    places = np.concatenate([grid, grid + 0.01])
    lengths = np.repeat([50, FRAMES], len(grid))  # all are measured in the middle
    chosen = spread_out(trajectories(places, lengths, rng), 0.1)
    np.testing.assert_array_equal(chosen, np.arange(len(grid), 2 * len(grid)))


def test_dense_and_sparse_parts_have_as_many() -> None:
    rng = np.random.default_rng(0)
    dense, sparse = rng.uniform([0, 0, 0], [1, 1, 0], (20_000, 3)), rng.uniform([1, 0, 0], [2, 1, 0], (2_000, 3))
    places = np.concatenate([dense, sparse])
    chosen = places[spread_out(trajectories(places, np.full(len(places), FRAMES), rng), 0.05)]
    fraction = (chosen[:, 0] < 1).mean()
    assert 0.45 < fraction < 0.6
    assert cKDTree(chosen).query(chosen, k=2)[0][:, 1].min() > 0.05


def test_none() -> None:
    assert spread_out(np.empty((0, FRAMES, 3)), 0.1).shape == (0,)
