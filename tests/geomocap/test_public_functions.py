"""The public functions of values: motion, volumes and clouds without a run folder."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import geomocap
from geomocap.carving.carving_settings import CarvingSettings
from geomocap.errors import CaptureError, GeometryError, SettingsError
from geomocap.patches.patch_settings import TrackingSettings
from tests.geomocap.ball import HEIGHT, RADIUS, WIDTH, Texture, off_surface, photograph, ring
from tests.geomocap.moving_chains import chain, same_partition


@pytest.fixture(scope="module")
def three():
    return chain(3)


def test_tracks_with_gaps_give_bodies_joints_and_labels_of_every_track(three):
    tracks = three.positions.copy()
    tracks[::7, :5] = np.nan  # unseen in the first frames
    tracks[3] = np.nan  # never seen
    motion = geomocap.find_motion(tracks, fps=30)
    assert motion.body_count == 3 and motion.skeleton.joint_positions.shape == (tracks.shape[1], 2, 3)
    assert motion.labels[3] == -1
    seen = np.isfinite(tracks).all(axis=2).any(axis=1)
    assert same_partition(motion.labels[seen], three.body[seen])
    assert motion.warnings == ()


def test_the_number_of_bodies_can_be_given(three):
    assert geomocap.find_motion(three.positions, fps=30, bodies=2).body_count == 2


def test_results_repeat_bit_for_bit(three):
    first, second = (geomocap.find_motion(three.positions, fps=30) for _ in range(2))
    assert_array_equal(first.skeleton.joint_positions, second.skeleton.joint_positions)
    assert_array_equal(first.weights, second.weights)


@pytest.mark.parametrize("wrong", [np.zeros((5, 3)), [np.zeros((4, 2))]])
def test_arrays_of_another_shape_are_refused_in_one_line(wrong):
    with pytest.raises(GeometryError, match="shape"):
        geomocap.find_motion(wrong, fps=30)


def test_standard_deviations_of_another_shape_are_refused(three):
    with pytest.raises(GeometryError, match="sigma"):
        geomocap.find_motion(three.positions, fps=30, sigma=np.ones(2))


def test_swapped_axes_of_tracks_are_told(three):
    swapped = three.positions[::3].swapaxes(0, 1)
    motion = geomocap.find_motion(swapped, fps=30)
    assert "axes of the tracks seem to be swapped" in motion.warnings[0]
    with pytest.raises(
        GeometryError, match=r"12 points in 90 frames.*\(N points, T frames, 3\); the axes seem to be sw"
    ):
        geomocap.find_motion(swapped[::2], fps=30)
    with pytest.raises(GeometryError, match=r"12 points in 2 frames, .*expected \(N points, T frames, 3\)$"):
        geomocap.find_motion(swapped[::2, :2], fps=30)


def test_another_number_of_bodies_than_asked_for_is_told(three):
    motion = geomocap.find_motion(three.positions, fps=30, bodies=10)
    assert motion.body_count < 10
    assert [f"{motion.body_count} bodies were found, 10 were asked for" in line for line in motion.warnings] == [True]
    assert geomocap.find_motion(three.positions, fps=30, bodies=3).warnings == ()


def test_bodies_that_nothing_holds_together_are_told():
    one, other = chain(1).positions, chain(1, seed=3).positions[:, ::-1]
    motion = geomocap.find_motion(np.concatenate([one, other + np.array([0.0, 0.0, 1.3])]), fps=30)
    assert motion.skeleton.joint_count == 1  # files take one tree
    (line,) = motion.warnings
    assert "farther apart than" in line and "body00 and body01 (1.2 m)" in line


@pytest.mark.parametrize("bodies", [-1, 2.5, 500, True])
def test_a_number_of_bodies_that_cant_be_is_refused(three, bodies):
    with pytest.raises(SettingsError, match="bodies"):
        geomocap.find_motion(three.positions, fps=30, bodies=bodies)


@pytest.mark.parametrize("fps", [0, -30.0, float("nan"), float("inf"), None, "30"])
def test_frames_per_second_that_cant_be_are_refused(three, fps):
    with pytest.raises(SettingsError, match="frames per second"):
        geomocap.find_motion(three.positions, fps=fps)
    with pytest.raises(SettingsError, match="frames per second"):
        geomocap.track([], [], [], None, fps=fps)


@pytest.mark.parametrize("tracks", [None, 3, "tracks.npy", ["a"], np.full((30, 9, 3), "a"), np.zeros((30, 0, 3))])
def test_what_is_no_tracks_is_refused(tracks):
    with pytest.raises(GeometryError, match="expected"):
        geomocap.find_motion(tracks, fps=30)


def test_standard_deviations_below_zero_are_refused(three):
    with pytest.raises(GeometryError, match=r"sigma is -0\.001 m"):
        geomocap.find_motion(three.positions, fps=30, sigma=np.full(len(three.positions), -0.001))


def test_frames_and_points_that_cant_be_are_refused_where_bodies_are_asked(three):
    motion = geomocap.find_motion(three.positions, fps=30)
    points = three.positions[:, 3]
    for frame in (-1, 24, 99):
        with pytest.raises(GeometryError, match=f"frame {frame}: there are frames 0 to 23"):
            motion.label(frame, points)
    for wrong in (points.T, three.positions, points[:, :2], np.full((4, 3), np.nan)):
        with pytest.raises(GeometryError, match=r"points have shape .* expected \(M, 3\)"):
            motion.label(0, wrong)
    assert_array_equal(motion.label(3, points[7]), motion.label(3, points)[7:8])
    assert motion.label(3, []).shape == (0,)


def test_importing_the_library_loads_nothing_heavy():
    code = "import sys, geomocap; print([m for m in ('numba', 'open3d', 'scipy', 'pycolmap') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("name", geomocap.__all__)
def test_every_public_name_is_there_and_documented(name):
    assert name in dir(geomocap)
    assert name == "__version__" or getattr(geomocap, name).__doc__


def test_one_frame_of_a_ball_is_carved_and_measured():
    rig = ring(8, 360.0)
    images, masks = photograph(rig, Texture.random())
    settings = CarvingSettings(resolution=64)
    voxels = geomocap.carve(masks, rig, images=images, settings=settings)
    # A hull stands off between its cameras' rays: of a ring of eight, by less than a fifth of the radius
    assert off_surface(voxels.points).mean() < 0.2 * RADIUS and len(voxels.colors) == len(voxels.points)
    found = geomocap.measure_cloud(images, rig, masks=masks, hull=voxels)
    assert np.median(off_surface(found.points.positions)) < 1e-3  # metres; 0.2 pixels


def test_a_capture_that_is_none_is_refused_in_one_line(tmp_path):
    with pytest.raises(CaptureError, match=r"capture\.toml"):
        geomocap.open_capture(tmp_path)


def test_silhouettes_of_a_ball_and_tracks_of_its_surface():
    rig = ring(8, 360.0)
    images, masks = photograph(rig, Texture.random())
    walls = [wall(rig, c) for c in range(len(rig))]
    found = geomocap.find_silhouettes([images, images], rig, backgrounds=walls)
    for mask, true in zip(found[0], masks, strict=True):
        assert (mask & true).sum() / (mask | true).sum() > 0.97  # the outline is right to a pixel
    volume = geomocap.carve(masks, rig, images=images, settings=CarvingSettings(resolution=64))
    settings = TrackingSettings(n_patches=200)
    tracks = geomocap.track([images] * 3, [masks] * 3, [volume] * 3, rig, fps=30, settings=settings)
    moved = tracks.trajectories.positions[:, 2] - tracks.trajectories.positions[:, 0]
    assert len(moved) > 50 and np.nanmedian(np.linalg.norm(moved, axis=1)) < 1e-4  # metres: it stands still


def wall(rig, camera):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    _, d = rig.rays(camera, np.column_stack([x.ravel(), y.ravel()]))
    grey = 60 + 30 * d[:, 2] + np.random.default_rng(camera).normal(0, 1, len(d))
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH, 1), 3, axis=2)


def test_silhouettes_of_cameras_that_do_not_fit_are_refused():
    image = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(CaptureError, match="2 images a frame"):
        geomocap.find_silhouettes([[image, image]], backgrounds=[image])
