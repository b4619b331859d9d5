"""A long recording in windows: the same files however it is worked on, and it goes on where it was stopped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geomocap.files.results import read_by_frame, read_keypoint_paths, read_skeleton, read_tracks
from geomocap.files.run import Run
from tests.benchmarks.tiny_run import QUICK, VARIANTS, digests, make_tiny

FRAMES = 26
PIXEL = 0.03  # metres on the subject
SETTINGS = [*QUICK[:-2], *VARIANTS["windows"]]
KEYPOINT = """
[[keypoint]]
name = "middle"
center = [{}, {}, {}]
radius = 0.3
frame = 13
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return make_tiny(tmp_path_factory.mktemp("windows"), "windows")


@pytest.fixture(scope="module")
def made(recording, geomocap) -> Run:
    run = recording.parent / "run"
    geomocap("run", recording, run, *SETTINGS, "--workers", 1)
    return Run(run)


def test_the_motion_goes_through_all_windows(made):
    folders = sorted(p.name for p in (made.path / "windows").iterdir())
    assert folders == ["000000", "000008", "000015"]
    assert [(made.path / "windows" / f / "poses.npz").is_file() for f in folders].count(False) == 1
    skeleton = read_skeleton(made)
    assert skeleton.frame_count == FRAMES and np.isfinite(skeleton.joint_positions).all()
    # where windows meet, joints don't jump, however fast they are: they go on as they went, to less than a pixel
    jumps = np.linalg.norm(np.diff(skeleton.joint_positions, n=2, axis=0), axis=2)
    assert jumps.max() < PIXEL
    tracks = read_tracks(made).trajectories
    assert tracks.n_frames == FRAMES and tracks.measured.any(axis=0).all()
    assert made.frames("bodies") == list(range(FRAMES))


def test_two_workers_make_the_same_files_as_one(made, recording, geomocap, tmp_path):
    geomocap("run", recording, tmp_path / "run", *SETTINGS, "--workers", 2)
    assert digests(tmp_path / "run") == digests(made.path)


def test_a_window_that_is_lost_is_made_again(made, recording, geomocap):
    before = digests(made.path)
    poses = next(made.path.glob("windows/*/poses.npz"))
    poses.unlink()
    geomocap("run", recording, made.path, *SETTINGS, "--workers", 1)
    assert digests(made.path) == before


def test_key_points_are_followed_through_the_windows(made, geomocap, tmp_path):
    tracks = read_by_frame(made)
    shown = tracks.positions[tracks.at(13)]
    nearest = shown[np.linalg.norm(shown - np.median(shown, axis=0), axis=1).argmin()]
    (tmp_path / "points.toml").write_text(KEYPOINT.format(*nearest))
    geomocap("keypoints", made.path, "--points", tmp_path / "points.toml")
    followed = read_keypoint_paths(made).paths.positions[:, 0]
    known = np.flatnonzero(np.isfinite(followed[:, 0]))
    assert known[0] < 8 and known[-1] >= 15 + 3  # it has left the window in which it was placed, both ways
