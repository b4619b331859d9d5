"""What the report says about how bodies were told apart."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geomocap.files.results import read_diagnostics, write_diagnostics
from geomocap.files.run import Run
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.palette import body_colors
from tests.viz.conftest import LIMBS, Made
from viz import review
from viz.run_contents import Results
from viz.scene import stage
from viz.separation import alternatives_sheet, joints_table


@pytest.fixture
def followed(made: Made, tmp_path: Path) -> Run:
    """A copy of the run with what the method of motion paths leaves behind."""
    run = Run(tmp_path / "run")
    shutil.copytree(made.run.path, run.path)
    shutil.rmtree(run.path / "review", ignore_errors=True)
    points, bodies = zip(*(made.figure.points(t, 60) for t in range(6)), strict=True)
    fewer = np.minimum(bodies[0], 3)
    J = len(LIMBS) - 1
    run.write_npz(
        "diagnostics.npz",
        paths=np.array("patches"),
        sample_positions=np.stack(points, axis=1),
        sample_body=bodies[0],
        reliability=np.full((6, len(LIMBS)), 0.7),
        joint_is_hinge=np.arange(J) == 2,
        joint_axes=np.tile([0.0, 0.6, 0.8], (J, 1)),
        joint_std=np.full((J, 3), 0.002),
        curve_bodies=np.array([13, 12, 11, 10]),
        curve_strengths=np.array([0.2, 0.4, 0.8, 2.5]),
        alternative_labels=np.stack([bodies[0], fewer]),
    )
    return run


def test_alternatives_show_other_numbers_of_bodies_only(followed: Run) -> None:
    results = Results(followed)
    found = results.diagnostics
    both = alternatives_sheet(results, stage(results))
    write_diagnostics(followed, replace(found, alternative_labels=found.alternative_labels[:1]))
    single = alternatives_sheet(Results(followed), stage(results))
    assert both is not None and single is not None
    assert both.shape[1] > 1.8 * single.shape[1]  # the alternative with as many bodies is not drawn again
    unlike = body_colors(np.array([7]))[0]  # a body that only the finer of the two has
    hits = np.abs(both[..., :3].astype(int) - unlike).max(axis=2) < 12
    half = both.shape[1] // 2
    assert hits[:, :half].sum() > 0
    assert hits[:, half:].sum() < 0.2 * hits[:, :half].sum()


def test_joints_table_tells_hinges_with_their_axes(followed: Run) -> None:
    block = joints_table(Results(followed))
    assert block is not None
    kinds = [row[2] for row in block.rows]
    assert kinds.count("hinge") == 1 and kinds[2] == "hinge"
    assert block.rows[2][3] == "0.00, 0.60, 0.80" and block.rows[0][3] == ""
    assert block.rows[0][4] == "3.5"  # |(2, 2, 2)| mm


def test_joints_of_a_known_model_have_no_standard_deviations(followed: Run) -> None:
    found = read_diagnostics(followed)
    kinds = Diagnostics("model", joint_is_hinge=found.joint_is_hinge, joint_axes=found.joint_axes)
    write_diagnostics(followed, replace(kinds, fit_distance=np.full(6, 0.01)))
    block = joints_table(Results(followed))
    assert block is not None and block.rows[2][2:] == ("hinge", "0.00, 0.60, 0.80", "")


def test_report_has_the_section_where_motion_was_followed(followed: Run) -> None:
    page = review(followed, frames=[0], quick=True)[-1].read_text(encoding="utf-8")
    assert "How the bodies were told apart" in page and "600 patches of the images" in page and "hinge" in page
