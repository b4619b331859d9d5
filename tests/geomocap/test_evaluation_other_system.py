import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.marker_track import MarkerTrack
from geomocap.evaluation.other_system import compare_markers, match_by_distance, read_matches
from geomocap.evaluation.result import EvaluationError
from geomocap.evaluation.run_evaluation import evaluate
from geomocap.export.bvh import write_bvh
from geomocap.export.markers import Markers
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.trc import write_trc
from geomocap.files.run import Run
from geomocap.model.rotations import rigid_motion
from tests.geomocap.articulated import skeleton_arrays, skeleton_of

OFFSET = 0.37
BOTH = EvaluationSettings(align=True, find_offset=True)


def found_markers(**kind):
    arrays = skeleton_arrays(n_bodies=9, n_frames=60, seed=5, **kind)
    return Markers(tuple(arrays["joint_names"]), arrays["joint_positions"], 15.0)


def other_system(found, *, fps=100.0, noise=0.002, gaps=True, turn=True, offset=OFFSET, seed=0):
    """The same motion as another system sees it: its own rate, clock, world, names, noise, gaps and one more marker."""
    rng = np.random.default_rng(seed)
    run_times = np.arange(found.n_frames) / found.fps
    times = np.arange(int((run_times[-1] + offset) * fps)) / fps - offset
    seen = (times >= 0) & (times <= run_times[-1])
    points = np.full((len(times), len(found.names) + 1, 3), np.nan)
    points[seen, :-1] = CubicSpline(run_times, found.positions)(times[seen])
    points[seen, -1] = points[seen, 0] + [0.3, 0.4, 1.2]
    R = Rotation.random(rng=rng).as_matrix() if turn else np.eye(3)
    t = rng.normal(0, 2, 3) if turn else np.zeros(3)
    points = points @ R.T + t + rng.normal(0, noise, points.shape)
    if gaps:
        for k in range(points.shape[1]):
            start = rng.integers(0, len(times))
            points[start : start + len(times) // 8, k] = np.nan
    order = rng.permutation(points.shape[1])
    return Markers(tuple(f"M{k}" for k in range(len(order))), points[:, order], fps, found.up), R, t, order


@pytest.mark.parametrize("fps", [15.0, 100.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_offset_and_alignment_are_found_without_names(fps, seed):
    found = found_markers()
    other, R, t, order = other_system(found, fps=fps, seed=seed)
    result = compare_markers(found, other, BOTH)
    a = result.alignment
    assert a.time_offset == pytest.approx(OFFSET, abs=0.5 / 15)
    centre = found.positions.reshape(-1, 3).mean(axis=0)
    back = a.rotation @ (R @ centre + t) + a.translation
    assert np.linalg.norm(back - centre) < 0.001
    assert Rotation.from_matrix(a.rotation @ R).magnitude() < np.deg2rad(0.2)
    named = {m.found: m.true for m in result.matches}
    assert named == {found.names[j]: f"M{order.tolist().index(j)}" for j in range(8)}
    assert result.figures["markers.mean_error"] < 6
    assert result.figures["alignment.time_offset_s"] == a.time_offset


def test_a_mirrored_world_does_not_fit():
    found = found_markers()
    other, *_ = other_system(found, noise=0.0, gaps=False, turn=False, offset=0.0)
    mirrored = Markers(other.names, other.positions * [1, -1, 1], other.fps)
    try:
        result = compare_markers(found, mirrored, EvaluationSettings(align=True))
    except EvaluationError:
        return
    assert result.figures["markers.mean_error"] > 50


def test_same_world_and_clock_need_no_search():
    found = found_markers()
    other, *_ = other_system(found, turn=False, offset=0.0, gaps=False)
    result = compare_markers(found, other, EvaluationSettings())
    assert result.figures["markers.matched"] == 8
    assert result.figures["markers.mean_error"] == pytest.approx(2 * np.sqrt(8 / np.pi), rel=0.2)  # Maxwell mean
    assert "alignment.time_offset_s" not in result.figures


def test_a_stated_offset_is_used():
    found = found_markers()
    other, *_ = other_system(found, turn=False, noise=0.0, gaps=False)
    result = compare_markers(found, other, EvaluationSettings(offset=OFFSET))
    assert result.figures["markers.mean_error"] < 1
    with pytest.raises(EvaluationError, match=r"overlap in 0 frames at a time offset of 30.000 s"):
        compare_markers(found, other, EvaluationSettings(offset=30.0))


def test_repeating_motion_takes_the_smallest_offset():
    t = np.arange(90) / 15
    phase = np.arange(6)[:, None] * [0.9, 1.7, 2.3]
    wave = np.sin(2 * np.pi * t[:, None, None] / 1.2 + phase) * 0.3 + np.arange(6)[:, None] * [0.2, -0.1, 0.3]
    found = Markers(tuple("abcdef"), wave, 15.0)
    other, *_ = other_system(found, offset=0.2, gaps=False)
    assert compare_markers(found, other, BOTH).alignment.time_offset == pytest.approx(0.2, abs=0.5 / 15)


@pytest.mark.parametrize("kind", ["trc", "bvh"])
def test_motion_files_as_truth(tmp_path, kind):
    arrays = skeleton_arrays()
    run = Run(tmp_path / "run")
    run.write_npz("skeleton.npz", **arrays)
    if kind == "trc":
        write_trc(tmp_path / "truth.trc", Markers(tuple(arrays["joint_names"]), arrays["joint_positions"], 15.0))
    else:
        write_bvh(tmp_path / "truth.bvh", motion_from_skeleton(skeleton_of(arrays)), unit="cm")
    result = evaluate(run.path, tmp_path / f"truth.{kind}", unit="cm")
    assert result.figures["markers.matched"] == 6
    assert result.figures["markers.mean_error"] < 0.01


def test_pairs_from_a_table(tmp_path):
    found = found_markers()
    other, _, _, order = other_system(found, turn=False, offset=0.0, gaps=False)
    marker = f"M{order.tolist().index(2)}"
    (tmp_path / "m.toml").write_text(f'{found.names[2]} = "{marker}"\n')
    result = compare_markers(found, other, EvaluationSettings(), matches=read_matches(tmp_path / "m.toml"))
    assert [(m.found, m.true) for m in result.matches] == [(found.names[2], marker)]
    with pytest.raises(EvaluationError, match="the truth has no marker LKNE; it has M0"):
        compare_markers(found, other, EvaluationSettings(), matches={found.names[2]: "LKNE"})
    with pytest.raises(EvaluationError, match="the run has no joint knee"):
        compare_markers(found, other, EvaluationSettings(), matches={"knee": marker})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a = 3", "expected the name of a marker"),
        ('a = "M"\nb = "M"', "M stands for two joints"),
        ("=", "not valid TOML"),
    ],
)
def test_bad_tables(tmp_path, text, says):
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(EvaluationError, match=says):
        read_matches(tmp_path / "m.toml")


def test_other_units_and_nothing_there():
    found = found_markers()
    other, *_ = other_system(found)
    with pytest.raises(EvaluationError, match="one of them is in other units"):
        compare_markers(found, Markers(other.names, other.positions * 1000, other.fps), BOTH)
    with pytest.raises(EvaluationError, match="the other system has no position"):
        compare_markers(found, Markers(other.names, other.positions * np.nan, other.fps), BOTH)
    with pytest.raises(EvaluationError, match="no joint lies within"):
        compare_markers(found, Markers(found.names[:2], found.positions[:, :2] + 50, 15.0), EvaluationSettings())


def test_up_is_laid_on_up():
    found = found_markers()
    y_up = Markers(found.names, found.positions[..., [0, 2, 1]] * [1, 1, -1], 15.0, "y")
    assert compare_markers(found, y_up, EvaluationSettings()).figures["markers.mean_error"] < 1e-6


def test_rigid_motion_is_exact_and_never_mirrors():
    rng = np.random.default_rng(2)
    a = rng.normal(size=(10, 3))
    R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    found_R, found_t = rigid_motion(a, a @ R.T + t, np.ones(10))
    np.testing.assert_allclose(found_R, R, atol=1e-12)
    np.testing.assert_allclose(found_t, t, atol=1e-12)
    assert np.linalg.det(rigid_motion(a, a * [1, 1, -1], np.ones(10))[0]) == pytest.approx(1)


def test_tracks_of_markers_never_bridge_gaps():
    t = np.arange(30) / 10
    positions = np.stack([np.sin(t), np.cos(t), t], axis=1)[:, None]
    positions[10:15] = np.nan
    track = MarkerTrack(positions, 10.0)
    at = track.at(np.array([0.55, 0.95, 1.2, 1.55, 3.0]))[:, 0]
    assert np.isnan(at[[1, 2, 4]]).all()
    np.testing.assert_allclose(at[0], [np.sin(0.55), np.cos(0.55), 0.55], atol=1e-4)
    np.testing.assert_allclose(at[3], [np.sin(1.55), np.cos(1.55), 1.55], atol=1e-4)


def test_matching_is_one_to_one_and_least_in_sum():
    distance = np.array([[[0.1, 0.2], [0.1, 0.9]]])
    assert match_by_distance(distance, 0.5) == [(0, 1), (1, 0)]
    assert match_by_distance(distance, 0.15) == [(0, 0)] or match_by_distance(distance, 0.15) == [(1, 0)]
