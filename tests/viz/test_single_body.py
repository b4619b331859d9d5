"""The report of a single rigid body, which has motion but no joint."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pygltflib
import pytest

from geomocap.files.run import Run
from tests.viz.conftest import rotation_x
from viz import review
from viz.quality_figures import assess, bones
from viz.run_contents import Results
from viz.scene import paths, stage
from viz.sections import bodies_table, key_figures, lead
from viz.shown_names import named
from viz.turntable import turntable

FRAMES, CENTER = 5, np.array([0.0, 0.3, 1.0])


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A beam that turns by ten degrees a frame."""
    run = Run(tmp_path_factory.mktemp("single"))
    (run.path / "bodies").mkdir()
    turns = np.array([rotation_x(np.radians(10 * t)) for t in range(FRAMES)])
    beam = np.random.default_rng(0).uniform(-1, 1, (600, 3)) * [0.05, 0.3, 0.05]
    for t in range(FRAMES):
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor((CENTER + beam @ turns[t].T).astype(np.float32)))
        cloud.point["body"] = o3d.core.Tensor(np.zeros((len(beam), 1), np.int32))
        o3d.t.io.write_point_cloud(str(run.frame_file("bodies", t)), cloud)
    run.write_npz(
        "skeleton.npz",
        joint_positions=np.zeros((FRAMES, 0, 3)),
        joint_bodies=np.zeros((0, 2), np.int32),
        joint_names=np.zeros(0, "<U20"),
        body_rotations=turns[:, None],
        body_positions=np.tile(CENTER, (FRAMES, 1, 1)),
        fps=25.0,
    )
    run.write_npz("diagnostics.npz", joint_is_hinge=np.zeros(0, bool), joint_axes=np.zeros((0, 3)))
    return run


def test_a_single_body_turns_in_its_report(single: Run) -> None:
    results = Results(single)
    turns = turntable(results, stage(results))
    assert turns is not None
    data = json.loads(turns.data)
    assert [n["name"] for n in data["nodes"]] == ["body00"] and data["fps"] == 25
    document = pygltflib.GLTF2.load_from_bytes(base64.b64decode(turns.glb))
    assert document is not None and document.accessors[document.animations[0].samplers[0].input].count == FRAMES


def test_a_single_body_has_its_motion_rate_and_duration_in_the_page(single: Run) -> None:
    files = review(single, quick=True)
    page = files[-1].read_text(encoding="utf-8")
    assert "has no skeleton" not in page and "one rigid body, so it has no joints" in page
    assert '<script type="application/json"' in page and "motion" in {f.stem for f in files if f.suffix == ".png"}
    figures = {label: value for value, label in key_figures(Results(single))}
    assert figures["frames per second"] == "25" and figures["recorded"] == "0.2 s" and "joints" not in figures
    assert lead(Results(single)) == "From a sequence of geometry to 1 rigid body, without a body model."


def test_what_needs_joints_is_left_out_of_a_single_body(single: Run) -> None:
    results = Results(single)
    assert results.skeleton is not None and not bones(results.skeleton)
    assert not len(paths(results, 1.0).faces)
    assert not [w for w in assess(results, [0]).warnings if "joint" in w]


def test_bodies_are_called_as_in_the_files_without_names_and_without_skeleton(single: Run, tmp_path: Path) -> None:
    (tmp_path / "bodies").symlink_to(single.path / "bodies")
    for results in (Results(single), named(Results(single)), Results(Run(tmp_path))):
        assert [row[0] for row in bodies_table(results, 0).rows] == ["body00"]
