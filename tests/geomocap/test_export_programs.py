"""Files for other programs: movement's datasets, FBX by Blender."""

import stat
import sys

import numpy as np
import pytest

from geomocap.export.export_errors import MissingPackageError, MotionError
from geomocap.export.fbx import write_fbx
from geomocap.export.run_export import export_run
from geomocap.files.run import Run
from tests.geomocap.articulated import skeleton_arrays


@pytest.fixture
def run(tmp_path):
    run = Run(tmp_path / "run")
    run.write_npz("skeleton.npz", **skeleton_arrays())
    run.write_record({"source": {"up": "z"}})
    return run


def test_movement_dataset_holds_the_joints(run):
    xarray = pytest.importorskip("xarray")
    file = export_run(run, ["movement"]).files["movement"]
    with xarray.open_dataset(file, engine="scipy") as dataset:
        assert dataset.position.dims == ("time", "space", "keypoints", "individuals")
        assert dataset.attrs["ds_type"] == "poses"
        assert float(dataset.time[1]) == pytest.approx(1 / 15)
        positions = dataset.position.isel(individuals=0).transpose("time", "keypoints", "space").values
    joints = skeleton_arrays()["joint_positions"]
    assert np.abs(positions[:, : joints.shape[1]] - joints).max() < 1e-12


def test_without_xarray_a_line_says_what_to_install(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingPackageError, match=r"geomocap\[movement\]"):
        export_run(run, ["movement"])


def test_without_blender_a_line_says_so(run, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "bpy", None)
    monkeypatch.setattr("geomocap.export.fbx.find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match="Blender"):
        export_run(run, ["fbx"])


@pytest.mark.parametrize("works", [True, False])
def test_blender_is_given_the_files_and_its_failure_is_told(tmp_path, monkeypatch, works):
    """Stands in for Blender: copies the file before the last but one of its arguments, or fails."""
    program = tmp_path / "bin" / "blender"
    program.parent.mkdir()
    fail = "" if works else "printf 'Traceback\\nImportError: no add-on\\nsee its pages' >&2; exit 1\n"
    program.write_text(f'#!/bin/sh\n{fail}while [ $# -gt 3 ]; do shift; done\n/bin/cp "$1" "$2"\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(program.parent))
    glb = tmp_path / "motion.glb"
    glb.write_bytes(b"glTF")
    if works:
        write_fbx(tmp_path / "motion.fbx", glb, 25.0)
        assert (tmp_path / "motion.fbx").read_bytes() == b"glTF"
    else:
        with pytest.raises(MotionError, match=r"^motion\.fbx: Blender could not write it \(ImportError: no add-on\)"):
            write_fbx(tmp_path / "motion.fbx", glb, 25.0)
        assert not list(tmp_path.glob("*fbx"))
