"""Which motion paths the bodies are found from, and robustness of the nodes against what scans bring along."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest

from geomocap.config import Config
from geomocap.errors import GeometryError
from geomocap.files.run import Run
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.trajectories import Trajectories
from geomocap.motion import SAMPLES
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.pipeline.job import Job
from geomocap.pipeline.path_choice import ALONE_FRACTION, carrying_tracks, motion_paths, patch_paths, path_spacing
from geomocap.segmentation.m3_settings import SegmentationSettings

FRAMES = 3


@dataclass(frozen=True)
class Ball:
    """Points on a ball that moves along x, with a colour."""

    spacing = 0.05
    normals = None

    def __len__(self) -> int:
        return FRAMES

    def points(self, frame: int) -> np.ndarray:
        d = np.random.default_rng(frame).normal(size=(1200, 3))
        return d / np.linalg.norm(d, axis=1, keepdims=True) * [1.0, 0.8, 0.5] + [0.05 * frame, 0, 0]

    def features(self, frame: int) -> np.ndarray:
        raise AssertionError("colours were not to be asked for")


@pytest.fixture
def job(tmp_path):
    def make(paths: str, tracks: np.ndarray | None = None, ray: np.ndarray | None = None) -> Job:
        config = Config(
            segmentation=SegmentationSettings(paths=paths),
            nodes=NodeTrackingSettings(nodes=60, coarse_nodes=40, points=600, coarse_points=400, colors=False),
        )
        run = Run(tmp_path / "run")
        if tracks is not None:
            rays = {} if ray is None else {"ray": ray}
            run.write_npz("tracks.npz", positions=tracks, sigma=np.full(tracks.shape[:2], 0.002), **rays)
        return Job(run, config, executor)

    with ThreadPoolExecutor(1) as executor:
        yield make


def trajectories(count: int, seen: float, lowest: float = -1.0) -> np.ndarray:
    """Points of the ball above z = `lowest` · 0.5 that move with it, each measured in a fraction of the frames."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(20 * count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d = d[d[:, 2] > lowest][:count]
    tracks = (d * [1.0, 0.8, 0.5])[:, None] + 0.05 * np.arange(FRAMES)[None, :, None] * [1.0, 0, 0]
    tracks[rng.random((count, FRAMES)) > seen] = np.nan
    return tracks


def patches_of(tracks: np.ndarray) -> MotionPaths:
    """Those of the tracks that bodies are found from."""
    followed = Trajectories.of_positions(tracks, sigma=np.full(tracks.shape[:2], 0.002))
    patches = patch_paths(followed, path_spacing(Ball()))
    assert patches is not None
    return patches


class Late(Ball):
    """It comes into view in the second frame."""

    def points(self, frame: int) -> np.ndarray:
        return super().points(1) if frame else np.empty((0, 3))


def test_spacing_where_the_subject_comes_later() -> None:
    assert path_spacing(Late()) == pytest.approx(path_spacing(Ball()), rel=0.2)  # other points of the same surface


def test_nodes_leave_colours_alone(job):
    found = motion_paths(job("nodes"), Ball(), False)[0]
    assert list(found) == ["nodes"]
    assert found["nodes"].count == 60


def test_patches_where_they_cover_the_subject(job):
    assert list(motion_paths(job("auto", trajectories(500, 1.0)), Ball(), True)[0]) == ["patches"]


def test_nodes_on_the_piece_that_patches_leave_uncovered(job):
    tracks = trajectories(20 * SAMPLES, 1.0, 0.0)
    found = motion_paths(job("auto", tracks), Ball(), True)[0]
    assert list(found) == ["pieces"]
    paths = found["pieces"]
    patches = patches_of(tracks)
    np.testing.assert_array_equal(paths.positions[: patches.count], patches.positions)
    nodes = paths.positions[patches.count :]
    assert 20 <= len(nodes) <= 40  # of 60, those on the half without patches
    assert (np.nanmax(nodes[:, :, 2], axis=1) < 0.05).all()
    # the farther nodes are from patches the less precise they are
    sigma = paths.sigma[patches.count :]
    assert np.nanmedian(sigma) > 5 * np.nanmedian(paths.sigma[: patches.count])
    assert np.corrcoef(np.nanmean(nodes[:, :, 2], axis=1), np.nanmean(sigma, axis=1))[0, 1] < -0.8


@pytest.mark.parametrize(("lowest", "kinds"), [(0.5, ["patches", "both"]), (-0.5, ["patches"])])
def test_where_single_cameras_follow_less_than_half_of_the_surface_there_are_nodes_to_choose_instead(
    job, lowest, kinds
):
    tracks = trajectories(300, 1.0, lowest)
    ray = np.zeros_like(tracks)
    ray[::2, :, 1] = 1.0
    found = motion_paths(job("auto", tracks, ray), Ball(), True)[0]
    assert list(found) == kinds
    assert found["patches"].ray is not None


def test_nodes_where_patches_are_there_for_a_while_only(job):
    tracks = trajectories(20 * SAMPLES, 1.0)
    tracks[:, 1:][tracks[:, 1:, 2] < 0] = np.nan  # 2 of 3 frames
    found = motion_paths(job("auto", tracks), Ball(), True)[0]
    assert list(found) == ["pieces"]
    patches = patches_of(tracks)
    nodes = found["pieces"].positions[patches.count :]
    assert 20 <= len(nodes) <= 40
    assert (np.nanmax(nodes[:, :, 2], axis=1) < 0.05).mean() > 0.85  # patches are there at random: few lie far apart


def test_nodes_without_patches(job):
    assert list(motion_paths(job("auto"), Ball(), False)[0]) == ["nodes"]


def test_tracks_of_another_job_are_left_alone(job):
    assert list(motion_paths(job("auto", trajectories(500, 1.0)), Ball(), False)[0]) == ["nodes"]


def test_both_although_patches_cover_the_subject(job):
    assert list(motion_paths(job("both", trajectories(500, 1.0)), Ball(), True)[0]) == ["both"]


def test_few_patches_where_they_are_asked_for(job):
    assert list(motion_paths(job("patches", trajectories(100, 1.0, 0.8)), Ball(), True)[0]) == ["patches"]


def test_ellipsoids_of_the_paper(job):
    paths = motion_paths(job("ellipsoids"), Ball(), False)[0]["ellipsoids"]
    middles = [Ball().points(k).mean(axis=0) for k in range(FRAMES)]
    np.testing.assert_allclose(paths.positions, [middles], atol=1e-6)  # the ball is one


def test_patches_that_are_not_there(job):
    with pytest.raises(GeometryError, match=r"segmentation\.paths = nodes"):
        motion_paths(job("patches"), Ball(), False)[0]


def test_rays_go_with_the_paths_where_single_cameras_saw_them():
    tracks = trajectories(40, 1.0)
    ray = np.zeros(tracks.shape)
    tracked = Trajectories.of_positions(tracks, sigma=np.full(tracks.shape[:2], 0.002), ray=ray)
    found = patch_paths(tracked, 0.0)
    assert found is not None and found.ray is None
    ray[::2, 1] = [0.0, 0.6, 0.8]
    found = patch_paths(tracked, 0.0)
    assert found is not None and found.ray is not None and found.sigma is not None
    np.testing.assert_array_equal(found.ray, ray)
    np.testing.assert_allclose(found.sigma[::2, 1], 0.002 * ALONE_FRACTION)
    np.testing.assert_allclose(np.delete(found.sigma, 1, axis=1), 0.002)


def test_tracks_that_paths_were_chosen_from_come_along(job):
    tracks = trajectories(2 * SAMPLES, 1.0)
    assert motion_paths(job("nodes", tracks), Ball(), False)[1] is None
    ray = np.zeros_like(tracks)
    ray[::2, :, 1] = 1.0  # the hull places what single cameras see
    tracks[1, 1:] = np.nan
    found = motion_paths(job("auto", tracks, ray), Ball(), True)[1]
    np.testing.assert_allclose(found, tracks[3::2])


def test_what_carries_ellipsoids_is_all_that_lasts_where_it_is_asked_for(job):
    tracks = trajectories(50, 1.0)
    tracks[0, 1:] = np.nan
    ray = np.zeros_like(tracks)
    ray[::2, :, 1] = 1.0  # single cameras carry, too
    np.testing.assert_allclose(carrying_tracks(job("patches", tracks, ray), Ball(), True), tracks[1:])
    assert carrying_tracks(job("auto", tracks), Ball(), False) is None
    with pytest.raises(GeometryError, match=r"no surface patches could be followed.*segmentation\.paths = auto"):
        carrying_tracks(job("patches", tracks), Ball(), False)
