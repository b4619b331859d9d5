"""Key-points in the report: plots, pictures, and runs that have none or damaged ones."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from geomocap.errors import RunError
from geomocap.files.run import Run
from tests.viz.conftest import Made, make
from viz import review
from viz.keypoint_marks import BRIDGED, MEASURED, marks_of_run
from viz.keypoint_plots import overlay_sheet, paths, speeds
from viz.run_contents import Results
from viz.scene import stage

HEAD, HAND = 1, 3
FPS = 30.0


@pytest.fixture(scope="module")
def made_with_keypoints(tmp_path_factory) -> Made:
    made = make(tmp_path_factory.mktemp("keypoints"))
    positions = made.figure.ends[:, [HEAD, HAND]].copy()
    positions[4:, 1] = np.nan
    bridged = np.zeros((6, 2), bool)
    bridged[2:4, 1] = True
    made.run.write_npz(
        "keypoints.npz",
        names=np.array(["head", "hand"]),
        positions=positions,
        radius=np.array([0.05, 0.03]),
        bridged=bridged,
        velocities=np.gradient(positions, 1 / FPS, axis=0),
        links=np.array([[0, 1]]),
    )
    return made


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def test_a_run_without_key_points_has_no_marks(made: Made, tmp_path):
    assert Results(made.run).keypoints is None
    Run(tmp_path).write_npz("keypoints.npz", names=np.array(["a"]), positions=np.zeros((3, 1, 3)))
    with pytest.raises(RunError, match=r"keypoints\.npz: has no array radius"):
        _ = Results(Run(tmp_path)).keypoints


def test_plots_show_every_key_point(made_with_keypoints):
    results = Results(made_with_keypoints.run, made_with_keypoints.capture)
    marks = marks_of_run(results.keypoints)
    assert marks.names == ("head", "hand") and marks.states[:, 1].tolist() == [2, 2, 1, 1, 0, 0]
    for picture in (paths(marks, stage(results)), speeds(marks, np.ones((6, 2, 3)), FPS)):
        colors = {tuple(c) for c in pixels(picture).reshape(-1, 3).tolist()}
        assert {(0, 114, 178), (230, 130, 20)} <= colors  # the first two of the palette


def test_pictures_tell_measured_from_bridged(made_with_keypoints):
    results = Results(made_with_keypoints.run, made_with_keypoints.capture)
    marks = marks_of_run(results.keypoints)
    for frame, expected in ((0, {MEASURED}), (2, {MEASURED, BRIDGED}), (5, {MEASURED})):
        sheet = overlay_sheet(results, marks, [frame])
        colors = {tuple(c) for c in sheet[..., :3].reshape(-1, 3).tolist()}
        assert {MEASURED, BRIDGED} & colors == expected
    assert overlay_sheet(Results(made_with_keypoints.run), marks, [0]) is None


def test_the_report_has_a_section_on_key_points(made_with_keypoints, tmp_path):
    run = Run(tmp_path)
    for name in ("voxels/000000.ply", "keypoints.npz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((made_with_keypoints.run.path / name).read_bytes())
    files = review(run, made_with_keypoints.capture, frames=[0])
    assert {"keypoint_paths", "keypoint_speeds", "keypoints_overlay"} <= {f.stem for f in files}
    assert "Key-points over the pictures" in files[-1].read_text(encoding="utf-8")
