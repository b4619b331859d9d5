"""Pictures of tracked surface points."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from geomocap.errors import RunError
from geomocap.files.run import Run
from tests.viz.conftest import Made
from viz import review
from viz.run_contents import Results
from viz.scene import stage
from viz.track_pictures import filter_sheet, trajectory_sheet, velocity_sheet

FPS = 30.0
RED = np.array([200, 30, 50])


@pytest.fixture
def tracked(made: Made, tmp_path: Path) -> Run:
    """A copy of the run with tracks of its figure's surface; the last ten points leap, and the filters removed them."""
    run = Run(tmp_path / "run")
    shutil.copytree(made.run.path, run.path)
    shutil.rmtree(run.path / "review", ignore_errors=True)
    points = np.stack([made.figure.points(t, 1)[0] for t in range(6)], axis=1)
    points = np.repeat(points[:, :1], 6, axis=1) + 0.03 * np.arange(6)[None, :, None] * [0.0, 1.0, 0.0]
    points = np.concatenate([points + np.array([0.01 * k, 0, 0.02 * k]) for k in range(6)])
    wild = points[:10] + np.where(np.arange(6) > 2, 0.4, 0.0)[None, :, None]
    unfiltered = np.concatenate([points, wild])
    run.write_npz(
        "tracks.npz",
        positions=points,
        velocities=np.gradient(points, axis=1) * FPS,
        accelerations=np.zeros_like(points),
        start=np.zeros(len(points), int),
        end=np.full(len(points), 5),
        unfiltered=unfiltered.astype(np.float32),
        kept=np.arange(len(points)),
    )
    return run


def reds(image: np.ndarray) -> int:
    return int((np.abs(image[..., :3].astype(int) - RED).max(axis=2) < 40).sum())


def test_removed_points_are_red_without_filters_only(made: Made, tracked: Run) -> None:
    results = Results(tracked, made.capture)
    found = results.tracks
    assert found is not None
    image = filter_sheet(results, stage(results), found, 4)
    assert image is not None
    half = image.shape[1] // 2
    assert reds(image[:, :half]) > 50
    assert reds(image[:, half:]) < 0.1 * reds(image[:, :half])


def test_speed_is_told_by_colour(made: Made, tracked: Run) -> None:
    results = Results(tracked)
    found = results.tracks
    assert found is not None
    slow = velocity_sheet(results, stage(results), found, [3])
    found.motion.velocities[::2] *= 0.1
    mixed = velocity_sheet(results, stage(results), found, [3])
    assert slow is not None and mixed is not None
    blue = [int(((i[:-40, :, 2].astype(int) - i[:-40, :, 0]) > 80).sum()) for i in (slow, mixed)]
    assert blue[1] > blue[0] + 100


def test_trajectories_without_images_are_drawn_on_white(tracked: Run) -> None:
    results = Results(tracked)
    found = results.tracks
    assert found is not None
    image = trajectory_sheet(results, stage(results), found, [1, 5])
    assert image is not None
    assert (image == 255).all(axis=2).mean() > 0.5
    assert (np.ptp(image.astype(int), axis=2) > 60).sum() > 300


def test_report_shows_them(made: Made, tracked: Run) -> None:
    written = {p.name for p in review(tracked, made.capture, frames=[2], quick=True)}
    assert {"tracks.png", "velocities.png", "filters.png"} <= written
    assert "Trajectories by displacement" in (tracked.path / "review" / "report.html").read_text(encoding="utf-8")


def test_a_file_without_velocities_is_refused(tracked: Run) -> None:
    tracked.write_npz("tracks.npz", positions=np.zeros((1, 6, 3)))
    with pytest.raises(RunError, match="has no array velocities"):
        _ = Results(tracked).tracks
