"""What a segmentation takes from a run folder that has been used before, and what it leaves there."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.config import load_config
from geomocap.pipeline import Job, segment
from geomocap.run import Run
from geomocap.scans import open_scans
from geomocap.scheduling import threads
from tests.geomocap.moving_chains import chain

SETTINGS = {"nodes": {"nodes": 60, "coarse_nodes": 40, "points": 600, "coarse_points": 400}}


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
    return chain(2, frames, samples=600).positions.swapaxes(0, 1)


def test_scans_leave_tracks_of_a_capture_alone(job):
    scans = job(scanned(6))
    tracks = np.random.default_rng(0).normal(size=(500, 1, 3)).repeat(6, axis=1)
    scans.run.write_npz("tracks.npz", positions=tracks, sigma=np.full((500, 6), 0.002))
    segment(scans, "scans")
    assert scans.run.read_npz("diagnostics.npz")["paths"] == "nodes"
