"""Key-points from a TOML file, followed through a run's trajectories."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.errors import RunError, SettingsError
from geomocap.pipeline.keypoints import keypoints, read_keypoints
from geomocap.run import Run

FILE = """
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


def test_keypoints_move_with_the_surface_around_them(tmp_path):
    rng = np.random.default_rng(0)
    places = np.concatenate(
        [[0.1, 0, 0] + rng.normal(size=(40, 3)) * 0.02, [-0.1, 0, 0.3] + rng.normal(size=(40, 3)) * 0.02]
    )
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 1, 8), [0.2, 0.5, -0.3])).as_matrix()
    shifts = np.outer(np.linspace(0, 1, 8), [0.3, -0.1, 0.2])
    positions = np.einsum("tij,nj->nti", turns, places) + shifts
    heel = turns[4] @ [-0.1, 0, 0.3] + shifts[4]
    run = Run(tmp_path)
    run.write_npz("tracks.npz", positions=positions)
    (tmp_path / "k.toml").write_text(FILE.replace("[-0.1, 0.0, 0.3]", str(heel.tolist())))
    keypoints(run, read_keypoints(tmp_path / "k.toml"))
    saved = run.read_npz("keypoints.npz")
    assert saved["names"].tolist() == ["wrist", "heel"] and saved["radius"].tolist() == [0.05, 0.05]
    truth = np.einsum("tij,kj->tki", turns, [[0.1, 0, 0], [-0.1, 0, 0.3]]) + shifts[:, None]
    np.testing.assert_allclose(saved["positions"], truth, atol=1e-5)  # the robust fit weighs, and is regular


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FILE.replace("heel", "wrist"), "the name wrist stands twice"),
        (FILE.replace("radius = 0.05", "radius = -1", 1), r"keypoint\.0\.radius"),
        (FILE.replace("radius", "size", 1), r"unknown setting keypoint\.0\.size"),
        ("", "keypoint"),
    ],
)
def test_wrong_files_are_named(tmp_path, text, said):
    (tmp_path / "k.toml").write_text(text)
    with pytest.raises(SettingsError, match=said):
        read_keypoints(tmp_path / "k.toml")


def test_run_without_trajectories(tmp_path):
    (tmp_path / "k.toml").write_text(FILE)
    with pytest.raises(RunError, match=r"has no tracks\.npz"):
        keypoints(Run(tmp_path), read_keypoints(tmp_path / "k.toml"))
