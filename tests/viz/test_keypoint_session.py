"""Editing key-points without a page: edits, undo, following, picking."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.errors import SettingsError
from geomocap.keypoints.keypoint_following import Measured
from geomocap.keypoints.keypoint_regions import KeyPoint, KeyPointFile
from tests.geomocap.made_trajectories import rigid_tracks
from viz.keypoint_session import Follower, Session, pick_ball, pick_surface


def two() -> Session:
    return Session().place(np.array([0.0, 0, 0]), 0).place(np.array([1.0, 0, 0]), 3)


def test_placed_points_get_names_and_are_chosen():
    session = two()
    assert session.file.names == ["point 1", "point 2"] and session.chosen == "point 2"
    assert session.point == KeyPoint(name="point 2", center=(1, 0, 0), radius=0.03, frame=3)
    assert session.resize("point 2", 0.05).place(np.zeros(3), 0).point.radius == 0.05
    assert session.delete("point 1").place(np.zeros(3), 0).chosen == "point 1"


def test_every_edit_can_be_undone_and_done_again():
    start = two()
    steps = [start]
    for edit in (
        lambda s: s.move("point 1", np.array([0, 2.0, 0]), 5),
        lambda s: s.resize("point 1", 0.08),
        lambda s: s.rename("point 2", "hand"),
        lambda s: s.link("hand", "point 1"),
        lambda s: s.delete("hand"),
    ):
        steps.append(edit(steps[-1]))
    session = steps[-1]
    assert session.file.names == ["point 1"] and session.file.links == ()
    for before in reversed(steps[:-1]):
        session = session.undo()
        assert session.file == before.file
    assert session.undo().undo().file == KeyPointFile() and session.undo().undo().undo().file == KeyPointFile()
    for after in steps[1:]:
        session = session.redo()
        assert session.file == after.file
    assert session.redo() is session
    assert session.undo().place(np.zeros(3), 0).future == ()


def test_undo_brings_back_what_was_deleted_and_chooses_it():
    session = two().delete("point 2")
    assert session.chosen == "point 1"
    assert session.undo().chosen == "point 2"
    assert session.delete("point 1").chosen is None


def test_a_slider_that_moves_on_is_one_step():
    session = two().resize("point 2", 0.04).resize("point 2", 0.05).resize("point 2", 0.06)
    assert session.undo().point.radius == 0.03
    twice = two().resize("point 2", 0.04).choose("point 1").choose("point 2").resize("point 2", 0.05)
    assert twice.undo().point is not None and twice.undo().file.keypoint[1].radius == 0.04


def test_links_follow_names_and_go_with_their_ends():
    session = two().link("point 1", "point 2")
    assert session.file.links == (("point 1", "point 2"),)
    assert session.rename("point 1", "hip").file.links == (("hip", "point 2"),)
    assert session.link("point 2", "point 1").file.links == ()
    assert session.delete("point 1").file.links == ()
    assert session.link("point 1", "point 1") is session and session.link("point 1", "nobody") is session


@pytest.mark.parametrize(("new", "said"), [("point 1", "point 1 already"), ("", "at least 1"), ("a\tb", "tabs")])
def test_names_that_cannot_be_are_refused(new, said):
    with pytest.raises(SettingsError, match=said):
        two().rename("point 2", new)


def test_what_is_to_be_saved():
    session = Session.open(two().file)
    assert not session.is_changed and session.chosen == "point 1"
    moved = session.move("point 1", np.ones(3), 0)
    assert moved.is_changed and not moved.was_saved().is_changed and not moved.undo().is_changed
    assert moved.was_saved().undo().is_changed
    assert session.move("point 1", np.zeros(3), 0) is session
    assert session.choose("nobody").chosen is None


def test_paths_are_those_of_each_point_alone():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (150, 3))
    measured = Measured.of(rigid_tracks(points, 8, np.array([0.01, 0, 0]), np.array([0, 2.0, 5.0])))
    follow = Follower(measured, kept=2)
    assert follow(KeyPointFile()).positions.shape == (8, 0, 3)
    session = Session().place(np.zeros(3), 0).place(np.array([0.05, 0, 0]), 4).place(np.array([5.0, 0, 0]), 2)
    paths = follow(session.file)
    assert np.isfinite(paths.positions[:, :2]).all() and np.isfinite(paths.positions[:, 2, 0]).sum() == 1
    np.testing.assert_allclose(paths.positions[4, 1], [0.05, 0, 0])
    again = follow(session.delete("point 1").file)
    np.testing.assert_array_equal(again.positions, paths.positions[:, 1:])


def test_a_ray_meets_the_near_side_of_the_surface():
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(20000, 3))
    ball *= 0.5 / np.linalg.norm(ball, axis=1, keepdims=True)
    hit = pick_surface(ball, 0.012, np.array([3.0, 0.1, 0]), np.array([-2.0, 0, 0]))
    np.testing.assert_allclose(hit, [np.sqrt(0.25 - 0.01), 0.1, 0], atol=0.015)
    assert pick_surface(ball, 0.012, np.array([3.0, 0.6, 0]), np.array([-1.0, 0, 0])) is None
    assert pick_surface(ball, 0.012, np.array([3.0, 0, 0]), np.array([1.0, 0, 0])) is None


def test_a_ray_meets_the_nearest_ball():
    centers = np.array([[0, 0, 0], [1.0, 0, 0], [np.nan, 0, 0], [2.0, 0.3, 0]])
    radii = np.full(4, 0.1)
    assert pick_ball(centers, radii, np.array([5.0, 0, 0]), np.array([-1.0, 0, 0])) == 1
    assert pick_ball(centers, radii, np.array([-5.0, 0.05, 0]), np.array([1.0, 0, 0])) == 0
    assert pick_ball(centers, radii, np.array([5.0, 0.2, 0]), np.array([-1.0, 0, 0])) == 3
    assert pick_ball(centers, radii, np.array([5.0, 2.0, 0]), np.array([-1.0, 0, 0])) is None
    assert pick_ball(np.zeros((0, 3)), np.zeros(0), np.zeros(3), np.array([1.0, 0, 0])) is None
