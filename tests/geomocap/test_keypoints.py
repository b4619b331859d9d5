from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.keypoints.keypoint_following import follow_keypoints
from tests.geomocap.made_trajectories import make_tracks, rigid_tracks

SHIFT, TURN = np.array([0.01, -0.005, 0.002]), np.array([1.0, 2.0, 5.0])


def cloud(count=200, seed=0, size=0.1):
    return np.random.default_rng(seed).uniform(-size, size, (count, 3))


def truth(center, frames, start=0):
    out = []
    for t in range(frames):
        R = Rotation.from_rotvec(np.radians(TURN) * t).as_matrix()
        R0 = Rotation.from_rotvec(np.radians(TURN) * start).as_matrix()
        out.append(R @ R0.T @ (center - start * SHIFT) + t * SHIFT)
    return np.array(out)


def test_a_keypoint_moves_with_its_body():
    tracks = rigid_tracks(cloud(), 15, SHIFT, TURN)
    center = np.array([0.05, 0.02, -0.03])
    paths = follow_keypoints(tracks, center[None], np.array([0.05]), 0)
    assert_allclose(paths.positions[:, 0], truth(center, 15), atol=1e-4)
    assert not paths.bridged.any() and (paths.n_tracks > 3).all()


def test_placed_amid_the_sequence_it_is_followed_both_ways():
    tracks = rigid_tracks(cloud(), 15, SHIFT, TURN)
    center = truth(np.array([0.05, 0.02, -0.03]), 15)[6]
    paths = follow_keypoints(tracks, center[None], np.array([0.05]), 6)
    assert_allclose(paths.positions[:, 0], truth(center, 15, 6), atol=1e-4)


def test_one_drifting_track_has_no_say():
    tracks = rigid_tracks(cloud(), 15, SHIFT, TURN)
    near = np.argsort(np.linalg.norm(tracks.positions[:, 0], axis=1))
    positions = tracks.positions.copy()
    positions[near[0]] += np.linspace(0, 0.08, 15)[:, None]
    paths = follow_keypoints(make_tracks(positions), np.zeros((1, 3)), np.array([0.05]), 0)
    assert np.linalg.norm(paths.positions[:, 0] - truth(np.zeros(3), 15), axis=1).max() < 0.002


def test_gaps_are_bridged_by_the_body_and_marked():
    tracks = rigid_tracks(cloud(), 15, SHIFT, TURN)
    inside = np.linalg.norm(tracks.positions[:, 0], axis=1) < 0.05
    positions = tracks.positions.copy()
    positions[np.ix_(inside, np.arange(5, 9))] = np.nan
    paths = follow_keypoints(make_tracks(positions), np.zeros((1, 3)), np.array([0.05]), 0)
    assert_allclose(paths.positions[:, 0], truth(np.zeros(3), 15), atol=1e-4)
    assert paths.bridged[:, 0].tolist() == [False] * 5 + [True] * 4 + [False] * 6


def test_tracks_that_come_later_take_over():
    tracks = rigid_tracks(cloud(), 15, SHIFT, TURN)
    positions = tracks.positions.copy()
    old = np.arange(200) < 100
    positions[old, 8:] = np.nan
    positions[~old, :5] = np.nan
    paths = follow_keypoints(make_tracks(positions), np.zeros((1, 3)), np.array([0.05]), 0)
    assert_allclose(paths.positions[:, 0], truth(np.zeros(3), 15), atol=1e-4)
    assert not paths.bridged.any()


def test_a_limb_that_passes_by_has_no_say():
    body = rigid_tracks(cloud(60), 20, SHIFT, TURN)
    limb = cloud(60, 1, 0.04)[:, None] + (np.arange(20)[None, :, None] - 10) * np.array([0.03, 0, 0])
    limb = limb + truth(np.zeros(3), 20)[None]
    limb[:, :10] = np.nan  # seen for the first time before the region
    hidden = body.positions.copy()
    inside = np.linalg.norm(hidden[:, 0], axis=1) < 0.05
    hidden[np.ix_(inside, np.arange(8, 14))] = np.nan  # behind the limb
    both = make_tracks(np.concatenate([hidden, limb]))
    paths = follow_keypoints(both, np.zeros((1, 3)), np.array([0.05]), 0)
    assert_allclose(paths.positions[:, 0], truth(np.zeros(3), 20), atol=1e-4)


def test_nothing_near_is_nan():
    tracks = rigid_tracks(cloud(), 5, SHIFT, TURN)
    paths = follow_keypoints(tracks, np.array([[3.0, 0, 0]]), np.array([0.05]), 0)
    assert np.isnan(paths.positions[1:]).all() and (paths.n_tracks == 0).all()


@pytest.mark.parametrize(
    ("radii", "frame", "message"),
    [([0.05], 9, "frames 0 to 4"), ([0.0], 0, "radius above 0"), ([0.05, 0.05], 0, "1 key-points")],
)
def test_wrong_input_is_refused(radii, frame, message):
    tracks = rigid_tracks(cloud(), 5, SHIFT, TURN)
    with pytest.raises(GeometryError, match=message):
        follow_keypoints(tracks, np.zeros((1, 3)), np.array(radii), frame)


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_a_small_subject_is_followed_like_a_large_one(scale):
    tracks = rigid_tracks(cloud(), 15, SHIFT, TURN)
    drifting = tracks.positions + np.random.default_rng(1).normal(0, 2e-3, tracks.positions.shape)
    drifting[:40, 4:9] = np.nan
    drifting[40:80, :6] = np.nan
    center, radius = np.array([[0.05, 0.02, -0.03]]), np.array([0.05])
    found = follow_keypoints(make_tracks(drifting), center, radius, 0)
    tracks = make_tracks(scale * drifting)
    tracks = replace(tracks, sigma=scale * tracks.sigma)
    scaled = follow_keypoints(tracks, scale * center, scale * radius, 0)
    assert_allclose(scaled.positions, scale * found.positions, atol=1e-6 * scale)
    assert_allclose(scaled.std, scale * found.std, rtol=1e-4)
    np.testing.assert_array_equal(scaled.n_tracks, found.n_tracks)
