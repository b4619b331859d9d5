"""Runs: atomic files, stages that know when they are out of date."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from geomocap.config import load_config
from geomocap.errors import RunError, SettingsError
from geomocap.files.atomic import write_atomic, write_text
from geomocap.files.frame_files import read_voxels, write_voxels
from geomocap.files.run import Run, stage_key
from geomocap.files.run_records import source_path, source_places
from geomocap.model.frame_geometry import Voxels

HERE = "geomocap.files.run"


def test_interrupted_writing_leaves_nothing(tmp_path):
    def interrupted(path):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomic(tmp_path / "a" / "x.bin", interrupted)
    assert list((tmp_path / "a").iterdir()) == []


def test_failed_writing_keeps_the_old_file_and_says_why(tmp_path):
    write_text(tmp_path / "x.txt", "old")

    def full(path):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(RunError, match=r"x\.txt: can't be written \(No space left on device\)"):
        write_atomic(tmp_path / "x.txt", full)
    assert (tmp_path / "x.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["x.txt"]


def test_writer_that_silently_writes_nothing_is_noticed(tmp_path):
    with pytest.raises(RunError, match="could not be written whole"):
        write_atomic(tmp_path / "x.ply", lambda path: False)


def test_stage_is_cleared_when_its_key_changes(tmp_path):
    run = Run(tmp_path)
    run.begin("voxels", "key1", ["voxels", "skeleton.npz"])
    write_text(run.frame_file("voxels", 0), "a")
    run.write_npz("skeleton.npz", x=np.arange(3))
    assert not run.is_done("voxels", "key1")
    run.finish("voxels")
    assert run.is_done("voxels", "key1") and not run.is_done("voxels", "key2")
    run.begin("voxels", "key1", ["voxels", "skeleton.npz"])
    assert run.frames("voxels") == [0]
    run.begin("voxels", "key2", ["voxels", "skeleton.npz"])
    assert run.frames("voxels") == [] and not (tmp_path / "skeleton.npz").exists()


def test_stage_with_a_deleted_output_is_not_done(tmp_path):
    run = Run(tmp_path)
    run.begin("skeleton", "key", ["skeleton.npz"])
    run.write_npz("skeleton.npz", x=np.arange(3))
    run.finish("skeleton")
    (tmp_path / "skeleton.npz").unlink()
    assert not run.is_done("skeleton", "key")


def test_key_depends_on_everything():
    keys = {
        stage_key(HERE, "a", {"x": 1}),
        stage_key(HERE, "a", {"x": 2}),
        stage_key(HERE, "b", {"x": 1}),
        stage_key(HERE, "a", {"x": 1}, "up"),
    }
    assert len(keys) == 4
    assert stage_key(HERE, "a", {"x": 1, "y": 2}) == stage_key(HERE, "a", {"y": 2, "x": 1})


def test_of_an_npz_file_what_is_named_is_read(tmp_path):
    run = Run(tmp_path)
    run.write_npz("some.npz", x=np.arange(3), y=np.arange(4))
    assert set(run.read_npz("some.npz")) == {"x", "y"}
    assert set(run.read_npz("some.npz", ("y", "z"))) == {"y"}


def test_npz_is_never_executed(tmp_path):
    run = Run(tmp_path)
    np.savez(tmp_path / "bad.npz", x=np.array([{"a": 1}], dtype=object))
    with pytest.raises(RunError, match=r"bad\.npz: damaged"):
        run.read_npz("bad.npz")
    with pytest.raises(RunError, match="is no plain array"):
        run.write_npz("x.npz", x=np.array([None]))
    with pytest.raises(RunError, match="missing"):
        run.read_npz("none.npz")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("= =", "not valid TOML"),
        ("source = 3", "source is no table"),
        ("[source]\nfps = true", "source.fps is True; expected a number above 0"),
        ("[source]\nup = ['z']", r"source.up is \['z'\]; expected x, y or z"),
        ('[source]\npath = "a\\u0000b"', "source.path is .*expected a path"),
    ],
)
def test_a_record_that_no_run_wrote_is_refused(tmp_path, text, says):
    (tmp_path / "run.toml").write_text(text)
    with pytest.raises(RunError, match=rf"run\.toml: {says}.*; delete it and run again"):
        Run(tmp_path).read_record()


def test_a_record_cut_anywhere_is_refused(tmp_path):
    run = Run(tmp_path)
    run.write_record(
        {
            "geomocap": {"version": "1"},
            "source": {"fps": 30.0, "up": "z"},
            "config": {"tracking": {"blurs_px": [2.5, 0.8], "n_patches": 4000}},
            "versions": {"python": "3.11", "numpy": "2.4"},
        }
    )
    whole = run.read_record()
    file = tmp_path / "run.toml"
    data = file.read_bytes()
    for length in range(len(data) - 1):  # the last line's end is no loss
        file.write_bytes(data[:length])
        with pytest.raises(RunError, match=r"run\.toml: (cut off, it has|not valid TOML)"):
            run.read_record()
        assert run.faults() == {"run.toml": f"cut ({length} of {len(data)} bytes)"}
    file.write_bytes(data)
    assert run.read_record() == whole and run.faults() == {}


def test_the_source_is_found_from_anywhere_and_where_it_was_moved_with_the_run(tmp_path, monkeypatch):
    capture, run = tmp_path / "a" / "capture", tmp_path / "a" / "runs" / "one"
    capture.mkdir(parents=True)
    run.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    told = source_places(run, Path("a/capture"))
    assert told == {"path": str(capture), "from_run": "../../capture"}
    monkeypatch.chdir("/")
    assert source_path(run, told) == capture
    assert source_path(run, {"path": "a/capture"}) == capture  # as older runs say it
    (tmp_path / "a").rename(tmp_path / "b")
    moved = tmp_path / "b" / "runs" / "one"
    assert source_path(moved, told).resolve() == tmp_path / "b" / "capture"
    (tmp_path / "b" / "capture").rmdir()
    assert source_path(moved, told) == capture  # named in what is said of it


def test_settings_of_a_record_that_is_cut_off_are_refused(tmp_path):
    Run(tmp_path).write_record({"config": {"carving": {"resolution": 64, "margin": 0.1}}, "versions": {"a": "1"}})
    file = tmp_path / "run.toml"
    assert load_config(file).carving.resolution == 64
    file.write_text(file.read_text().replace("resolution = 64", "resolution = 65"))  # as a user may
    assert load_config(file).carving.resolution == 65
    file.write_text(file.read_text().replace("margin = 0.1\n", ""))
    with pytest.raises(SettingsError, match=r"run\.toml: cut off, it has 3 of the 4 values"):
        load_config(file)


def test_pipes_in_place_of_records_are_not_waited_for(tmp_path):
    (tmp_path / ".stages").mkdir()
    for name in ("run.toml", "timings.json", ".stages/a.json", ".stages/a.journal"):
        os.mkfifo(tmp_path / name)
    run = Run(tmp_path)
    with pytest.raises(RunError, match="it is a pipe or a device"):
        run.read_record()
    assert run.read_timings() == {} and run.faults() == {} and run.unfinished() == ["a"]


def test_timings_add_up(tmp_path):
    run = Run(tmp_path)
    with run.timed("a") as count:
        count["items"] = 3
    with run.timed("b"):
        pass  # nothing to do: no entry
    timings = run.read_timings()
    assert set(timings) == {"a"} and timings["a"]["items"] == 3


def test_voxels_survive_open3d_s_file(tmp_path):
    rng = np.random.default_rng(0)
    indices = np.unique(rng.integers(0, 60, (2000, 3)).astype(np.int32), axis=0)
    colors = rng.integers(0, 256, (len(indices), 3)).astype(np.uint8)
    voxels = Voxels(indices, colors, np.array([-1.0, 0.3, 0.7]), 0.0078125)
    write_voxels(tmp_path / "000000.ply", voxels)
    back = read_voxels(tmp_path / "000000.ply")
    np.testing.assert_array_equal(back.indices, voxels.indices)
    np.testing.assert_array_equal(back.colors, voxels.colors)
    np.testing.assert_allclose(back.points, voxels.points, atol=1e-9)
    slow = Voxels.from_open3d(o3d.io.read_voxel_grid(str(tmp_path / "000000.ply")))
    np.testing.assert_array_equal(back.indices, slow.indices)
    np.testing.assert_array_equal(back.colors, slow.colors)
    o3d.io.write_voxel_grid(str(tmp_path / "ascii.ply"), voxels.to_open3d(), write_ascii=True)
    np.testing.assert_array_equal(read_voxels(tmp_path / "ascii.ply").indices, voxels.indices)


@pytest.mark.parametrize("inside", ["", "further/in"])
def test_a_file_in_place_of_the_folder_is_named(tmp_path, inside):
    file = tmp_path / "afile"
    file.touch()
    with pytest.raises(RunError, match=rf"can't be written \({file} is a file, a folder is expected\)"):
        Run(file / inside).write_record({})
