"""Depths of patches that one camera alone sees, adjusted to what is around them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from geomocap.model.trajectories import Trajectories
from geomocap.patches.lone_depths import adjust_depths

FRAMES = 12
DEPTH_STD = 0.012
SIDES = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])  # far cameras, 90° apart


def limb() -> tuple[Trajectories, np.ndarray, np.ndarray]:
    """A cylinder that swings and turns: true trajectories, those with depths off, and rays."""
    rng = np.random.default_rng(3)
    angle, height = rng.uniform(0, 2 * np.pi, 160), rng.uniform(-0.15, 0.15, 160)
    body = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), height], axis=1)
    swing = np.linspace(0, 1, FRAMES)
    turns = Rotation.from_rotvec(np.stack([0.6 * swing, 0.2 * swing, 0.5 * swing], axis=1)).as_matrix()
    truth = np.einsum("tij,nj->nti", turns, body) + swing[:, None] * [0.1, 0.05, 0]
    # each patch is seen by the camera that it faces at first
    side = SIDES[(body[:, :2] @ SIDES[:, :2].T).argmax(axis=1)]
    directions = -np.repeat(side[:, None], FRAMES, axis=1)
    drift = np.sin(np.arange(FRAMES)[None] * 0.9 + 3 * side[:, :1] + 5 * side[:, 1:2])  # as a hull's surface moves
    off = DEPTH_STD * (drift + 0.5 * rng.normal(size=(160, FRAMES)))
    N = len(truth)
    zeros, ones = np.zeros(N, int), np.ones((N, FRAMES))
    tracks = Trajectories(
        truth + off[:, :, None] * directions,
        np.repeat(turns[None], N, axis=0),
        ones * DEPTH_STD / np.sqrt(3),
        ones,
        ones.astype(int),
        directions,
        side,
        zeros,
        zeros,
        zeros,
    )
    return tracks, truth, directions


@pytest.fixture(scope="module")
def scene():
    tracks, truth, directions = limb()
    return tracks, truth, directions, adjust_depths(tracks)


def wobble(positions, truth, directions):
    """RMS of the error along the ray, without its mean over time."""
    error = ((positions - truth) * directions).sum(axis=2)
    return np.sqrt(((error - error.mean(axis=1, keepdims=True)) ** 2).mean())


def test_depths_come_to_move_as_the_rigid_limb_does(scene):
    tracks, truth, directions, adjusted = scene
    assert wobble(adjusted.positions, truth, directions) < 0.4 * wobble(tracks.positions, truth, directions)


def test_patches_move_along_their_lines_of_sight_only(scene):
    tracks, _, directions, adjusted = scene
    moved = adjusted.positions - tracks.positions
    along = (moved * directions).sum(axis=2)[:, :, None] * directions
    assert_allclose(moved, along, atol=1e-12)
    assert np.abs(along).max() > 0.5 * DEPTH_STD


def test_what_several_cameras_see_stays(scene):
    tracks, _, directions, _ = scene
    some = directions.copy()
    some[::2] = 0
    positions = tracks.positions.copy()
    positions[5, 3:6] = np.nan
    gaps = tracks.select(np.arange(len(tracks)))
    gaps.clear(np.isnan(positions[:, :, 0]))
    some[np.isnan(positions[:, :, 0])] = 0
    adjusted = adjust_depths(replace(gaps, ray=some))
    assert_allclose(adjusted.positions[::2], gaps.positions[::2])
    assert np.isnan(adjusted.positions[5, 3:6]).all() and np.isfinite(adjusted.positions[4]).all()
    known = replace(tracks, ray=np.zeros_like(directions))
    assert adjust_depths(known) is known
