from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geomocap.model.point_grid import PointGrid


@settings(deadline=None)  # the kernels are compiled first
@given(
    seed=st.integers(0, 2**32 - 1),
    points=st.integers(1, 300),
    dimensions=st.integers(3, 11),
    k=st.integers(1, 14),
    sizes=st.lists(st.sampled_from([0.0, 1e-3, 1.0, 50.0]), min_size=3, max_size=3),
)
def test_distances_and_order_are_the_trees(seed, points, dimensions, k, sizes):
    rng = np.random.default_rng(seed)
    scale = np.append(sizes, np.full(dimensions - 3, 0.3))
    data = scale * rng.normal(size=(points, dimensions))
    asked = 2 * scale * rng.normal(size=(50, dimensions))
    reach = rng.choice([np.inf, 0.5])
    distances, indices = PointGrid.of(data).query(asked, k, reach)
    expected, order = cKDTree(data).query(asked, k, distance_upper_bound=reach)
    assert np.array_equal(distances, expected)
    # flat data may leave points equally far
    ties = np.diff(np.sort(np.linalg.norm(asked[:, None] - data, axis=2), axis=1), axis=1).min(initial=1.0) < 1e-12
    assert ties or np.array_equal(indices, order)


@pytest.mark.parametrize("away", [1e-12, 1.0, 1e9])
def test_points_anywhere_are_found(away):
    data = np.random.default_rng(0).normal(size=(200, 3))
    data[0] = away
    asked = np.vstack([data, np.full(3, -1e6), np.full(3, 1e12)])
    assert np.array_equal(PointGrid.of(data).query(asked)[0], cKDTree(data).query(asked)[0])


def test_equal_points_are_all_found():
    distances, indices = PointGrid.of(np.ones((5, 4))).query(np.ones((1, 4)), 7)
    assert np.array_equal(distances[0], [0] * 5 + [np.inf] * 2)
    assert sorted(indices[0]) == [0, 1, 2, 3, 4, 5, 5]


def test_no_points_are_far():
    distances, indices = PointGrid.of(np.zeros((0, 3))).query(np.zeros((2, 3)))
    assert np.array_equal(distances, [np.inf] * 2)
    assert np.array_equal(indices, [0, 0])


def test_points_that_are_not_finite_are_refused():
    grid = PointGrid.of(np.zeros((2, 3)))
    for wrong in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            PointGrid.of(np.full((1, 3), wrong))
        with pytest.raises(ValueError, match="finite"):
            grid.query(np.full((1, 3), wrong))
