import itertools

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.evaluation.body_scores import adjusted_rand_index
from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.result import EvaluationError
from geomocap.evaluation.run_evaluation import evaluate
from geomocap.evaluation.truth import Truth
from geomocap.export.export_errors import MotionError
from geomocap.files.results import read_points
from geomocap.files.run import Run
from tests.geomocap.made_truth import flawed_run, truth_arrays, write_truth


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """A flawed run, its truth, and what `evaluate` says on every third frame."""
    folder = tmp_path_factory.mktemp("evaluation")
    run, truth = flawed_run(folder / "run"), write_truth(folder / "truth")
    return run, truth_arrays(), evaluate(run.path, truth, EvaluationSettings(every=3))


def closest_vertices(points, vertices):
    """Slow stand-in for closest surface points; the mesh is fine enough to tell segments apart by vertices."""
    return np.linalg.norm(points[:, None] - vertices, axis=-1).argmin(axis=1)


def dense_surface(t, frame):
    """Points all over the true triangles, and the rig joint that owns each: a slow stand-in for closest points."""
    grid = np.array([(i, j) for i in range(13) for j in range(13 - i)]) / 12
    weights = np.stack([1 - grid.sum(axis=1), grid[:, 0], grid[:, 1]], axis=1)
    points = np.einsum("wk,fkc->fwc", weights, t["vertices"][frame][t["faces"]])
    owner = np.repeat(t["vertex_joint"][t["faces"][:, 0]], len(weights))
    return points.reshape(-1, 3), owner


def pair_counting(a, b):
    """The adjusted Rand index from its definition, counting pairs one by one."""
    both = first = second = 0
    pairs = list(itertools.combinations(range(len(a)), 2))
    for i, j in pairs:
        same_a, same_b = a[i] == a[j], b[i] == b[j]
        both += same_a and same_b
        first += same_a
        second += same_b
    expected = first * second / len(pairs)
    return (both - expected) / ((first + second) / 2 - expected)


def test_adjusted_rand_index_by_counting_pairs():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 4, 40), rng.integers(-1, 3, 40)
    assert adjusted_rand_index(a, b) == pytest.approx(pair_counting(a, b))
    assert adjusted_rand_index(a, (a + 1) % 4) == pytest.approx(1)


def test_equal_labellings_without_contrast_agree():
    for same in (np.zeros(100, int), np.arange(100), np.zeros(1, int)):
        assert adjusted_rand_index(same, same + 3) == 1.0
    assert adjusted_rand_index(np.zeros(100, int), np.arange(100)) == 0.0
    assert adjusted_rand_index(np.zeros(100, int), np.arange(100) // 50) == 0.0


def test_true_bodies_need_fifteen_degrees(tmp_path):
    truth = Truth.read(write_truth(tmp_path))
    assert truth.bodies.of_joint.tolist() == [0, 1, 2, 3, 3]
    assert truth.bodies.parent.tolist() == [-1, 0, 1, 0]
    assert truth.bodies.root.tolist() == [0, 1, 2, 3]


def test_truth_figures(judged):
    _, t, result = judged
    assert result.figures["truth.bodies"] == 4
    z = t["vertices"][0, :, 2]
    assert result.figures["truth.height_m"] == pytest.approx(z.max() - z.min(), abs=6e-4)


def test_cloud_against_distances_to_triangles(judged):
    run, t, result = judged
    accuracy, completeness, counts = [], [], []
    for k in range(0, 16, 3):
        points = read_points(run.frame_file("cloud", k)).positions
        accuracy.append(cKDTree(dense_surface(t, k)[0]).query(points)[0])
        completeness.append(np.linalg.norm(points[:, None] - t["vertices"][k], axis=-1).min(axis=0))
        counts.append(len(points))
    accuracy, completeness = np.concatenate(accuracy) * 1000, np.concatenate(completeness) * 1000
    assert result.figures["cloud.points_per_frame"] == np.mean(counts)
    assert result.figures["cloud.accuracy_median"] == pytest.approx(np.median(accuracy), abs=0.3)
    assert result.figures["cloud.accuracy_p95"] == pytest.approx(np.percentile(accuracy, 95), abs=0.5)
    assert result.figures["cloud.completeness_median"] == pytest.approx(np.median(completeness), abs=1e-3)
    fraction = np.mean(completeness < 10)
    assert result.figures["cloud.fraction_of_surface_within_10mm"] == pytest.approx(fraction, abs=1e-3)


def test_bodies_against_counting(judged):
    run, t, result = judged
    height = np.ptp(t["vertices"][0, :, 2])
    index = []
    for k in range(0, 16, 3):
        read = read_points(run.frame_file("bodies", k))
        points, label = read.positions, read.body
        surface, owner = dense_surface(t, k)
        distance, nearest = cKDTree(surface).query(points)
        true = np.array([0, 1, 2, 3, 3])[owner[nearest]]
        near = distance < 0.05 * height
        index.append(pair_counting(label[near], true[near]))
    assert result.figures["bodies.adjusted_rand_index"] == pytest.approx(np.mean(index), abs=0.02)
    assert result.figures["bodies.adjusted_rand_index_worst_frame"] == pytest.approx(np.min(index), abs=0.03)
    assert result.figures["bodies.found"] == 4
    # Weights are one or zero: nearly everything near the surface is core.
    assert result.figures["bodies.core_fraction"] > 0.95


def test_joints_against_loops(judged):
    run, t, result = judged
    s, height = run.read_npz("skeleton.npz"), np.ptp(t["vertices"][0, :, 2])
    true = t["joint_positions"][:, [1, 2, 3]]
    distance = np.full((16, 4, 3), 10 * height)
    for k, i, j in np.ndindex(16, 4, 3):
        d = np.linalg.norm(s["joint_positions"][k, i] - true[k, j])
        if np.isfinite(d):
            distance[k, i, j] = d
    mean = distance.mean(axis=0)
    cost = {
        p: sum(min(mean[i, j], 0.15 * height) for j, i in enumerate(p)) for p in itertools.permutations(range(4), 3)
    }
    best = min(cost, key=cost.get)
    pairs = [(i, j) for j, i in enumerate(best) if mean[i, j] < 0.1 * height]
    assert pairs == [(0, 0), (2, 2)]  # the joint with a missing frame counts as ten heights away there
    f = result.figures
    assert (f["joints.found"], f["joints.true"]) == (4, 3)
    assert f["joints.recall_at_10%h"] == pytest.approx(2 / 3)
    assert f["joints.recall_at_5%h"] == pytest.approx(sum(mean[p] < 0.05 * height for p in pairs) / 3)
    assert f["joints.precision_at_10%h"] == pytest.approx(0.5)
    errors = [mean[p] for p in pairs]
    assert f["joints.mean_error"] == pytest.approx(1000 * np.mean(errors))
    assert f["joints.mean_error_%h"] == pytest.approx(100 * np.mean(errors) / height)
    assert f["joints.p95_error"] == pytest.approx(1000 * np.percentile([distance[:, i, j] for i, j in pairs], 95))
    jitter = []
    for i, j in pairs:
        off = s["joint_positions"][:, i] - true[:, j]
        jitter.append(np.mean([np.linalg.norm(off[k] - 2 * off[k + 1] + off[k + 2]) for k in range(14)]))
    assert f["joints.jitter_second_difference"] == pytest.approx(1000 * np.mean(jitter))
    assert {(m.found, m.true) for m in result.matches} == {
        ("joint_body00_body01", "arm"),
        ("joint_body00_body03", "leg"),
    }


def test_edges_and_rotations(judged):
    _, _, result = judged
    assert result.figures["skeleton.true_edges_found"] == 1
    assert result.figures["skeleton.false_edges"] == 1  # 2–4
    # One body of three drifts evenly from 0° to 12°, the others are right.
    assert result.figures["motion.body_rotation_error_deg"] == pytest.approx(6 / 3, abs=1e-3)


def test_tracks_against_their_vertices(judged):
    run, t, result = judged
    positions = run.read_npz("tracks.npz")["positions"]
    drift = []
    for track in positions:
        k = int(np.flatnonzero(np.isfinite(track[:, 0]))[0])
        v = closest_vertices(track[k : k + 1], t["vertices"][k])[0]
        off = track - t["vertices"][:, v]
        d = np.linalg.norm(off - off[k], axis=1)[k + 1 :]
        drift += d[np.isfinite(d)].tolist()
    f = result.figures
    assert f["tracks.count"] == 20
    assert f["tracks.mean_length_frames"] == pytest.approx(np.isfinite(positions[:, :, 0]).sum() / 20)
    assert f["tracks.drift_median"] == pytest.approx(1000 * np.median(drift), rel=0.1)


def test_a_perfect_run_is_perfect(tmp_path):
    truth = write_truth(tmp_path / "truth")
    run = flawed_run(tmp_path / "run", joint_noise=0.0)
    s, t = run.read_npz("skeleton.npz"), truth_arrays()
    turned = t["joint_rotations"][:, [0, 1, 2, 3]]
    s["body_rotations"] = np.einsum("tbij,bkj->tbik", turned, turned[0])
    s["joint_positions"] = t["joint_positions"][:, [1, 2, 3]]
    s["joint_bodies"], s["joint_names"] = s["joint_bodies"][:3], s["joint_names"][:3]
    s["body_positions"] = s["body_positions"][:, :4]
    run.write_npz("skeleton.npz", **s)
    f = evaluate(run.path, truth).figures
    assert f["joints.recall_at_5%h"] == f["joints.precision_at_10%h"] == f["skeleton.true_edges_found"] == 1
    assert f["joints.mean_error"] == pytest.approx(0, abs=1e-9)
    assert f["motion.body_rotation_error_deg"] == pytest.approx(0, abs=1e-4)
    assert evaluate(str(run.path), str(truth)).figures == f
    assert f["skeleton.false_edges"] == 0


def test_one_body_recalls_no_joint(tmp_path):
    truth, run = write_truth(tmp_path / "truth"), flawed_run(tmp_path / "run")
    s = run.read_npz("skeleton.npz")
    s["joint_positions"], s["joint_bodies"] = s["joint_positions"][:, :0], s["joint_bodies"][:0]
    s["joint_names"], s["body_rotations"] = s["joint_names"][:0], s["body_rotations"][:, :1]
    s["body_positions"] = s["body_positions"][:, :1]
    run.write_npz("skeleton.npz", **s)
    f = evaluate(run.path, truth).figures
    assert (f["joints.found"], f["joints.true"]) == (0, 3)
    assert f["joints.recall_at_10%h"] == f["joints.recall_at_5%h"] == f["skeleton.true_edges_found"] == 0
    assert f["skeleton.false_edges"] == 0
    assert "joints.precision_at_10%h" not in f
    for k in run.frames("bodies"):  # all in one body
        cloud = o3d.t.io.read_point_cloud(str(run.frame_file("bodies", k)))
        cloud.point["body"] = cloud.point["body"] * 0
        o3d.t.io.write_point_cloud(str(run.frame_file("bodies", k)), cloud)
    assert evaluate(run.path, truth).figures["motion.body_rotation_error_deg"] > 10


def test_a_perfect_run_of_two_roots_is_perfect(tmp_path):
    t = truth_arrays()
    truth = write_truth(tmp_path / "truth", joint_parents=np.array([-1, 0, 1, -1, 3]))
    run = flawed_run(tmp_path / "run")
    s = run.read_npz("skeleton.npz")
    s["joint_positions"], s["joint_bodies"] = t["joint_positions"][:, [1, 2]], np.array([[0, 1], [1, 2]])
    s["joint_names"] = s["joint_names"][:2]
    s["body_rotations"], s["body_positions"] = s["body_rotations"][:, :3], s["body_positions"][:, :3]
    run.write_npz("skeleton.npz", **s)
    f = evaluate(run.path, truth).figures
    assert (f["truth.bodies"], f["joints.true"]) == (4, 2)
    assert f["joints.recall_at_5%h"] == f["joints.precision_at_10%h"] == f["skeleton.true_edges_found"] == 1
    assert f["skeleton.false_edges"] == 0


def test_rotation_error_ignores_the_rest_pose(tmp_path):
    """Only turns since the first frame count: the rig's own axes at rest don't matter."""
    t = truth_arrays()
    rest = Rotation.random(5, rng=np.random.default_rng(0)).as_matrix()
    truth = write_truth(tmp_path / "truth", joint_rotations=t["joint_rotations"] @ rest)
    run = flawed_run(tmp_path / "run")
    assert evaluate(run.path, truth).figures["motion.body_rotation_error_deg"] == pytest.approx(2, abs=1e-3)


def test_figures_are_rounded_as_they_are_printed(judged):
    rounded = judged[2].rounded()
    assert isinstance(rounded["joints.found"], int)
    assert rounded["joints.mean_error"] == round(rounded["joints.mean_error"], 4)


NAN = np.full((16, 5, 3), np.nan)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fps": np.array(0.0)}, "fps is 0,"),
        ({"fps": np.array(30.0)}, "its skeleton has 15 frames per second, the truth 30"),
        ({"joint_positions": NAN}, "joint_positions holds NaN or infinity in frame 0"),
        ({"vertices": np.zeros((0, 4, 3))}, "vertices has shape"),
        ({"joint_names": np.array(["a", "b", "c", "d", "a"])}, "two rig joints are called a"),
        ({"vertices": truth_arrays()["vertices"] * 1000}, "the truth's lengths must be metres"),
        ({"joint_parents": np.array([1, 0, 1, 0, 3])}, "makes a loop"),
        ({"joint_rotations": np.zeros((16, 4, 3, 3))}, "doesn't fit the other arrays"),
    ],
)
def test_broken_truths(judged, tmp_path, change, says):
    truth = write_truth(tmp_path, **change)
    with pytest.raises(EvaluationError, match=says) as caught:
        evaluate(judged[0].path, truth)
    assert "\n" not in str(caught.value)


def test_missing_and_damaged_truths_and_runs(judged, tmp_path):
    run = judged[0].path
    with pytest.raises(EvaluationError, match="no such run folder"):
        evaluate(tmp_path / "nothing", write_truth(tmp_path / "truth"))
    with pytest.raises(EvaluationError, match=r"truth\.npz: missing"):
        evaluate(run, tmp_path)
    (tmp_path / "truth.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(EvaluationError, match=r"truth\.npz: damaged"):
        evaluate(run, tmp_path)
    np.savez(tmp_path / "truth.npz", positions=np.zeros(3))
    with pytest.raises(EvaluationError, match="has no array fps, vertices"):
        evaluate(run, tmp_path)
    with pytest.raises(EvaluationError, match=r"expected a folder with truth.npz, or a .c3d"):
        evaluate(run, tmp_path / "truth.fbx")
    (tmp_path / "empty").mkdir()
    with pytest.raises(EvaluationError, match="holds no voxels, cloud, bodies"):
        evaluate(tmp_path / "empty", tmp_path / "truth")
    with pytest.raises(MotionError, match=r"walk\.trc"):
        evaluate(run, tmp_path / "walk.trc")


def test_an_empty_run_of_a_capture_says_so(tmp_path):
    Run(tmp_path / "run").write_record({})
    with pytest.raises(EvaluationError, match="to judge"):
        evaluate(tmp_path / "run", write_truth(tmp_path / "truth"))
