from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.config import Config
from geomocap.errors import GeometryError
from geomocap.files.run import Run
from geomocap.files.scans import open_scans
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.rotations import turn_angles
from geomocap.pipeline.job import Job
from geomocap.pipeline.segmentation_stage import segment
from geomocap.scheduling import threads
from geomocap.skeleton.articulated_adjustment import adjust
from geomocap.skeleton.body_observations import Observations
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, body_motion, posed, since
from geomocap.skeleton.motion_smoothness import PosePrior
from geomocap.subject.following_settings import FollowingSettings
from geomocap.subject.model_following import follow_model
from geomocap.subject.pose_search import find_pose
from geomocap.subject.sequence_paths import attach_paths, turned_by_paths
from geomocap.subject.subject_model import SubjectModel, read_model, rotation_limits, write_model
from geomocap.subject.surface_matching import FrameSurface, MatchingScales, ModelSurface, match_surfaces

SPACING = 0.015


def box(low, high):
    """Grid points on the surface of a box."""
    axes = [np.linspace(a, b, max(2, round((b - a) / SPACING) + 1)) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return grid[((grid == np.array(low)) | (grid == np.array(high))).any(axis=1)]


def outward(points, low, high):
    """Normals of points on a box."""
    scaled = (points - (np.array(low) + high) / 2) / ((np.array(high) - low) / 2)
    face = np.abs(scaled).argmax(axis=1)
    normals = np.zeros_like(points)
    normals[np.arange(len(points)), face] = np.sign(scaled[np.arange(len(points)), face])
    return normals


@pytest.fixture(scope="module")
def model():
    """A trunk standing on its end, with an arm to one side and a neck that leans, all of other sizes."""
    sizes = [
        ([-0.12, -0.08, 0.0], [0.12, 0.08, 0.6]),
        ([0.12, -0.05, 0.45], [0.55, 0.05, 0.55]),
        ([-0.05, -0.05, 0.6], [0.05, 0.15, 0.8]),
    ]
    parts = [box(*s) for s in sizes]
    points = np.concatenate(parts)
    body = np.repeat(np.arange(3), [len(p) for p in parts])
    skin = np.zeros((len(points), 4), np.int32)
    skin[:, 0] = body
    fractions = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
    raised = np.tile(np.eye(3), (3, 1, 1))
    raised[1] = Rotation.from_rotvec([0.0, -0.6, 0.0]).as_matrix()
    poses = np.stack([np.tile(np.eye(3), (3, 1, 1)), raised])
    return SubjectModel(
        points,
        np.concatenate([outward(p, *s) for p, s in zip(parts, sizes, strict=True)]),
        np.zeros((0, 3), np.uint8),
        skin,
        fractions,
        np.array([[0.12, 0.0, 0.5], [0.0, 0.0, 0.6]]),
        np.array([[0, 1], [0, 2]], np.int32),
        np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
        np.array([True, False]),
        rotation_limits(poses[:, 1:]),
        np.array(["shoulder", "neck"]),
        np.array(["trunk", "arm", "head"]),
        0,
        np.array([0.0, 0.0, 0.3]),
        np.ones((3, 3)),
        poses,
        float(np.linalg.norm(np.ptp(points, axis=0))),
        SPACING,
    )


def sequence_of(model, frames=12):
    """The subject elsewhere, turned by 100°, walking on while its arm rises and its head nods."""
    time = np.linspace(0, 1, frames)
    local = np.tile(np.eye(3), (frames, 3, 1, 1))
    local[:, 0] = Rotation.from_rotvec(np.outer(1.75 + 0.3 * time, [0, 0, 1.0])).as_matrix()
    local[:, 1] = Rotation.from_rotvec(np.outer(-0.3 - 0.7 * time, [0, 1.0, 0])).as_matrix()
    local[:, 2] = Rotation.from_rotvec(np.outer(0.4 * np.sin(4 * time), [1.0, 0, 0])).as_matrix()
    root = np.array([1.0, -2.0, 0.4]) + np.outer(time, [0.3, 0.1, 0.0])
    bodies = body_motion(model.linkage, JointMotion(local, root))
    return bodies, bodies.carry(model.points, model.skin_bodies, model.skin_weights)


@pytest.fixture(scope="module")
def tracked(model):
    true, places = sequence_of(model)
    rng = np.random.default_rng(0)
    shaken = places + rng.normal(0, 0.002, places.shape)
    found = follow_model(model, lambda t: (shaken[t], None), len(places), SPACING, 2)
    return true, places, found


def test_another_take_is_followed_from_another_place_and_pose(model, tracked):
    true, _, found = tracked
    errors = np.rad2deg(turn_angles(np.swapaxes(found.bodies.rotations, -1, -2) @ true.rotations))
    assert errors.mean() < 1.5 and errors.max() < 6.0
    joints = model.linkage.joint_positions(found.bodies)
    assert np.linalg.norm(joints - model.linkage.joint_positions(true), axis=2).max() < 0.015
    assert found.distance.max() < 0.02 * model.diagonal


def test_a_limb_that_was_lost_is_found_again_in_a_pose_seen_before(model, monkeypatch):
    folded = np.tile(np.eye(3), (1, 3, 1, 1))
    folded[0, 1] = Rotation.from_rotvec([0.0, -2.6, 0.0]).as_matrix()
    known = replace(model, poses=np.concatenate([model.poses, folded]))
    local = np.tile(np.eye(3), (10, 3, 1, 1))
    local[5:, 1] = folded[0, 1]  # nothing shows how it came there
    true = body_motion(model.linkage, JointMotion(local, np.tile(model.linkage.origin, (10, 1))))
    places = true.carry(model.points, model.skin_bodies, model.skin_weights)
    start = 0, JointMotion(local[:1], model.linkage.origin[None])

    def error() -> float:
        found = follow_model(known, lambda t: (places[t], None), 10, SPACING, 2, known=start).bodies
        turns = np.swapaxes(found.rotations[:, 1], 1, 2) @ true.rotations[:, 1]
        return float(np.rad2deg(turn_angles(turns)[[2, 8]]).max())  # away from where it jumps, which no motion does

    assert error() < 15.0
    monkeypatch.setattr("geomocap.subject.model_following._HYPOTHESES", 1)
    assert error() > 25.0


def test_hinge_of_the_model_stays_a_hinge(model, tracked):
    _, _, found = tracked
    relative = np.swapaxes(found.bodies.rotations[:, 0], 1, 2) @ found.bodies.rotations[:, 1]
    vectors = Rotation.from_matrix(relative).as_rotvec()
    np.testing.assert_allclose(np.cross(vectors, model.joint_axes[0]), 0.0, atol=1e-9)


def test_too_few_points_give_one_clear_line(model):
    with pytest.raises(GeometryError, match="frame 0: 3 points"):
        follow_model(model, lambda t: (np.eye(3), None), 2, SPACING, 2)


def test_tracked_points_are_hung_on_the_model(model):
    true, places = sequence_of(model)
    some = np.arange(0, len(model.points), 25)
    seen = places[:, some].swapaxes(0, 1).copy()
    seen[::2, :6] = np.nan
    skin = attach_paths(model, true, MotionPaths(seen), 0.05)
    np.testing.assert_allclose(skin.rest, model.points[some], atol=1e-9)


def unsure(places):
    """Paths of some points that one camera sees: along its rays they are wrong, more so higher up."""
    some = places[:, ::20].swapaxes(0, 1).copy()
    away = some - np.array([3.0, -3.5, 1.5])
    ray = away / np.linalg.norm(away, axis=2, keepdims=True)
    wrong = 0.15 * some[..., 2] * np.sin(1.3 * np.arange(len(places)))
    return MotionPaths(some + wrong[..., None] * ray, sigma=np.full(some.shape[:2], 0.002), ray=ray)


def test_depths_of_a_single_camera_do_not_draw_the_model_away(model):
    true, places = sequence_of(model)
    found = follow_model(model, lambda t: (places[t], None), len(places), SPACING, 2, unsure(places))
    apart = model.linkage.joint_positions(found.bodies) - model.linkage.joint_positions(true)
    assert np.linalg.norm(apart, axis=2).max() < 0.025  # of 0.11 if paths were as sure in depth


def test_turns_are_seen_across_the_ray(model):
    true, places = sequence_of(model)
    paths = unsure(places)
    motion, bodies = rolled(model, true, 0.5 * np.sin(np.arange(len(places))))
    skin = attach_paths(model, true, paths, 0.2)
    found = body_motion(model.linkage, turned_by_paths(model.linkage, motion, bodies, skin, paths, 1e-4))
    turns = [np.swapaxes(m.rotations[:, 2], 1, 2)[:-1] @ m.rotations[1:, 2] for m in (found, true)]
    assert np.rad2deg(turn_angles(np.swapaxes(turns[0], 1, 2) @ turns[1])).mean() < 2.5  # of 5°


def rolled(model, true, about):
    """The motion with a head that rolls about its own length as the surface, nearly round, can't see."""
    local = np.tile(np.eye(3), (len(true.rotations), 3, 1, 1))
    local[:, 0] = true.rotations[:, 0]
    for child in (1, 2):
        local[:, child] = np.swapaxes(true.rotations[:, 0], 1, 2) @ true.rotations[:, child]
    local[:, 2] = local[:, 2] @ Rotation.from_rotvec(np.outer(about, [0.0, 0.45, 0.89])).as_matrix()
    root = true.rotations[:, 0] @ model.origin + true.translations[:, 0]
    motion = JointMotion(local, root)
    return motion, body_motion(model.linkage, motion)


def test_tracked_points_turn_the_bodies_where_the_surface_does_not(model):
    true, places = sequence_of(model)
    some = np.random.default_rng(3).permutation(len(model.points))[:700]
    seen = places[:, some].swapaxes(0, 1).copy()
    seen[::3, :5] = seen[1::3, 8:] = np.nan
    paths = MotionPaths(seen)
    motion, bodies = rolled(model, true, np.linspace(-0.6, 0.6, len(places)))
    skin = attach_paths(model, bodies, paths, 0.05)
    found = body_motion(model.linkage, turned_by_paths(model.linkage, motion, bodies, skin, paths, 1e-4))
    # the turns since frame 0 are those of the points; the surface alone was wrong by up to 69°
    turns = [np.swapaxes(m.rotations @ m.rotations[0].swapaxes(1, 2), -1, -2) for m in (found, true)]
    assert np.rad2deg(turn_angles(turns[0] @ np.swapaxes(turns[1], -1, -2))).max() < 2.0


def test_tracked_points_follow_the_body_that_carries_them(model):
    true, places = sequence_of(model)
    arm = np.flatnonzero((model.skin.body == 1) & (model.points[:, 0] < 0.2))[::5]
    seen = places[:, arm].swapaxes(0, 1)
    # beside the shoulder, the trunk's points are as near, but only the arm's move along
    assert (attach_paths(model, true, MotionPaths(seen), 0.05).body == 1).mean() > 0.95


def test_pose_prior_holds_what_nothing_is_seen_of(model):
    true, places = sequence_of(model, 4)
    linkage = model.linkage
    motion = JointMotion(np.tile(np.eye(3), (4, 3, 1, 1)), np.tile(linkage.origin, (4, 1)))
    trunk = np.flatnonzero(model.skin.body == 0)
    seen = np.full((len(model.points), 4, 3), np.nan)
    seen[trunk] = places[:, trunk].swapaxes(0, 1)
    observations = Observations.of_paths(seen, np.full(seen.shape[:2], 0.01))
    prior = PosePrior(motion, 0.2, np.pi, 10.0)
    found = adjust(linkage, motion, model.skin, observations, pose_prior=prior, rounds=40, least_gain=1e-9)
    np.testing.assert_allclose(found.bodies.rotations[:, 0], true.rotations[:, 0], atol=1e-3)
    np.testing.assert_allclose(found.motion.local[:, 1:], motion.local[:, 1:], atol=1e-6)


def test_matches_are_the_nearest_points_of_the_same_side(model):
    scales = MatchingScales(0.02, 0.0, 0.1, SPACING, 0.05, 1.0)
    surface = ModelSurface.of_model(model, 200, False)
    still = BodyMotion(np.tile(np.eye(3), (1, 3, 1, 1)), np.zeros((1, 3, 3)))
    shift = np.array([0.004, -0.003, 0.002])
    frame = FrameSurface.of_points(model.points + shift, None, SPACING, scales, 150)
    found = match_surfaces(surface, surface.posed(still), [frame], scales)
    assert len(found.point) > 300
    away = found.target - surface.skin.rest[found.point]
    assert (np.abs(np.einsum("mi,mi->m", away, found.normal)) < 0.02).mean() > 0.95
    assert (np.einsum("mi,mi->m", surface.normals[found.point], found.normal) > 0.2).all()


def test_pose_is_looked_for_in_all_frames_and_given_where_it_fits_best(model):
    true, places = sequence_of(model)
    scales = MatchingScales(0.03, 0.0, 0.1, SPACING, 0.05, 0.05)
    ball = np.random.default_rng(1).normal(size=(2000, 3))
    ball *= 0.4 / np.linalg.norm(ball, axis=1, keepdims=True)
    frames = [FrameSurface.of_points(p, None, SPACING, scales, 400) for p in (ball, places[0])]
    which, pose = find_pose(model, ModelSurface.of_model(model, 400, False), frames, scales, 2)
    assert which == 1
    turned = body_motion(model.linkage, pose).rotations[0]
    assert np.rad2deg(turn_angles(turned.swapaxes(1, 2) @ true.rotations[0])).max() < 6.0


def test_model_in_another_rest_pose_moves_alike(model):
    true, places = sequence_of(model)
    again = model.reposed(true, 5)
    np.testing.assert_allclose(again.points, places[5], atol=1e-12)
    carried = since(true, 5).carry(again.points, again.skin_bodies, again.skin_weights)
    np.testing.assert_allclose(carried, places, atol=1e-9)
    np.testing.assert_allclose(again.joints, posed(model.linkage, true, 5).joints)
    pose = JointMotion(again.poses[1:], again.origin[None])
    turned = body_motion(again.linkage, pose).rotations[0] @ true.rotations[5]
    before = body_motion(model.linkage, JointMotion(model.poses[1:], model.origin[None])).rotations[0]
    np.testing.assert_allclose(turned, before, atol=1e-12)


def test_limits_are_those_of_all_takes(model):
    def turning(low, high):
        """The arm turns about its axis from one angle to another, the head tilts, the trunk turns on the spot."""
        turns = np.zeros((9, 3, 3))
        turns[:, 0, 2] = np.linspace(0.5, 1.5, 9)
        turns[:, 1, 1] = np.linspace(low, high, 9)
        turns[:, 2, 0] = 0.3
        local = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(9, 3, 3, 3)
        return body_motion(model.linkage, JointMotion(local, np.tile(model.origin, (9, 1))))

    still = body_motion(model.linkage, JointMotion(model.poses[:1], model.origin[None]))
    np.testing.assert_array_equal(model.reposed(still, 0).joint_limits, model.joint_limits)
    second, third = turning(-0.3, 0.8), turning(-1.1, 0.2)
    again = model.widened(second).reposed(second, 4)
    np.testing.assert_allclose(again.joint_limits[0], [[0, -0.6, 0], [0, 0.8, 0]], atol=1e-9)
    carried = BodyMotion(third.rotations @ second.rotations[4].swapaxes(1, 2), third.translations)  # from its rest
    last = again.widened(carried).reposed(carried, 8)
    np.testing.assert_allclose(last.joint_limits[0], [[0, -1.1, 0], [0, 0.8, 0]], atol=1e-9)
    np.testing.assert_allclose(last.joint_limits[1], [[0, 0, 0], [0.3, 0, 0]], atol=1e-9)


def test_stage_follows_the_model_and_says_when_it_fits_poorly(model, tmp_path):
    _, places = sequence_of(model, 3)
    write_model(tmp_path / "first/model.npz", model)
    settings = Config(following=FollowingSettings(rounds=1, steps=3, start_frames=1))
    for name, scale in (("good", 1.0), ("large", 1.6)):
        np.savez(tmp_path / f"{name}.npz", points=scale * places)
        with threads(1) as executor:
            scans = open_scans(tmp_path / f"{name}.npz", settings.scans)
            job = Job(
                Run(tmp_path / name), settings, executor, scans=scans, fps=25.0, model=tmp_path / "first/model.npz"
            )
            segment(job, "scans")
    good, large = ((tmp_path / n / "diagnostics.json").read_text() for n in ("good", "large"))
    assert "same scale" in large and "same scale" not in good
    skeleton = Run(tmp_path / "good").read_npz("skeleton.npz")
    assert skeleton["joint_names"].tolist() == ["shoulder", "neck"]
    assert skeleton["body_rotations"].shape == (3, 3, 3, 3)
    np.testing.assert_allclose(skeleton["body_rotations"][0], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    assert (tmp_path / "good/bodies/000002.ply").is_file()
    limits = read_model(tmp_path / "good/model.npz").joint_limits  # the arm was seen to turn by -0.6, and now -1
    assert limits[0, 0, 1] == pytest.approx(-1.0, abs=0.1) and limits[0, 1, 1] == 0
