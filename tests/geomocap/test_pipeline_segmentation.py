"""What a segmentation takes from a run folder that has been used before, and what it leaves there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from geomocap.config import load_config
from geomocap.errors import GeometryError, SettingsError
from geomocap.export.trc import read_trc
from geomocap.files.capture import Capture
from geomocap.files.results import read_warnings
from geomocap.files.run import Run
from geomocap.files.scans import open_scans
from geomocap.inspection import describe
from geomocap.motion import evenly_over_surface
from geomocap.pipeline import Job, motion_files, segment
from geomocap.pipeline.derived import KEYPOINT_FILES
from geomocap.scheduling import threads
from tests.geomocap.moving_chains import chain

SETTINGS = {"nodes": {"nodes": 30, "coarse_nodes": 20, "points": 300, "coarse_points": 200}}
M3 = {"segmentation": {"method": "m3", "max_depth": 3}}


@pytest.fixture
def job(tmp_path):
    """Make the job of scans (T, N, 3) in one and the same run folder."""

    def make(scans: np.ndarray, settings: dict | None = None) -> Job:
        np.save(tmp_path / "scans.npy", scans)
        config = load_config(overrides=settings or SETTINGS)
        return Job(Run(tmp_path / "run"), config, executor, scans=open_scans(tmp_path / "scans.npy", config.scans))

    with threads(1) as executor:
        yield make


def scanned(frames: int) -> np.ndarray:
    return chain(2, frames, samples=200).positions.swapaxes(0, 1)


def test_of_a_single_frame_is_told_that_motion_takes_more(job):
    told: list[str] = []
    one = replace(job(scanned(2)[:1], M3), tell=told.append)
    for _ in range(2):
        motion_files(one, "scans")
    assert len(told) == 2 and told[0] == told[1]
    assert "scans.npy: a single frame shows no motion" in told[0] and "ellipsoids.npz and bodies/ were made" in told[0]
    assert not one.run.has("skeleton.npz") and one.run.faults() == {}
    assert dict(describe(one.run.path).facts)["ellipsoids"].endswith("in 1 frame, of 0 bodies")


def test_scans_leave_tracks_of_a_capture_alone(job):
    rng = np.random.default_rng(1)
    scans = job(np.stack([rng.permutation(points) for points in scanned(6)]))
    tracks = np.random.default_rng(0).normal(size=(500, 1, 3)).repeat(6, axis=1)
    scans.run.write_npz("tracks.npz", positions=tracks, sigma=np.full((500, 6), 0.002))
    segment(scans, "scans")
    assert scans.run.read_npz("diagnostics.npz")["paths"] == "nodes"


def test_frames_that_seem_to_be_points_are_told_with_the_results(job):
    scans = job(scanned(24)[:, ::8].swapaxes(0, 1), {"segmentation": {"paths": "points"}})
    segment(scans, "scans")
    assert "frames and points seem to be swapped" in read_warnings(scans.run)[0]


def test_scans_that_cant_be_compared_are_refused_with_the_order_of_an_array(job):
    path = np.linspace(0, 1, 6)[:, None] * np.array([1.0, 0.0, 0.0])
    scans = job(path + np.random.default_rng(0).normal(size=(40, 1, 3)))  # each point goes straight on
    with pytest.raises(GeometryError, match=r"frame 0: all its points lie in a line.* 40 frames of 6 points"):
        segment(scans, "scans")


def test_points_that_scans_have_in_common_are_followed(job):
    scans = job(scanned(12))
    segment(scans, "scans")
    found = scans.run.read_npz("diagnostics.npz")
    assert found["paths"] == "points" and scans.run.read_npz("skeleton.npz")["joint_bodies"].tolist() == [[0, 1]]
    points = scanned(12)
    chosen = evenly_over_surface(points.swapaxes(0, 1))
    assert len(chosen) > 0.8 * points.shape[1]
    np.testing.assert_allclose(found["sample_positions"].swapaxes(0, 1), points[:, chosen])
    scans = job(scanned(12), {**SETTINGS, "segmentation": {"paths": "nodes"}})
    segment(scans, "scans")
    assert scans.run.read_npz("diagnostics.npz")["paths"] == "nodes"


@pytest.mark.parametrize("model", [None, Path("model.npz")])
def test_a_capture_has_no_points_in_common(job, model):
    asked = job(scanned(2), {"segmentation": {"paths": "points"}})
    asked = replace(asked, scans=None, capture=Mock(spec=Capture), model=model)
    with pytest.raises(SettingsError, match=r"segmentation\.paths = points is for scans; of a capture take auto"):
        segment(asked, "voxels")
    assert not asked.run.path.exists(), "refused before anything is made"


def follow(run: Run, frames: int) -> None:
    run.write_npz("keypoints.npz", names=np.array(["tip"]), positions=np.zeros((frames, 1, 3)), radius=np.array([0.1]))
    for name in ("keypoints.toml", "keypoints.trc", "keypoints.c3d"):
        (run.path / name).touch()


def test_motion_files_hold_key_points_followed_since_and_these_go_with_their_bodies(job):
    done = job(scanned(6), M3)
    motion_files(done, "scans")
    follow(done.run, 6)
    motion_files(done, "scans")
    assert "tip" in read_trc(done.run.path / "motion.trc").names
    motion_files(job(scanned(5), M3), "scans")
    assert not [name for name in KEYPOINT_FILES if (done.run.path / name).exists()]
    assert (done.run.path / "keypoints.toml").exists()
    assert "tip" not in read_trc(done.run.path / "motion.trc").names


def test_one_scan_leaves_no_motion_and_no_report_of_the_sequence_before_it(job):
    sequence = job(scanned(5), M3)
    motion_files(sequence, "scans")
    (sequence.run.path / "review").mkdir()
    motion_files(sequence, "scans")
    assert (sequence.run.path / "review").exists(), "nothing has changed, so its report is still right"
    assert (sequence.run.path / "skeleton.npz").exists() and (sequence.run.path / "motion.bvh").exists()
    motion_files(job(scanned(5)[:1], M3), "scans")
    assert not (sequence.run.path / "skeleton.npz").exists()
    assert not list(sequence.run.path.glob("motion.*")) and not (sequence.run.path / "review").exists()
    assert len(sequence.run.read_npz("ellipsoids.npz")["centers"]) == 1
    motion_files(job(scanned(5), M3), "scans")
    assert (sequence.run.path / "motion.bvh").exists()
