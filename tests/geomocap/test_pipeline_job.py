"""The record of a run: what each command leaves of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from geomocap.config import Config, load_config
from geomocap.errors import CalibrationError
from geomocap.files.run import Run
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
