from dataclasses import fields

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from geomocap.errors import GeometryError
from geomocap.model.trajectories import TOO_FAST, UNLIKE, Trajectories
from geomocap.trajectories.filters import departure, filter_trajectories
from geomocap.trajectories.smoothing import smooth_motion
from geomocap.trajectories.trajectory_settings import FilterSettings, SmoothingSettings
from tests.geomocap.made_trajectories import join_tracks, make_tracks, rigid_tracks

FPS = 30.0
WIDE = FilterSettings(fastest=50, acceleration=5000, unlike=0.015)


def cloud(count=60, seed=0):
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 3))


def test_starts_ends_and_lengths_skip_gaps():
    positions = np.zeros((3, 6, 3))
    positions[0, [0, 3]] = np.nan
    positions[1, 4:] = np.nan
    positions[2] = np.nan
    tracks = make_tracks(positions)
    assert tracks.start.tolist() == [1, 0, 6]
    assert tracks.end.tolist() == [5, 3, -1]
    assert tracks.lengths.tolist() == [4, 4, 0]
    assert tracks.reasons() == {"followed to the last frame": 3}


def test_what_is_cleared_is_gone_and_only_there():
    tracks = make_tracks(np.ones((2, 4, 3)))
    kept = tracks.select(np.arange(2))
    drop = np.zeros((2, 4), bool)
    drop[1, 2:] = True
    tracks.clear(drop)
    assert tracks.lengths.tolist() == [4, 2]
    for values in (tracks.positions, tracks.rotations, tracks.sigma, tracks.correlation):
        assert np.isnan(values[drop]).all()
    assert not tracks.n_views[drop].any() and not tracks.ray[drop].any()
    assert_array_equal(tracks.positions[~drop], kept.positions[~drop])
    assert kept.lengths.tolist() == [4, 4]  # a selection is a copy


@pytest.mark.parametrize("count", [60, 5000])
def test_narrowed_tracks_are_those_selected_in_the_same_memory(count):
    tracks = rigid_tracks(cloud(count), 4, [0.01, 0, 0], [0, 0, 2])
    which = np.flatnonzero(np.random.default_rng(0).random(count) < 0.7)
    expected, read_only = tracks.select(which), Trajectories.of_positions(tracks.positions.copy())
    narrowed = tracks.narrowed(which)
    for field in fields(Trajectories):
        assert_array_equal(getattr(narrowed, field.name), getattr(expected, field.name))
        assert np.shares_memory(getattr(narrowed, field.name), getattr(tracks, field.name))
    assert np.isnan(read_only.narrowed(which).rotations).all()  # which has no memory of its own


def test_shapes_are_checked():
    tracks = make_tracks(np.zeros((2, 4, 3)))
    parts = {name: getattr(tracks, name) for name in tracks.__dataclass_fields__}
    with pytest.raises(GeometryError, match=r"sigma has shape \(2, 3\), expected \(2, 4\)"):
        Trajectories(**(parts | {"sigma": np.zeros((2, 3))}))


def test_a_parabola_is_smoothed_exactly():
    t = np.arange(12) / FPS
    path = np.stack([1 + 2 * t + 3 * t**2, -t, 0 * t], axis=1)[None]
    path[0, 5] = np.nan  # gaps don't matter
    motion = smooth_motion(path, FPS)
    seen = np.isfinite(path[0, :, 0])
    assert_allclose(motion.velocities[0, seen, 0], (2 + 6 * t)[seen], atol=1e-5)
    assert_allclose(motion.velocities[0, seen, 1], -1, atol=1e-5)
    assert_allclose(motion.accelerations[0, seen, 0], 6, atol=1e-3)
    assert np.isnan(motion.velocities[0, 5]).all()


def test_standard_deviations_are_those_of_the_noise():
    rng = np.random.default_rng(0)
    t = np.arange(20) / FPS
    truth = np.stack([t**2, 3 * t, -2 * t**2], axis=1)
    sigma = rng.uniform(0.5e-3, 2e-3, (3000, 20))
    noisy = truth + rng.normal(0, 1, (3000, 20, 3)) * sigma[:, :, None]
    motion = smooth_motion(noisy, FPS, sigma)
    for frame in (0, 10, 19):
        error = (motion.velocities[:, frame] - np.array([2 * t[frame], 3, -4 * t[frame]])) / motion.velocity_std[
            :, frame, None
        ]
        assert_allclose(error.std(), 1, atol=0.04)
        error = (motion.accelerations[:, frame] - [2, 0, -4]) / motion.acceleration_std[:, frame, None]
        assert_allclose(error.std(), 1, atol=0.04)


def test_standard_deviations_may_be_in_single_precision():
    rng = np.random.default_rng(3)
    path, sigma = rng.normal(size=(20, 30, 3)), 1e-4 * rng.uniform(1, 2, (20, 30)).astype(np.float32)
    path[::2, 10:12] = np.nan
    one, other = smooth_motion(path, FPS, sigma), smooth_motion(path, FPS, sigma.astype(float))
    for name in one.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def noise_gain(settings: SmoothingSettings, fps: float) -> tuple[float, float]:
    """Return how much of the positions' noise velocities (1/s) and accelerations (1/s²) have amid a gapless track."""
    T = 2 * settings.half_width + 1
    line = np.zeros((1, T, 3))
    motion = smooth_motion(line, fps, np.ones((1, T)), settings)
    return float(motion.velocity_std[0, T // 2]), float(motion.acceleration_std[0, T // 2])


def test_noise_is_found_from_the_residuals_if_it_is_not_given():
    noisy = np.random.default_rng(0).normal(0, 1e-3, (400, 20, 3))
    gain = noise_gain(SmoothingSettings(), FPS)[0]
    assert_allclose(smooth_motion(noisy, FPS).velocity_std[0, 10], gain * 1e-3, rtol=0.05)


def test_noise_gain_is_savitzky_golay():
    # seven points: velocity weights i / 28, acceleration weights (i² − 4) / 42 · 2 … of a quadratic
    steps = np.arange(-3, 4)
    velocity, acceleration = noise_gain(SmoothingSettings(half_width=3, degree=2), FPS)
    assert_allclose(velocity, FPS * np.sqrt((steps**2).sum()) / 28, rtol=1e-6)
    assert_allclose(acceleration, FPS**2 * np.sqrt(((steps**2 - 4.0) ** 2).sum()) / 42, rtol=1e-6)


def test_short_tracks_have_no_velocity():
    path = np.full((1, 10, 3), np.nan)
    path[0, 4:6] = 1.0
    assert np.isnan(smooth_motion(path, FPS).velocities).all()
    with pytest.raises(GeometryError, match="frame rate"):
        smooth_motion(path, 0.0)


def test_rigid_motion_is_uniform_even_if_it_turns():
    tracks = rigid_tracks(cloud(), 10, [0.02, 0, 0], [0, 0, 8.0])
    assert np.nanmax(departure(tracks, 3)) < 1e-9
    assert np.isnan(departure(tracks.select(np.arange(4)), 3)).all()


def test_a_point_that_leaves_its_neighbours_is_cut_there():
    tracks = rigid_tracks(cloud(), 20, [0.01, 0, 0], [0, 0, 2.0])
    positions = tracks.positions.copy()
    positions[7, 12:] += np.linspace(0.02, 0.1, 8)[:, None]  # drifts off
    tracks = make_tracks(positions, tracks.rotations)
    result = filter_trajectories(tracks, smooth_motion(positions, FPS), WIDE)
    left = result.trajectories
    assert left.measured[7, :12].all() and not left.measured[7, 12:].any()
    assert left.end_reason[7] == UNLIKE
    assert left.measured[np.arange(60) != 7].all()
    assert result.cut == {
        "too fast": 0,
        "accelerated too much": 0,
        "unlike the motion around it": 1,
        "too short": 0,
    }


def test_before_the_frame_of_placing_tracks_are_cut_backward():
    tracks = rigid_tracks(cloud(), 20, [0.01, 0, 0], [0, 0, 2.0])
    positions = tracks.positions.copy()
    positions[7, :5] += 0.05
    late = make_tracks(positions, tracks.rotations)
    late = Trajectories(**({n: getattr(late, n) for n in late.__dataclass_fields__} | {"placed": np.full(60, 15)}))
    result = filter_trajectories(late, smooth_motion(positions, FPS), WIDE)
    assert not result.trajectories.measured[7, :5].any()
    assert result.trajectories.measured[7, 9:].all()
    assert result.trajectories.begin_reason[7] == UNLIKE and result.trajectories.end_reason[7] == 0


def test_speed_limits_come_from_the_data_or_are_given():
    slow = rigid_tracks(cloud(), 12, [0.01, 0, 0], [0, 0, 0])
    fast = rigid_tracks(cloud(3, 1) + 5, 12, [0.2, 0, 0], [0, 0, 0])
    both = join_tracks(slow, fast)
    motion = smooth_motion(both.positions, FPS)
    given = filter_trajectories(both, motion, FilterSettings(fastest=3.0))
    assert given.cut["too fast"] == 3 and given.kept.tolist() == list(range(60))
    own = filter_trajectories(slow, smooth_motion(slow.positions, FPS))
    assert_allclose(own.fastest, 2.5 * 0.3, rtol=1e-6)
    assert own.cut["too fast"] == 0
    assert (given.trajectories.end_reason != TOO_FAST).all()
