"""Noise of a background: misses of frames, and their medians."""

import numpy as np
import pytest

from geomocap.silhouettes.background_noise import absolute_misses, middle


def test_misses_are_those_of_the_reference() -> None:
    rng = np.random.default_rng(4)
    images, mean = rng.integers(0, 256, (4, 50, 3), dtype=np.uint8), rng.uniform(0, 255, (20, 3)).astype(np.float32)
    pixels, gains, offsets = rng.choice(50, 20, replace=False), rng.uniform(0.9, 1.1, (4, 3)), rng.normal(size=(4, 3))
    misses = absolute_misses(images, pixels, mean, gains, offsets)
    expected = np.abs(images[:, pixels] - (gains[:, None] * mean + offsets[:, None]))
    np.testing.assert_array_equal(misses, expected.ravel())


@pytest.mark.parametrize("n", [1, 2, 7, 1999, 2000, 50_001, 50_002])
def test_the_middle_is_the_median(n: int) -> None:
    rng = np.random.default_rng(n)
    periodic = np.where(np.arange(n) % max(1, n // 1000) == 0, 5.0, np.arange(n))  # the sample tells nothing of it
    for values in (rng.normal(size=n), rng.integers(0, 3, n).astype(float), periodic):
        assert middle(values) == np.median(values)
