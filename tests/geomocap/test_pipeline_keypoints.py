"""Key-points from a TOML file, followed through a run's trajectories and written as arrays and motion files."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError, RunError, SettingsError
from geomocap.export.c3d import read_c3d
from geomocap.export.trc import read_trc
from geomocap.files.run import Run
from geomocap.keypoints.keypoint_regions import KeyPoint, KeyPointFile, read_keypoints, write_keypoints
from geomocap.pipeline.keypoint_stage import keypoints

FILE = """
links = [["wrist", "heel"]]
[[keypoint]]
name = "wrist"
center = [0.1, 0.0, 0.0]
radius = 0.05
[[keypoint]]
name = "heel"
center = [-0.1, 0.0, 0.3]
radius = 0.05
frame = 4
"""
FRAMES, FPS = 8, 25.0


@pytest.fixture
def scene(tmp_path):
    """A run with tufts of trajectories at wrist and heel of a turning body, and some round the wrist; the truth."""
    rng = np.random.default_rng(0)
    wrist, heel = np.array([0.1, 0, 0]), np.array([-0.1, 0, 0.3])
    around = rng.normal(size=(40, 3))
    around *= 0.1 / np.linalg.norm(around, axis=1, keepdims=True)
    tufts = rng.normal(size=(2, 40, 3)) * 0.015
    places = np.concatenate([wrist + tufts[0], heel + tufts[1], wrist + around])
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 1, FRAMES), [0.2, 0.5, -0.3])).as_matrix()
    shifts = np.outer(np.linspace(0, 1, FRAMES), [0.3, -0.1, 0.2])
    run = Run(tmp_path)
    run.write_npz("tracks.npz", positions=np.einsum("tij,nj->nti", turns, places) + shifts)
    run.write_record({"source": {"fps": FPS, "up": "y"}})
    there = turns[4] @ heel + shifts[4]
    (tmp_path / "k.toml").write_text(FILE.replace("[-0.1, 0.0, 0.3]", str(there.tolist())))
    truth = np.einsum("tij,kj->tki", turns, [wrist, heel]) + shifts[:, None]
    return run, read_keypoints(tmp_path / "k.toml"), truth


def test_keypoints_move_with_the_surface_around_them(scene):
    run, file, truth = scene
    found = keypoints(run, file)
    saved = run.read_npz("keypoints.npz")
    assert saved["names"].tolist() == ["wrist", "heel"] and saved["radius"].tolist() == [0.05, 0.05]
    assert saved["links"].tolist() == [[0, 1]] and saved["fps"] == FPS
    np.testing.assert_allclose(saved["positions"], truth, atol=1e-5)  # the robust fit weighs, and is regular
    velocity = np.gradient(truth, 1 / FPS, axis=0)[1:-1]
    np.testing.assert_allclose(saved["velocities"][1:-1], velocity, atol=0.01)
    assert [p.name for p in found.files] == ["keypoints.npz", "keypoints.trc", "keypoints.c3d"]


def test_motion_files_mark_gaps_and_bridges(scene):
    run, file, truth = scene
    positions = run.read_npz("tracks.npz")["positions"]
    positions[:40, 3] = np.nan  # none inside the wrist's region: the body bridges
    positions[:, 6] = np.nan
    run.write_npz("tracks.npz", positions=positions)
    keypoints(run, file)
    trc = read_trc(run.path / "keypoints.trc", up="y")
    assert trc.names == ("wrist", "heel") and trc.fps == FPS
    np.testing.assert_allclose(trc.positions[:6], truth[:6], atol=1e-3)
    assert np.isnan(trc.positions[6]).all()
    marked = read_c3d(run.path / "keypoints.c3d")
    assert np.isnan(marked.residuals[6]).all()
    assert marked.residuals[3, 0] == 0 and marked.residuals[3, 1] > 0 and (marked.residuals[:3] > 0).all()
    assert run.read_npz("keypoints.npz")["bridged"][:, 0].nonzero()[0].tolist() == [3]


def test_files_come_back_as_they_were_written(tmp_path):
    points = (
        KeyPoint(name="left hand", center=(0.1, -2.0, 1e-4), radius=0.0125, frame=7),
        KeyPoint(name="ä", center=(0, 0, 0)),
    )
    file = KeyPointFile(links=(("ä", "left hand"),), keypoint=points)
    write_keypoints(tmp_path / "k.toml", file)
    assert read_keypoints(tmp_path / "k.toml") == file


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FILE.replace('"heel"', '"wrist"'), "the name wrist stands twice"),
        (
            FILE.replace('links = [["wrist", "heel"]]', 'links = [["wrist", "hand"]]'),
            "links name hand, but .* wrist, heel",
        ),
        (FILE.replace('links = [["wrist", "heel"]]', 'links = [["wrist", "wrist"]]'), "links join wrist with itself"),
        (FILE.replace('name = "heel"', 'name = " heel"'), r"keypoint\.1\.name"),
        (FILE.replace("radius = 0.05", "radius = -1", 1), r"keypoint\.0\.radius"),
        (FILE.replace("[0.1, 0.0, 0.0]", "[0.1, nan, 0.0]", 1), r"keypoint\.0\.center\.1"),
        (FILE.replace("radius", "size", 1), r"unknown setting keypoint\.0\.size; known .* name, center, radius, frame"),
        ("[[keypoint]", "not valid TOML"),
    ],
)
def test_wrong_files_are_named(tmp_path, text, said):
    (tmp_path / "k.toml").write_text(text)
    with pytest.raises(SettingsError, match=rf"k\.toml: .*{said}"):
        read_keypoints(tmp_path / "k.toml")


def test_run_without_trajectories(tmp_path):
    with pytest.raises(RunError, match=r"has no tracks\.npz"):
        keypoints(Run(tmp_path), KeyPointFile(keypoint=(KeyPoint(name="a", center=(0, 0, 0)),)))


def test_nodes_stand_in_where_bodies_were_found_from_them(scene):
    run, file, truth = scene
    positions = run.read_npz("tracks.npz")["positions"]
    (run.path / "tracks.npz").unlink()
    run.write_npz("diagnostics.npz", sample_positions=positions, paths=np.array("patches"))
    with pytest.raises(RunError, match=r"has no tracks\.npz"):
        keypoints(run, file)
    run.write_npz("diagnostics.npz", sample_positions=positions, paths=np.array("nodes"))
    np.testing.assert_allclose(keypoints(run, file).points.paths.positions, truth, atol=1e-5)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ((), "no key-points are given"),
        ((KeyPoint(name="toe", center=(9, 9, 9)),), r"key-point toe: no trajectory within 120 mm \(4 radii\)"),
        ((KeyPoint(name="toe", center=(0.1, 0, 0), frame=8),), "key-point toe: placed in frame 8, .* frames 0 to 7"),
    ],
)
def test_key_points_that_nothing_moves_are_named(scene, points, said):
    with pytest.raises(GeometryError, match=said):
        keypoints(scene[0], KeyPointFile(keypoint=points))
    assert not (scene[0].path / "keypoints.npz").exists()
