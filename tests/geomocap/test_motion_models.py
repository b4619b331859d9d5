"""Which of several motions explains a recording best, and its refinement by silhouettes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from geomocap.config import Config
from geomocap.errors import GeometryError
from geomocap.files.run import Run
from geomocap.pipeline import motion_models
from geomocap.pipeline.job import Job
from geomocap.skeleton.motion_skeleton_settings import RefinementSettings


def test_silhouettes_and_paths_both_speak_against_a_motion():
    def of(overlap: float, residuals: list[float]) -> float:
        return motion_models.misfit(SimpleNamespace(bodies=SimpleNamespace(residuals=np.array(residuals))), overlap)

    assert of(0.95, [0.01, 0.02]) < of(0.90, [0.01, 0.02])
    assert of(0.90, [0.01, 0.01]) < of(0.90, [0.01, 0.03])
    assert of(0.938, [0.009]) < of(0.943, [0.016])  # a horse's trunk, by patches and by nodes that slide
    assert of(0.937, [0.016]) < of(0.908, [0.011])  # plain legs that patches lose
    smaller = of(0.9, [1e-5]) / of(0.95, [3e-5])  # the same in other units
    assert smaller == pytest.approx(of(0.9, [0.01]) / of(0.95, [0.03]))


@pytest.mark.parametrize("refinement", [{"outline_rounds": 0}, {"rounds": 0}])
def test_refinement_by_outlines_can_be_left_out(tmp_path, monkeypatch, refinement):
    monkeypatch.setattr(motion_models, "outline_points_of", lambda _: pytest.fail("read"))
    config = Config(refinement=RefinementSettings(**refinement))
    job, model, motion = Job(Run(tmp_path), config, None, capture=object(), fps=30.0), object(), object()
    assert motion_models.fitted_to_outlines(job, motion, model, None) == (motion, model)


def test_a_model_without_a_surface_stays_as_it_was(tmp_path, monkeypatch):
    def no_surface(*_, **__):
        raise GeometryError("no surface could be laid through the points")

    monkeypatch.setattr(motion_models, "outline_points_of", lambda _: object())
    monkeypatch.setattr(motion_models, "fit_to_outlines", no_surface)
    job, model, motion = Job(Run(tmp_path), Config(), None, capture=object(), fps=30.0), object(), object()
    assert motion_models.fitted_to_outlines(job, motion, model, None) == (motion, model)


def test_scans_have_no_outlines(tmp_path):
    model, motion = object(), object()
    job = Job(Run(tmp_path), Config(), None)
    assert motion_models.fitted_to_outlines(job, motion, model, None) == (motion, model)


def test_bodies_that_no_path_shows_for_long_are_named():
    reliability = np.ones((20, 3))
    motion = SimpleNamespace(bodies=SimpleNamespace(reliability=reliability))
    reliability[3:5, 0] = 0  # a tenth of the frames
    assert motion_models.unseen_bodies(motion) == []
    reliability[1:8, 1:] = 0
    reliability[8, 2] = 0
    said = motion_models.unseen_bodies(motion)
    assert len(said) == 1 and said[0].startswith("No path shows body01 in 7, body02 in 8 of 20 frames:")
