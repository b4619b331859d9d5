"""Bodies that no path shows in some frames: when the model is fitted to the surface."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from geomocap.config import Config
from geomocap.files.run import Run
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.rotations import turn_angles
from geomocap.pipeline import motion_models
from geomocap.pipeline.following_stage import model_skeleton
from geomocap.pipeline.job import Job
from geomocap.scheduling import threads
from geomocap.skeleton.kinematics import BodyMotion, body_motion, joint_motion
from tests.geomocap.test_subject_following import SPACING, model, sequence_of

__all__ = ["model"]  # the fixture

UNSEEN = slice(0, 7)  # frames in which nothing follows the arm


@dataclass(frozen=True)
class Surfaces:
    """Geometry of given points."""

    places: list[np.ndarray]
    spacing: float = SPACING
    features: None = None

    def __len__(self) -> int:
        return len(self.places)

    def points(self, frame: int) -> np.ndarray:
        return self.places[frame]


class Case:
    """A run with a model whose arm was found to wait while nothing followed it."""

    def __init__(self, model, folder, executor):
        self.true, places = sequence_of(model)
        root = np.einsum("tij,j->ti", self.true.rotations[:, 0], model.linkage.origin) + self.true.translations[:, 0]
        start = joint_motion(model.linkage, self.true.rotations, root)
        start.local[UNSEEN, 1] = start.local[UNSEEN.stop, 1]
        self.found = found = body_motion(model.linkage, start)
        self.job = Job(Run(folder), Config(), executor, capture=object(), fps=30.0)
        self.model = model.reposed(found, 0)
        reliability = np.ones((len(places), 3))
        reliability[UNSEEN, 1] = 0.0
        skeleton = model_skeleton(model, found, 30.0)
        self.motion = SimpleNamespace(bodies=SimpleNamespace(reliability=reliability), skeleton=skeleton)
        self.geometry = Surfaces(list(places))
        trunk = np.arange(0, int((model.skin.body == 0).sum()), 10)
        sigma = np.full((len(trunk), len(places)), 0.002)
        self.paths = MotionPaths(places[:, trunk].swapaxes(0, 1), sigma=sigma)

    def fit(self) -> BodyMotion | None:
        fit = motion_models.fitted_to_surfaces(self.job, self.geometry, self.model, self.motion, self.paths)
        assert fit is None or fit[1] == UNSEEN.stop
        return None if fit is None else fit[0]

    def error_deg(self, bodies: BodyMotion) -> float:
        """Greatest error of the arm's turn since the last frame, degrees."""
        found, true = bodies.rotations[:, 1], self.true.rotations[:, 1]
        since = [r @ r[-1].T for r in (found, true)]
        return float(np.rad2deg(turn_angles(np.swapaxes(since[0], 1, 2) @ since[1])).max())


@pytest.fixture
def case(model, tmp_path):
    with threads(1) as executor:
        yield Case(model, tmp_path, executor)


def overlaps(monkeypatch, before: float, after: float) -> None:
    """Let the models of the motion found and of the fit overlap the silhouettes so much."""
    values = iter((before, after))
    monkeypatch.setattr(motion_models.SeenOutlines, "of", lambda *_: None)
    monkeypatch.setattr(motion_models, "model_overlap", lambda *_: next(values))


def test_a_fit_that_explains_more_takes_the_place_of_what_was_found(case, monkeypatch):
    overlaps(monkeypatch, 0.70, 0.75)
    assert case.error_deg(case.found) > 20.0
    fit = case.fit()
    assert fit is not None and case.error_deg(fit) < 5.0


def test_a_fit_that_explains_hardly_more_changes_nothing(case, monkeypatch):
    overlaps(monkeypatch, 0.700, 0.705)
    assert case.fit() is None


def test_where_paths_show_all_bodies_nothing_is_fitted(case, monkeypatch):
    monkeypatch.setattr(motion_models, "fit_motion", lambda *_: pytest.fail("fitted"))
    overlaps(monkeypatch, 0.70, 0.75)
    case.motion.bodies.reliability[:] = 0.5
    assert case.fit() is None


def test_a_frame_with_next_to_nothing_leaves_the_motion_as_it_was(case, monkeypatch):
    overlaps(monkeypatch, 0.70, 0.75)
    case.geometry.places[3] = np.zeros((2, 3))
    assert case.fit() is None


def test_silhouettes_and_paths_both_speak_against_a_motion():
    def of(overlap: float, residuals: list[float]) -> float:
        return motion_models.misfit(SimpleNamespace(bodies=SimpleNamespace(residuals=np.array(residuals))), overlap)

    assert of(0.95, [0.01, 0.02]) < of(0.90, [0.01, 0.02])
    assert of(0.90, [0.01, 0.01]) < of(0.90, [0.01, 0.03])
    assert of(0.938, [0.009]) < of(0.943, [0.016])  # a horse's trunk, by patches and by nodes that slide
    assert of(0.937, [0.016]) < of(0.908, [0.011])  # plain legs that patches lose
    smaller = of(0.9, [1e-5]) / of(0.95, [3e-5])  # the same in other units
    assert smaller == pytest.approx(of(0.9, [0.01]) / of(0.95, [0.03]))


def test_frames_that_paths_show_stay_as_they_were_found(case, monkeypatch):
    overlaps(monkeypatch, 0.70, 0.75)
    fit = case.fit()
    beyond = slice(UNSEEN.stop + motion_models._GOING_OVER, None)  # before, the fit goes over into what was found
    turns, expected = (m.rotations @ np.swapaxes(m.rotations[-1:], 2, 3) for m in (fit, case.found))  # since the last
    np.testing.assert_allclose(turns[beyond], expected[beyond], atol=1e-9)


def test_stretches_hold_what_is_between_them_where_it_is_short():
    def of(*marked: int) -> list[range]:
        return motion_models._stretches(np.isin(np.arange(40), marked))

    assert of() == []
    assert of(0, 1, 5, 39) == [range(0, 6), range(39, 40)]
    assert of(10, 17) == [range(10, 11), range(17, 18)] and of(10, 16) == [range(10, 17)]


def test_part_of_paths_leaves_out_samples_that_it_does_not_show():
    positions = np.random.default_rng(0).normal(size=(3, 6, 3))
    positions[1, :3] = np.nan
    turns = np.broadcast_to(np.eye(3), (3, 6, 3, 3))
    whole = MotionPaths(positions, turns, np.arange(18.0).reshape(3, 6), np.zeros((3, 6, 3)), np.array([0, 1, 2]))
    part = whole.part(slice(0, 3))
    np.testing.assert_array_equal(part.positions, positions[[0, 2], :3])
    np.testing.assert_array_equal(part.sigma, [[0, 1, 2], [12, 13, 14]])
    assert part.rotations.shape == (2, 3, 3, 3) and part.ray.shape == (2, 3, 3) and part.parts.tolist() == [0, 2]
    assert MotionPaths(positions, sigma=np.ones(3)).part(slice(2, 6)).sigma.shape == (3,)
    assert whole.part(slice(0, 1)) is None
