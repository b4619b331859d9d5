"""Standard deviations as neighbours bear them out: known noise, known drift, and what is left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from geomocap.model.trajectories import LOW_PRECISION, Trajectories
from geomocap.trajectories.neighbour_precision import (
    carried_by,
    clear_unsure,
    neighbour_misses,
    turns,
    with_observed_precision,
)
from tests.geomocap.made_trajectories import rigid_tracks

FRAMES = 20
TURN = [2.0, 1.0, 3.0]


def surface(count: int = 800) -> np.ndarray:
    """Points on a ball of 0.3 m."""
    d = np.random.default_rng(3).normal(size=(count, 3))
    return 0.3 * d / np.linalg.norm(d, axis=1, keepdims=True)


def noisy(std: np.ndarray | float, told: float) -> Trajectories:
    """Points that are where they were placed, and `std` (N, T), metres, off in later frames, said to be `told`."""
    tracks = rigid_tracks(surface(), FRAMES, np.array([0.01, 0, 0]), np.array(TURN))
    noise = (
        np.random.default_rng(4).normal(size=tracks.positions.shape)
        * np.broadcast_to(np.asarray(std), tracks.sigma.shape)[:, :, None]
    )
    noise[:, 0] = 0.0
    return replace(tracks, positions=tracks.positions + noise, sigma=np.full_like(tracks.sigma, told))


def later(values: np.ndarray) -> np.ndarray:
    return values[:, 3:]


@pytest.mark.parametrize("told", [0.001, 0.002, 0.006])
def test_wrong_standard_deviations_come_out_right(told):
    found = with_observed_precision(noisy(0.002, told))
    assert abs(np.median(later(found.sigma)) - 0.002) < 0.0003
    assert_allclose(np.percentile(later(found.sigma), [5, 95]), 0.002, rtol=0.45)


def test_what_grows_with_the_turn_is_told():
    angle = np.degrees(turns(rigid_tracks(surface(5), FRAMES, np.zeros(3), np.array(TURN))))
    assert_allclose(angle, np.linalg.norm(TURN) * np.arange(FRAMES)[None].repeat(5, axis=0), atol=1e-5)
    std = 0.0005 + 0.0001 * angle[0]
    found = with_observed_precision(noisy(std[None], 0.001))
    typical = np.median(found.sigma, axis=0)
    assert_allclose(typical[5:-3], std[5:-3], rtol=0.25)  # beyond the outer medians it goes on level


def test_points_that_stray_are_told_from_the_others():
    std = np.full((800, FRAMES), 0.001)
    astray = np.arange(800) % 20 == 0
    std[astray] = 0.01
    found = with_observed_precision(noisy(std, 0.001))
    assert 0.004 < np.median(later(found.sigma[astray])) < 0.012
    assert np.median(later(found.sigma[~astray])) < 0.0016


def test_an_accurate_surface_stays_so():
    found = with_observed_precision(noisy(0.0, 0.001))
    assert (found.sigma > 0).all() and (later(found.sigma) < 0.0005).all()


def test_what_single_cameras_saw_and_few_points_are_left_alone():
    tracks = noisy(0.002, 0.001)
    ray = tracks.ray.copy()
    ray[::2, 5:, 2] = 1.0
    found = with_observed_precision(replace(tracks, ray=ray))
    assert np.array_equal(found.sigma[::2, 5:], tracks.sigma[::2, 5:])
    assert np.median(later(found.sigma[1::2])) > 0.0015
    few = tracks.select(np.arange(10))
    assert with_observed_precision(few) is few


def test_misses_are_those_of_a_rigid_motion_fitted_to_twelve_neighbours():
    tracks = noisy(0.002, 0.002)
    tracks.clear((np.arange(800)[:, None] % 7 == 0) & (np.arange(FRAMES)[None] == 12))
    misses = neighbour_misses(tracks)
    assert set(misses.frame) == {3, 6, 9, 12, 15, 18}
    assert not (misses.frame[misses.point % 7 == 0] == 12).any()
    row = int(np.flatnonzero((misses.point == 100) & (misses.frame == 9))[0])
    old, new = tracks.positions[:, 0], tracks.positions[:, 9]
    near = np.argsort(np.linalg.norm(old - old[100], axis=1))[1:13]
    expected = new[100] - carried_by(old[100][None], old[near][None], new[near][None])[0]
    variance = 0.002**2 * (1 + 2 / 12)
    assert_allclose(misses.square[row], (expected**2).sum() / variance)
    assert abs(np.median(misses.square) - 2.366) < 0.4


def test_what_is_unsure_is_taken_away_with_its_reason():
    tracks = noisy(0.002, 0.001)
    tracks.sigma[3, 15:], tracks.sigma[4, 7] = 0.01, 0.01
    tracks.sigma[5, 2:], tracks.ray[5, 2:, 0] = 0.01, 1.0
    clear_unsure(tracks, 0.005)
    assert tracks.end[3] == 14 and tracks.end_reason[3] == LOW_PRECISION
    assert not tracks.measured[4, 7] and tracks.end_reason[4] == 0
    assert tracks.measured[5].all()  # its depth is unsure, which is known
    assert tracks.measured.sum() == 800 * FRAMES - 6


def test_carrying_is_exact_for_a_rigid_motion():
    tracks = rigid_tracks(surface(13), 2, np.array([0.1, -0.2, 0.3]), np.array([40.0, 10.0, -80.0]))
    old, new = tracks.positions[:, 0], tracks.positions[:, 1]
    assert_allclose(carried_by(old[:1], old[None, 1:], new[None, 1:]), new[:1], atol=1e-12)
