"""Tracks whose axes of points and frames have changed places."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.model.axis_order import seem_swapped
from tests.geomocap.moving_chains import chain


def in_order_of_place(tracks):
    return tracks[np.argsort(tracks[:, 0, 0])]


def with_noise(tracks):
    return tracks + np.random.default_rng(0).normal(scale=0.01, size=tracks.shape)


def with_gaps(tracks):
    return np.where(np.random.default_rng(0).random(tracks.shape[:2])[..., None] < 0.2, np.nan, tracks)


def few(tracks):
    return tracks[::9]


def as_a_film_of_few_frames(tracks):
    return tracks[:, ::2]


@pytest.mark.parametrize("bodies", [3, 6])
@pytest.mark.parametrize("change", [in_order_of_place, with_noise, with_gaps, few, as_a_film_of_few_frames])
def test_swapped_axes_of_bodies_that_turn_are_told(bodies, change):
    tracks = change(chain(bodies).positions)
    assert not seem_swapped(tracks)
    assert seem_swapped(tracks.swapaxes(0, 1))


@pytest.mark.parametrize("frames", [6, 12, 60])
@pytest.mark.parametrize("step", [0.0, 0.05, 1.0])
@pytest.mark.parametrize("noise", [0.003, 0.01])
def test_tracks_in_their_order_are_never_doubted(frames, step, noise):
    """One body or several, that stay or go on by steps of any length, points in the order of their places, noise."""
    for bodies in (1, 3):
        tracks = chain(bodies, frames=frames, samples=300).positions
        moved = in_order_of_place(tracks) + step * np.arange(frames)[:, None] * np.array([1.0, 0.0, 0.0])
        shaken = moved + np.random.default_rng(frames).normal(scale=noise, size=moved.shape)
        still = shaken - moved + moved[:, :1]
        assert not seem_swapped(shaken) and not seem_swapped(still)


@pytest.mark.parametrize("shape", [(5, 40), (40, 5), (0, 40), (40, 0), (1, 1)])
def test_few_points_or_frames_tell_nothing(shape):
    assert not seem_swapped(np.random.default_rng(0).normal(size=(*shape, 3)))


def test_points_that_are_never_seen_or_never_move_tell_nothing():
    assert not seem_swapped(np.full((30, 30, 3), np.nan))
    assert not seem_swapped(np.zeros((30, 30, 3)))
