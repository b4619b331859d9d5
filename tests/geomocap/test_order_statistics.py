"""Medians inside kernels are those of NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from geomocap.model.order_statistics import median, nth_smallest

VALUES = arrays(np.float64, st.integers(1, 40), elements=st.sampled_from([0.0, 0.1, 0.25, 1.0, 3.5, 7.0, np.inf]))


@settings(deadline=None)
@given(VALUES, st.data())
def test_nth_smallest_is_that_of_sorting(values, data):
    n = data.draw(st.integers(0, len(values) - 1))
    expected = np.sort(values)[n]
    room = values.copy()
    assert nth_smallest(room, n) == expected
    assert np.array_equal(np.sort(room), np.sort(values))


@pytest.mark.parametrize("count", [1, 2, 3, 100, 1001])
def test_median_is_that_of_numpy_and_leaves_the_values_as_they_are(count):
    values = np.random.default_rng(count).normal(size=count)
    given_values = values.copy()
    assert median(values) == np.median(values)
    assert np.array_equal(values, given_values)
