"""Which pieces of a surface paths speak for."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.nodes.surface_coverage import (
    SMALLEST_PIECE,
    even_spacing,
    left_over,
    piece_reach,
    uncovered,
    uncovered_fraction,
)

FRAMES = 10


def square(step: float) -> np.ndarray:
    """Points of the square 1 m × 1 m, evenly."""
    x, y = np.meshgrid(np.arange(step / 2, 1, step), np.arange(step / 2, 1, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def standing(points: np.ndarray) -> np.ndarray:
    """Paths of points that rest."""
    return np.repeat(points[:, None], FRAMES, axis=1)


@pytest.mark.parametrize("step", [0.01, 0.02])
def test_reach_is_the_radius_of_a_smallest_piece_however_dense_the_points(step):
    area = np.pi * piece_reach(square(step)) ** 2
    assert SMALLEST_PIECE < area < 2.5 * SMALLEST_PIECE  # discs that cover all overlap


@pytest.mark.parametrize("step", [0.01, 0.02])
def test_even_spacing_is_that_of_so_many_points(step):
    points = np.concatenate([square(step), square(step / 2)[:4000]])  # denser in one part
    assert 0.8 / np.sqrt(500) < even_spacing(points, 500) < 1.5 / np.sqrt(500)


def test_uncovered_is_what_is_out_of_reach():
    points = square(0.01)
    paths = np.array([[0.0, 0, 0], [0.0, 1.0, 0], [np.nan] * 3])
    expected = np.minimum(np.linalg.norm(points, axis=1), np.linalg.norm(points - [0, 1, 0], axis=1)) > 0.3
    np.testing.assert_array_equal(uncovered(points, paths, 0.3), expected)
    assert uncovered(points, paths[2:], 0.3).all()


def test_fraction_counts_frames_without_paths():
    paths = standing(square(0.05))
    assert uncovered_fraction(lambda k: square(0.02), paths, 0.1) == 0.0
    paths[paths[:, 0, 0] > 0.5, 5:] = np.nan  # half the square, in half the frames
    fraction = uncovered_fraction(lambda k: square(0.02), paths, 0.1)
    assert 0.5 * 0.4 * 4 / 9 - 0.05 < fraction < 0.25


def test_left_over_is_what_is_uncovered_in_most_frames_in_which_it_is_there():
    paths = standing(np.zeros((1, 3)))
    paths[:, 7:] = np.nan
    samples = standing(np.array([[0.05, 0, 0], [1.0, 0, 0], [0.05, 0, 0]]))
    samples[2, :6] = np.nan  # there in frames 6 to 9: uncovered in three of four
    np.testing.assert_array_equal(left_over(samples, paths, 0.1), [False, True, True])
