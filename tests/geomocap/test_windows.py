"""Windows of a long recording: how it is divided, and how what was found in them is joined."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from geomocap.errors import RunError, SettingsError
from geomocap.files.results import join_tracks, read_by_frame, read_tracks, read_trajectories, write_tracks
from geomocap.files.run import Run
from geomocap.files.run_window import RunWindow, read_poses, write_poses
from geomocap.model.hierarchy import Hierarchy
from geomocap.model.trajectories import PathDerivatives, Tracks, TracksByFrame, Trajectories
from geomocap.model.windows import WindowSettings, windows_of
from geomocap.settings import load_settings
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, body_motion
from geomocap.subject.window_motion import joined_motion, pose_of

SMALL = WindowSettings(frames=20, overlap=4)


@pytest.mark.parametrize("frames", [1, 20, 21, 36, 37, 53, 400])
def test_windows_hold_all_frames_and_share_some(frames):
    windows = windows_of(frames, SMALL)
    assert windows[0].start == 0 and windows[-1].stop == frames
    assert max(map(len, windows)) <= SMALL.frames
    assert max(map(len, windows)) - min(map(len, windows)) <= 1
    assert all(a.stop - b.start == SMALL.overlap for a, b in pairwise(windows))
    assert (len(windows) == 1) == (frames <= SMALL.frames)


def test_windows_must_be_longer_than_what_they_share():
    with pytest.raises(SettingsError, match="overlap: 10 is half of 20 frames or more; take less"):
        load_settings(WindowSettings, None, {"frames": 20, "overlap": 10})


def made_tracks(start, frames, count=6, seed=0):
    """Points with lives of different lengths, one without any, by their place in the whole recording."""
    rng = np.random.default_rng(seed + start)
    positions = np.cumsum(rng.normal(0, 0.01, (count, frames, 3)), axis=1) + rng.uniform(-1, 1, (count, 1, 3))
    for row in range(count - 1):
        positions[row, : row % 3] = np.nan
        positions[row, frames - row :] = np.nan
    positions[count - 1] = np.nan
    positions[0, frames // 2] = np.nan  # a gap
    followed = Trajectories.of_positions(positions, placed=np.full(count, 1), sigma=np.abs(positions[..., 0]))
    speeds = np.where(np.isfinite(positions), 1.0 + start, np.nan)
    return Tracks(followed, PathDerivatives(speeds, 2 * speeds, speeds[..., 0], speeds[..., 0]))


def joined_run(folder):
    """A run of 44 frames in windows, whose trajectories are joined."""
    whole, windows = Run(folder), windows_of(44, SMALL)
    parts = [RunWindow.of(whole, w) for w in windows]
    for part, window in zip(parts, windows, strict=True):
        write_tracks(part, made_tracks(window.start, len(window)))
    join_tracks(whole, parts, windows, 44)
    return whole


def test_tracks_of_windows_are_joined_and_read_as_those_of_the_whole(tmp_path):
    whole, frames = Run(tmp_path), 44
    windows = windows_of(frames, SMALL)
    parts = [RunWindow.of(whole, w) for w in windows]
    made = [made_tracks(w.start, len(w)) for w in windows]
    for part, tracks in zip(parts, made, strict=True):
        write_tracks(part, tracks)
    join_tracks(whole, parts, windows, frames)
    found = read_tracks(whole)
    assert found.trajectories.positions.shape == (6 * len(windows), frames, 3)
    for k, (window, tracks) in enumerate(zip(windows, made, strict=True)):
        rows = slice(6 * k, 6 * (k + 1))
        inside = found.trajectories.positions[rows, window.start : window.stop]
        assert_allclose(inside, tracks.trajectories.positions, atol=1e-6)
        assert_allclose(found.motion.accelerations[rows, window.start : window.stop], tracks.motion.accelerations)
        outside = np.delete(found.trajectories.positions[rows], np.arange(window.start, window.stop), axis=1)
        assert np.isnan(outside).all()
        assert_array_equal(found.trajectories.placed[rows], window.start + 1)
    assert found.trajectories.lengths.sum() == sum(t.trajectories.lengths.sum() for t in made)


def test_tracks_are_read_frame_by_frame_in_either_layout(tmp_path):
    whole = joined_run(tmp_path)
    found, spread = read_by_frame(whole), read_trajectories(whole)
    expected = TracksByFrame.of(spread)
    for name in ("who", "positions", "sigma", "begin", "count"):
        assert_array_equal(getattr(found, name), getattr(expected, name))
    for t in (0, 17, 43):
        assert_array_equal(found.who[found.at(t)], np.flatnonzero(spread.measured[:, t]))
        assert_array_equal(found.positions[found.at(t)], spread.positions[spread.measured[:, t], t])
    write_tracks(whole, made_tracks(0, 20))
    assert_allclose(read_by_frame(whole).positions, TracksByFrame.of(read_trajectories(whole)).positions)


def test_of_very_many_tracks_some_are_read(tmp_path, monkeypatch):
    whole = joined_run(tmp_path)
    every = read_trajectories(whole).positions
    monkeypatch.setattr("geomocap.files.ragged_arrays.some_of.__defaults__", (44 * len(every) // 3,))
    assert_array_equal(read_trajectories(whole).positions, every[::3])


def test_a_window_takes_geometry_from_the_whole_and_keeps_its_own_results(tmp_path):
    window = RunWindow.of(Run(tmp_path), range(30, 50))
    assert window.path == tmp_path / "windows" / "000030"
    assert window.silhouette_file("a", 2) == tmp_path / "silhouettes" / "a" / "000032.png"
    assert window.frame_file("voxels", 2) == tmp_path / "voxels" / "000032.ply"
    assert window.frame_file("bodies", 2) == window.path / "bodies" / "000002.ply"


def test_poses_that_are_damaged_are_told(tmp_path):
    run, turns = Run(tmp_path), np.tile(np.eye(3), (5, 2, 1, 1))
    write_poses(run, turns, np.zeros((5, 2, 3)), np.zeros(5))
    assert_array_equal(read_poses(run)[0], turns)
    write_poses(run, 2 * turns, np.zeros((5, 2, 3)), np.zeros(5))
    with pytest.raises(RunError, match="damaged"):
        read_poses(run)


@pytest.fixture
def moving():
    """Two bodies on a hinge over 44 frames."""
    linkage = Linkage(
        Hierarchy(0, np.array([[0, 1]])), np.array([[0.3, 0, 0]]), np.array([[0, 0, 1.0]]), np.array([True]),
        np.zeros(3),
    )  # fmt: skip
    angle = 0.8 * np.sin(np.arange(44) / 6)
    turns = (Rotation.from_rotvec(np.outer(angle, axis)).as_matrix() for axis in ([0, 0.5, 0], [0, 0, 1.0]))
    local = np.stack(list(turns), axis=1)
    root = np.stack([angle, 0.1 * angle, 0 * angle], axis=1)
    return linkage, body_motion(linkage, JointMotion(local, root))


def test_motion_of_windows_that_agree_is_the_motion(moving):
    linkage, motion = moving
    windows = windows_of(44, SMALL)
    joined = joined_motion(linkage, windows, [motion.part(slice(w.start, w.stop)) for w in windows])
    assert_allclose(joined.rotations, motion.rotations, atol=1e-12)
    assert_allclose(joined.translations, motion.translations, atol=1e-12)


def test_joints_that_give_stay_as_they_were_found(moving):
    linkage, motion = moving
    motion.translations[:, 1, 2] += 0.01 * np.sin(np.arange(44))
    windows = windows_of(44, SMALL)
    joined = joined_motion(linkage, windows, [motion.part(slice(w.start, w.stop)) for w in windows])
    assert_allclose(joined.translations, motion.translations, atol=1e-12)


def test_where_windows_disagree_one_goes_over_into_the_other(moving):
    linkage, motion = moving
    windows = windows_of(44, SMALL)
    parts = [motion.part(slice(w.start, w.stop)) for w in windows]
    shifted = [BodyMotion(p.rotations, p.translations + np.array([0, 0, 0.01 * k])) for k, p in enumerate(parts)]
    joined = joined_motion(linkage, windows, shifted)
    height = joined.translations[:, 0, 2]
    assert (np.diff(height) > -1e-12).all() and np.abs(np.diff(height)).max() < 0.01 / SMALL.overlap
    # joints hold to the second order of the windows' difference
    there = linkage.joint_positions(joined)[:, 0]
    carried = np.einsum("tij,j->ti", joined.rotations[:, 1], linkage.joints[0]) + joined.translations[:, 1]
    assert_allclose(carried, there, atol=1e-9)


def test_the_pose_of_a_frame_moves_the_bodies_as_they_were(moving):
    linkage, motion = moving
    again = body_motion(linkage, pose_of(linkage, motion, 17))
    assert_allclose(again.rotations[0], motion.rotations[17], atol=1e-12)
    assert_allclose(again.translations[0], motion.translations[17], atol=1e-12)
