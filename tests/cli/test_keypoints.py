"""`geomocap keypoints`: from a TOML file to arrays and motion files, and what is said when it can't be."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.export.trc import read_trc
from geomocap.files.run import Run
from tests.cli.conftest import last_line
from tests.geomocap.articulated import skeleton_arrays

FILE = '[[keypoint]]\nname = "tip"\ncenter = [0.0, 0.0, 0.0]\nradius = 0.05\n'


@pytest.fixture
def run(tmp_path):
    made = Run(tmp_path / "run")
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3))
    made.write_npz("tracks.npz", positions=points[:, None] + np.arange(5)[None, :, None] * [0.01, 0, 0])
    made.write_record({"source": {"fps": 25.0}})
    (made.path / "keypoints.toml").write_text(FILE)
    return made


def test_key_points_of_the_run_or_of_another_file(geomocap, run, tmp_path):
    geomocap("keypoints", run.path)
    assert run.read_npz("keypoints.npz")["names"].tolist() == ["tip"]
    assert (run.path / "keypoints.trc").is_file() and (run.path / "keypoints.c3d").is_file()
    (tmp_path / "other.toml").write_text(FILE.replace("tip", "top"))
    geomocap("keypoints", run.path, "--points", tmp_path / "other.toml")
    np.testing.assert_allclose(run.read_npz("keypoints.npz")["positions"][:, 0, 0], np.arange(5) * 0.01, atol=1e-6)
    assert run.read_npz("keypoints.npz")["names"].tolist() == ["top"]


def test_motion_files_keep_the_run_s_settings(geomocap, run):
    run.write_npz("skeleton.npz", **skeleton_arrays(n_frames=5))
    run.write_record({"source": {"fps": 25.0}, "config": {"export": {"trc_unit": "m"}}})
    geomocap("keypoints", run.path)
    markers = read_trc(run.path / "motion.trc")
    assert "tip" in markers.names
    assert (run.path / "motion.trc").read_text().splitlines()[2].split()[4] == "m"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FILE * 2, "keypoints.toml: the name tip stands twice"),
        (FILE + 'colour = "red"\n', "keypoints.toml: unknown setting keypoint.0.colour"),
        ('links = [["tip", "toe"]]\n' + FILE, "links name toe, but no key-point is called so"),
        (FILE.replace("[0.0", "[7.0"), "key-point tip: no trajectory within 200 mm"),
        ("", "no key-points are given"),
    ],
)
def test_bad_files_end_with_one_line(geomocap, run, text, said):
    (run.path / "keypoints.toml").write_text(text)
    ended = geomocap("keypoints", run.path, check=False)
    assert ended.returncode == 1 and said in last_line(ended)


def test_missing_parts_are_named(geomocap, run, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert "geomocap[editor]" in last_line(geomocap("keypoints", run.path, "--edit", check=False))
    (run.path / "keypoints.toml").unlink()
    assert "or place them with --edit" in last_line(geomocap("keypoints", run.path, check=False))
    (run.path / "tracks.npz").unlink()
    assert "run `geomocap track CAPTURE" in last_line(geomocap("keypoints", run.path, "--edit", check=False))
