"""The surface that tracks start on, and what goes when they are made anew."""

import importlib

import numpy as np
import pytest
from numpy.testing import assert_allclose

from geomocap.config import load_config
from geomocap.files.run import Run
from geomocap.pipeline import Job
from geomocap.pipeline.derived import KEYPOINT_FILES
from geomocap.scheduling import threads
from tests.geomocap.test_pipeline_clouds import make_capture

stage = importlib.import_module("geomocap.pipeline.track_stage")


def test_a_cloud_becomes_the_voxels_that_hold_its_points():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [1, 1, 0.01]
    voxels = stage.surface_voxels(points, 0.1)
    away = np.abs(points[:, None] - voxels.points[None]).max(axis=2)
    assert (away.min(axis=1) <= 0.05 + 1e-12).all()  # each point lies in one
    assert (away.min(axis=0) <= 0.05 + 1e-12).all()  # and none is empty
    assert len(np.unique(voxels.indices, axis=0)) == len(voxels.indices)
    assert_allclose(voxels.voxel_size, 0.1)
    assert len(stage.surface_voxels(np.zeros((0, 3)), 0.1).indices) == 0


@pytest.mark.parametrize(
    ("cameras", "arc_deg", "surface"),
    [
        (4, 360.0, "voxels"),
        (3, 360.0, "voxels"),
        (3, 40.0, "clouds"),
        (3, 4.0, "clouds"),  # too near to be matched: clouds say so
        (2, 180.0, "clouds"),
    ],
)
def test_tracks_lie_on_the_hull_where_it_is_all_there_can_be(tmp_path, monkeypatch, cameras, arc_deg, surface):
    asked = []
    for name in ("voxels", "clouds"):
        monkeypatch.setattr(stage, name, lambda job, name=name: asked.append(name) or name)
    monkeypatch.setattr(stage, "_track", lambda job, capture: job.run.write_npz("tracks.npz") or 1)
    capture = make_capture(tmp_path / "capture", cameras=cameras, arc_deg=arc_deg)
    with threads(1) as executor:
        stage.tracks(Job(Run(tmp_path / "run"), load_config(), executor, capture=capture, fps=capture.fps))
    assert asked == [surface]


def test_of_a_single_frame_is_told_that_trajectories_take_more(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "clouds", lambda job: "surface")
    monkeypatch.setattr(stage, "_track", lambda job, capture: job.run.write_npz("tracks.npz") or 1)
    told: list[str] = []
    capture = make_capture(tmp_path / "capture")
    with threads(1) as executor:
        job = Job(Run(tmp_path / "run"), load_config(), executor, capture=capture, fps=capture.fps, tell=told.append)
        stage.tracks(job)
    assert len(told) == 1 and told[0].startswith(f"{capture.path}: a single frame shows no motion; trajectories take")


def test_key_points_go_with_the_tracks_they_were_followed_in(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "clouds", lambda job: "surface")
    monkeypatch.setattr(stage, "_track", lambda job, capture: job.run.write_npz("tracks.npz") or 1)
    capture, run = make_capture(tmp_path / "capture"), Run(tmp_path / "run")
    with threads(1) as executor:
        job = Job(run, load_config(), executor, capture=capture, fps=capture.fps)
        stage.tracks(job)
        for name in (*KEYPOINT_FILES, "keypoints.toml"):
            (run.path / name).touch()
        stage.tracks(job)
        assert all((run.path / name).exists() for name in KEYPOINT_FILES)
        stage.tracks(Job(run, load_config(), executor, capture=capture, fps=2 * capture.fps))
    assert not [name for name in KEYPOINT_FILES if (run.path / name).exists()]
    assert (run.path / "keypoints.toml").exists()
