"""The record of a run: what each command leaves of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geomocap.config import Config, load_config
from geomocap.errors import CalibrationError
from geomocap.files.atomic import write_text
from geomocap.files.capture import Capture
from geomocap.files.run import Run
from geomocap.files.scan_settings import ScanSettings
from geomocap.files.scans import open_scans
from geomocap.pipeline import Job, silhouettes
from geomocap.pipeline import voxels as carve
from geomocap.scheduling import threads
from tests.geomocap.test_pipeline_clouds import make_capture

WHOLE = {
    "segmentation": {"method": "m3"},
    "export": {"bvh_unit": "cm"},
    "carving": {"resolution": 99},
    "silhouettes": {"samples": 7},
}


@pytest.fixture
def job(tmp_path):
    """Make a job on a capture in one and the same run folder."""

    def make(config: Config, name: str = "capture", model: Path | None = None) -> Job:
        path = tmp_path / name
        capture = make_capture(path, masks=True)
        return Job(Run(tmp_path / "run"), config, executor, capture=capture, fps=capture.fps, model=model)

    with threads(1) as executor:
        yield make


def test_a_stage_records_its_own_settings_and_leaves_the_others(job, tmp_path):
    job(load_config(overrides=WHOLE), model=tmp_path / "model.npz").write_record()
    stage = job(Config())
    silhouettes(stage)
    record = stage.run.read_record()
    assert record["source"]["model"] == str(tmp_path / "model.npz")
    assert record["config"]["segmentation"]["method"] == "m3"
    assert record["config"]["export"]["bvh_unit"] == "cm"
    assert record["config"]["carving"]["resolution"] == 99
    assert record["config"]["silhouettes"] == Config().silhouettes.model_dump(mode="json", exclude_none=True)


def test_the_whole_record_is_set_anew(job, tmp_path):
    job(load_config(overrides=WHOLE), model=tmp_path / "model.npz").write_record()
    whole = job(Config())
    whole.write_record()
    record = whole.run.read_record()
    assert "model" not in record["source"]
    assert record["config"] == Config().model_dump(mode="json", exclude_none=True)


def test_nothing_is_left_of_another_source(job, tmp_path):
    job(load_config(overrides=WHOLE), model=tmp_path / "model.npz").write_record()
    other = job(Config(), "other")
    silhouettes(other)
    record = other.run.read_record()
    assert record["source"]["path"] == str(tmp_path / "other") and "model" not in record["source"]
    assert record["config"] == Config().model_dump(mode="json", exclude_none=True)


@pytest.fixture
def used(job, tmp_path):
    """A run of a capture, with results of later stages, files of commands, and some of a killed stage."""
    first = job(load_config(overrides=WHOLE))
    first.write_record()
    silhouettes(first)
    run = first.run
    for stage, names in {
        "check": ("check.json",),
        "tracks": ("tracks.npz",),
        "windows": ("windows/000000/a.npz",),
    }.items():
        run.begin(stage, "key", [])
        for name in names:
            write_text(run.path / name, "old")
        run.finish(stage, names)
    write_text(run.path / "motion.csv", "old")
    run.renew("export", [run.path / "motion.csv"])
    run.begin("segmentation", "key", ["skeleton.npz"])
    for name in ("skeleton.npz", "model.npz", "timings.json"):
        write_text(run.path / name, "old")
    for name in ("names.toml", "notes.txt", "motion.blend", "silhouettes/letter.txt"):
        write_text(run.path / name, "mine")
    return run


def files_of(run: Run) -> set[str]:
    found = {p.relative_to(run.path).as_posix() for p in run.path.rglob("*") if p.is_file()}
    return {name for name in found if not name.startswith(".stages/")}


def test_results_of_another_capture_are_removed_and_the_users_files_stay(job, used):
    told: list[str] = []
    other = replace(job(Config(), "other"), tell=told.append)
    cameras = [f"silhouettes/{c}/000000.png" for c in other.capture.cameras]
    silhouettes(other)
    mine = {"names.toml", "notes.txt", "motion.blend", "silhouettes/letter.txt"}
    corrected = {"correction.json"}
    assert files_of(used) - corrected - mine - {"timings.json"} == {"run.toml", *cameras}
    assert all((used.path / name).read_text() == "mine" for name in mine)
    assert used.faults() == {} and used.unfinished() == [] and "check" not in used.read_timings()
    assert len(told) == 1 and "results of capture" in told[0] and "removed; names.toml stays" in told[0]
    silhouettes(other)
    assert len(told) == 1


def test_of_scans_no_result_of_a_capture_is_left(used, tmp_path):
    np.save(tmp_path / "scans.npy", np.random.default_rng(0).normal(size=(2, 9, 3)))
    scans = open_scans(tmp_path / "scans.npy", ScanSettings())
    Job(used, Config(), None, scans=scans).write_record()
    assert files_of(used) == {"run.toml", "names.toml", "notes.txt", "motion.blend", "silhouettes/letter.txt"}


def test_results_of_the_same_source_stay_where_both_are_moved(job, used, tmp_path):
    before = files_of(used)
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("capture", "run"):
        (tmp_path / name).rename(moved / name)
    told: list[str] = []
    capture = Capture.open(moved / "capture")
    Job(Run(moved / "run"), Config(), None, capture=capture, fps=capture.fps, tell=told.append).write_record()
    assert files_of(Run(moved / "run")) == before and told == []


def test_what_is_read_from_the_run_itself_stays(used, tmp_path):
    np.save(used.path / "scans.npy", np.random.default_rng(0).normal(size=(2, 9, 3)))
    before = files_of(used)
    Job(used, Config(), None, scans=open_scans(used.path / "scans.npy", ScanSettings())).write_record()
    np.save(tmp_path / "scans.npy", np.zeros((2, 9, 3)))
    scans = open_scans(tmp_path / "scans.npy", ScanSettings())
    Job(used, Config(), None, scans=scans, model=used.path / "model.npz").write_record()
    assert files_of(used) == before


def test_a_stage_that_does_not_begin_leaves_the_record(job):
    whole = job(load_config(overrides=WHOLE))
    whole.write_record()
    before = (whole.run.path / "run.toml").read_text()
    assert whole.capture is not None
    for file in (whole.capture.path / "sparse").iterdir():
        file.unlink()
    stage = Job(whole.run, Config(), whole.executor, capture=type(whole.capture).open(whole.capture.path))
    with pytest.raises(CalibrationError):
        carve(stage)
    assert (whole.run.path / "run.toml").read_text() == before
