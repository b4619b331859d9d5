import sys

import numpy as np
import pytest

from geomocap.errors import RunError, SettingsError
from geomocap.export.bvh import read_bvh
from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.names import Names
from geomocap.export.run_export import FILES, ON_REQUEST, export_run
from geomocap.export.trc import read_trc
from geomocap.files.results import write_ellipsoids
from geomocap.files.run import Run
from tests.geomocap.articulated import shells_at, skeleton_arrays


@pytest.fixture
def run(tmp_path):
    run = Run(tmp_path / "run")
    run.write_npz("skeleton.npz", **skeleton_arrays())
    run.write_record({"source": {"up": "z"}})
    return run


def test_every_format_whose_package_is_there(run):
    pytest.importorskip("ezc3d"), pytest.importorskip("pxr"), pytest.importorskip("pyarrow")
    reports = []
    exported = export_run(run, progress=lambda *step: reports.append(step))
    assert set(exported.files) == set(FILES) - set(ON_REQUEST)
    assert all(file.stat().st_size > 100 for file in exported.files.values())
    assert exported.deviation_mm < 0.1
    assert exported.moving_joints == ()
    assert reports[-1] == ("export", 9, 9)
    assert not list(run.path.glob(".*.tmp*"))


def test_missing_packages_are_skipped_unless_asked_for(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    exported = export_run(run, settings=ExportSettings(bvh_unit="cm"))
    assert "c3d" not in exported.files
    assert exported.skipped["c3d"].endswith('pip install "geomocap[c3d]"')
    with pytest.raises(MotionError, match=r"geomocap\[c3d\]"):
        export_run(run, ["c3d"])


def test_only_what_was_asked_for_and_elsewhere(run, tmp_path):
    exported = export_run(run, ["bvh"], folder=tmp_path / "out")
    assert exported.files == {"bvh": tmp_path / "out" / "motion.bvh"}
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["motion.bvh"]
    with pytest.raises(MotionError, match="doc: no motion format; expected one of bvh, trc"):
        export_run(run, ["doc"])


def test_folders_may_be_given_as_text(run, tmp_path):
    exported = export_run(str(run.path), ["bvh"], folder=str(tmp_path / "out"))
    assert exported.files == {"bvh": tmp_path / "out" / "motion.bvh"} and exported.files["bvh"].is_file()
    assert export_run(run.path, ["bvh"]).files == {"bvh": run.path / "motion.bvh"}
    with pytest.raises(RunError):
        export_run(str(tmp_path / "none"))


def test_the_same_run_gives_the_same_files(run, tmp_path):
    chosen = ["bvh", "trc", "glb", "csv"]
    first = export_run(run, chosen, folder=tmp_path / "a").files
    second = export_run(run, chosen, folder=tmp_path / "b").files
    for name in chosen:
        assert first[name].read_bytes() == second[name].read_bytes()


def test_jumping_joints_are_named(run):
    run.write_npz("skeleton.npz", **skeleton_arrays(jump_mm=10))
    moving = export_run(run, ["bvh"])
    assert len(moving.moving_joints) == 6
    assert moving.deviation_mm < 1e-6
    fixed = export_run(run, ["bvh"], ExportSettings(joints="fixed"))
    assert fixed.moving_joints == ()
    assert fixed.deviation_mm > 10


def test_names_lie_in_the_run_or_are_given(run):
    (run.path / "names.toml").write_text("hip = 0\n")
    export_run(run, ["bvh"])
    assert "ROOT hip\n" in (run.path / "motion.bvh").read_text()
    export_run(run, ["bvh"], names=Names({0: "pelvis"}))
    assert "ROOT pelvis\n" in (run.path / "motion.bvh").read_text()


def test_key_points_and_ellipsoids_are_markers(run):
    run.write_npz("keypoints.npz", names=np.array(["hat"]), positions=np.zeros((20, 1, 3)), radius=np.array([0.1]))
    write_ellipsoids(run, shells_at(np.zeros((20, 2, 3)), [0, 1]))
    export_run(run, ["trc"])
    assert read_trc(run.path / "motion.trc").names[-3:] == ("hat", "ellipsoid000", "ellipsoid001")
    export_run(run, ["trc"], ExportSettings(ellipsoids=False))
    assert read_trc(run.path / "motion.trc").names[-1] == "hat"


def test_an_ellipsoid_without_points_is_no_marker(run):
    counts = np.full((20, 2), 30)
    counts[4:7, 1] = 0
    write_ellipsoids(run, shells_at(np.ones((20, 2, 3)), [0, 1], counts))
    export_run(run, ["trc"])
    positions = read_trc(run.path / "motion.trc").positions[:, -2:]
    np.testing.assert_array_equal(np.isfinite(positions).all(axis=-1), counts > 0)


def test_one_body_without_joints(tmp_path):
    run = Run(tmp_path)
    arrays = skeleton_arrays(n_bodies=1)
    run.write_npz("skeleton.npz", **arrays)
    exported = export_run(run, ["bvh", "trc", "glb", "csv"])
    assert len(exported.files) == 4
    assert read_trc(tmp_path / "motion.trc").names == ("body00",)
    write_ellipsoids(run, shells_at(np.zeros((20, 2, 3)), [0, 0], radius=3.5))
    export_run(run, ["bvh"])
    assert np.linalg.norm(read_bvh(tmp_path / "motion.bvh").tips[0]) == pytest.approx(3.5)


def test_up_is_the_captures(run):
    run.write_record({"source": {"up": "y"}})
    export_run(run, ["trc"], ExportSettings(trc_unit="m"))
    positions = skeleton_arrays()["joint_positions"]
    np.testing.assert_allclose(read_trc(run.path / "motion.trc").positions, positions, atol=1e-6)
    run.write_record({"source": {"up": "sideways"}})
    with pytest.raises(RunError, match=r"source\.up is 'sideways'; expected x, y or z"):
        export_run(run, ["trc"])


def test_settings_are_the_runs_unless_given(run):
    export_run(run, ["bvh"], ExportSettings(bvh_unit="cm"))
    centimetres = (run.path / "motion.bvh").read_bytes()
    export_run(run, ["bvh"])
    assert (run.path / "motion.bvh").read_bytes() != centimetres
    run.write_record({"source": {"up": "z"}, "config": {"export": {"bvh_unit": "cm"}}})
    export_run(run, ["bvh"])
    assert (run.path / "motion.bvh").read_bytes() == centimetres
    run.write_record({"source": {}, "config": {"export": {"bvh_unit": "mm"}}})
    with pytest.raises(SettingsError, match=r"run\.toml: setting bvh_unit = 'mm'"):
        export_run(run, ["bvh"])


def test_no_skeleton(tmp_path):
    with pytest.raises(RunError, match=r"skeleton.npz: missing"):
        export_run(Run(tmp_path))
