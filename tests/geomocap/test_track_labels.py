"""Bodies of tracks that bodies were not found from, and of the points around them."""

from dataclasses import replace

import numpy as np
import pytest

from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.bodies.point_labels import Voters, label_points
from geomocap.bodies.track_labels import label_tracks
from geomocap.model.motion_paths import MotionPaths
from tests.geomocap.moving_chains import Chain, chain


@pytest.fixture(scope="module")
def scene() -> Chain:
    """3,000 points of three boxes, of which every tenth is a sample."""
    scene = chain(3, samples=1000)
    noise = np.random.default_rng(3).normal(0, 5e-4, scene.positions.shape)
    return replace(scene, positions=scene.positions + noise)


@pytest.fixture(scope="module")
def samples(scene):
    paths = MotionPaths(scene.positions[::10])
    bodies = find_motion_bodies(paths)
    assert bodies.body_count == 3
    return bodies, Voters.of(bodies, paths), paths


@pytest.fixture(scope="module")
def true(scene, samples):
    """True bodies in the numbers of those found."""
    found = samples[0].label
    return np.array([np.bincount(found[scene.body[::10] == b]).argmax() for b in range(3)])[scene.body]


def test_tracks_get_the_body_that_they_move_with(scene, samples, true):
    bodies, voters, _ = samples
    labels, rest = label_tracks(bodies, voters, scene.positions)
    by_place = label_points(voters, 0, scene.positions[:, 0])
    # those on the joints' axes move with both bodies
    assert (labels != true).mean() < 0.01 < (by_place != true).mean()
    right = labels == true
    np.testing.assert_allclose(rest[right], scene.positions[right, 0], atol=4e-3)


def test_a_track_in_few_frames_is_labelled_and_an_unseen_one_is_not(scene, samples, true):
    bodies, voters, _ = samples
    tracks = scene.positions[[50, 1500, 2950]].copy()
    tracks[0, :7], tracks[0, 9:], tracks[1] = np.nan, np.nan, np.nan
    labels, rest = label_tracks(bodies, voters, tracks)
    np.testing.assert_array_equal(labels, [true[50], -1, true[2950]])
    assert np.isnan(rest[1]).all() and np.isfinite(rest[[0, 2]]).all()
    none, nowhere = label_tracks(bodies, voters, tracks[:0])
    assert none.shape == (0,) and nowhere.shape == (0, 3)


def test_points_beside_labelled_tracks_are_labelled_better(scene, samples, true):
    bodies, voters, paths = samples
    some, other = np.arange(1, 3000, 2), np.arange(0, 3000, 2)
    tracks = scene.positions[some].copy()
    tracks[::3, 12:] = np.nan
    more = Voters.with_tracks(bodies, paths, tracks, *label_tracks(bodies, voters, tracks))
    for frame in (0, 20):
        points = scene.positions[other, frame]
        wrong = [(label_points(v, frame, points) != true[other]).mean() for v in (voters, more)]
        assert wrong[1] < 0.7 * wrong[0]


def test_where_no_body_fits_votes_decide(scene, samples):
    bodies, voters, _ = samples
    # halfway between two bodies' motions, beside the end of one: skin of a joint
    soft = np.array([0.38, 0.06, 0.0])
    carried = [bodies.rotations[:, b] @ soft + bodies.translations[:, b] for b in bodies.label[[50, 150]]]
    track = 0.5 * (carried[0] + carried[1])[None]
    votes = voters.votes(0, track[:, 0])[0]
    assert label_tracks(bodies, voters, track)[0][0] == votes.argmax()
