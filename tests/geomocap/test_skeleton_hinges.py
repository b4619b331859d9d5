import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.bodies.rigid_motions import fit_rigid_motion
from geomocap.model.hierarchy import Hierarchy
from geomocap.model.motion_paths import MotionPaths
from geomocap.skeleton.body_observations import SkinPoints
from geomocap.skeleton.borders import Border
from geomocap.skeleton.hinges import find_hinges, hinge_axis, off_axis, turn_information
from geomocap.skeleton.kinematics import BodyMotion, Linkage, body_motion, joint_motion
from geomocap.skeleton.refinement import joints_by_shape, refine_motion
from tests.geomocap.moving_chains import chain

NOISE = 0.004


def two_bodies(swing_deg: float, seed: int = 0):
    """Two boxes that turn about a hinge and, more or less, across it; paths, the bodies' own motions, linkage, skin."""
    scene = chain(2, frames=30, seed=seed)
    swing = np.deg2rad(swing_deg) * np.sin(np.linspace(0, 9, 30))
    across = Rotation.from_rotvec(np.outer(swing - swing[0], [0.0, 1.0, 0.0])).as_matrix()
    rotations = scene.rotations.copy()
    rotations[:, 1] = rotations[:, 0] @ across @ np.swapaxes(rotations[:, 0], 1, 2) @ rotations[:, 1]
    joint = rotations[:, 0] @ scene.joints[0] + scene.translations[:, 0]
    translations = np.stack([scene.translations[:, 0], joint - rotations[:, 1] @ scene.joints[0]], axis=1)
    rest = scene.positions[:, 0]
    moved = np.einsum("tnij,nj->nti", rotations[:, scene.body], rest) + translations[:, scene.body].swapaxes(0, 1)
    moved += np.random.default_rng(seed).normal(0, NOISE, moved.shape)
    hierarchy = Hierarchy(0, np.array([[0, 1]], np.int32))
    linkage = Linkage(hierarchy, scene.joints, np.array([[0.0, 0.6, 0.8]]), np.zeros(1, bool), rest[:90].mean(axis=0))
    fitted = [fit_rigid_motion(moved[s], rest[s], np.ones((90, 30)), 1e-4) for s in (slice(0, 90), slice(90, 180))]
    turned = np.stack([f[0] for f in fitted], axis=1)
    root = turned[:, 0] @ linkage.origin + fitted[0][1]
    return moved, joint_motion(linkage, turned, root), linkage, SkinPoints.of_weights(rest, np.eye(2)[scene.body])


@pytest.mark.parametrize(("swing_deg", "hinge"), [(0.0, True), (6.0, False)])
def test_a_joint_is_a_hinge_if_the_observations_show_no_other_turns(swing_deg, hinge):
    moved, motion, linkage, points = two_bodies(swing_deg)
    seen = np.ones(moved.shape[:2], bool)
    information = turn_information(linkage, body_motion(linkage, motion), points, seen, np.full(180, NOISE**-2))
    found = find_hinges(linkage, motion, information, np.array([180 * 30.0]))
    assert found.hinge[0] == hinge
    if hinge:
        # the standard deviation of the axis is that of the turns over the root of the frames and the turn: 0.1°
        assert np.rad2deg(np.arccos(abs(found.axes[0] @ [0.0, 0.0, 1.0]))) < 0.4


def test_information_is_the_inverse_covariance_of_turns():
    rng = np.random.default_rng(5)
    _, motion, linkage, points = two_bodies(0.0)
    seen = rng.random((180, 30)) < 0.7
    bodies = body_motion(linkage, motion)
    information = turn_information(linkage, bodies, points, seen, np.full(180, NOISE**-2))
    # the parent's turn and the child's, each about the joint, from many noisy observations of one frame
    t, found = 20, []
    lever = points.rest - linkage.joints[0]
    for _ in range(3000):
        noise = rng.normal(0, NOISE, lever.shape) * seen[:, t, None]
        turns = []
        for b in range(2):
            mine = np.flatnonzero((points.body == b) & seen[:, t])
            normal = sum(x @ x * np.eye(3) - np.outer(x, x) for x in lever[mine])
            turns.append(np.linalg.solve(normal, np.cross(lever[mine], noise[mine]).sum(axis=0)))
        relative = bodies.rotations[t, 0].T @ bodies.rotations[t, 1]
        found.append(relative @ turns[1] - turns[0])
    covariance = np.cov(np.array(found).T)
    np.testing.assert_allclose(covariance @ information[t, 0], np.eye(3), atol=0.15)


def test_axis_weighs_turns_by_what_is_known_of_them():
    axis = np.array([0.48, 0.6, 0.64])
    angles = np.linspace(-1.0, 2.0, 20)
    turns = Rotation.from_rotvec(np.outer(angles, axis)).as_matrix()
    information = np.tile(1e4 * np.eye(3), (20, 1, 1))
    turns[5] = Rotation.from_rotvec([0.4, -0.5, 0.3]).as_matrix() @ turns[5]
    information[5] *= 1e-6
    found, off = hinge_axis(turns, information)
    np.testing.assert_allclose(found, axis, atol=1e-5)
    assert np.abs(np.delete(off, 5, axis=0)).max() < 1e-4


def test_refinement_finds_the_hinge_and_its_axis():
    moved, motion, linkage, points = two_bodies(0.0, seed=4)
    refined = refine_motion(linkage, motion, points, MotionPaths(moved), 0.8)
    assert refined.linkage.hinge[0]
    assert np.rad2deg(np.arccos(abs(refined.linkage.axes[0] @ [0.0, 0.0, 1.0]))) < 0.4


@pytest.mark.parametrize(("across_deg", "noise", "by_motion"), [(0.5, 0.03, 0.0), (30.0, 0.001, 1.0)])
def test_shapes_say_where_on_its_axis_a_joint_is_as_far_as_motion_does_not(across_deg, noise, by_motion):
    # a wheel between 0.1 and 0.2 m on the axis of a shaft; the motion puts its joint at 0.3 m
    angle = np.linspace(0.0, 6.0, 50)
    ring = np.stack([np.cos(angle * 4), np.sin(angle * 4)], axis=1)
    wheel = np.column_stack([0.5 * ring, np.linspace(0.1, 0.2, 50)])
    shaft = np.column_stack([0.05 * ring, np.linspace(-1.0, 0.15, 50)])
    border = Border(0.0, (shaft[30:], wheel[:20]), (np.tile(shaft, (2, 1)), wheel))
    swing = np.deg2rad(across_deg) * np.sqrt(2.0) * np.sin(np.linspace(0, 2 * np.pi, 20, endpoint=False))
    turns = Rotation.from_rotvec(np.outer(swing, [1.0, 0.0, 0.0])) * Rotation.from_rotvec(
        np.outer(np.linspace(0, 3, 20), [0.0, 0.0, 1.0])
    )
    rotations = np.stack([np.tile(np.eye(3), (20, 1, 1)), turns.as_matrix()], axis=1)
    axes, joint = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 0.3]])
    linkage = Linkage(Hierarchy(0, np.array([[0, 1]], np.int32)), joint, axes, np.zeros(1, bool), np.zeros(3))
    bodies = BodyMotion(rotations, np.zeros((20, 2, 3)))
    by_shape = border.middle_along(joint[0], axes[0])[2]
    found = joints_by_shape(linkage, bodies, (border,), noise).joints[0]
    assert abs(by_shape - 0.3) > 0.1
    assert (found[2] - by_shape) / (0.3 - by_shape) == pytest.approx(by_motion, abs=0.02)
    np.testing.assert_array_equal(found[:2], 0.0)


def test_turns_off_an_axis_are_what_is_left_without_those_about_it():
    axis = np.array([0.0, 0.6, 0.8])
    off = np.array([[0.2, 0.0, 0.0], [0.0, 0.08, -0.06]])
    turns = Rotation.from_rotvec(off) * Rotation.from_rotvec(np.outer([0.7, -0.4], axis))
    np.testing.assert_allclose(off_axis(turns.as_matrix(), axis), off, atol=1e-12)
