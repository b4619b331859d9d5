from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.model.hierarchy import Hierarchy
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.rotations import turn_angles
from geomocap.skeleton.adjustment_kernel import normal_equations
from geomocap.skeleton.articulated_adjustment import JointPrior, _system, adjust
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion, Linkage, body_motion, joint_motion, moved_by, posed, since
from geomocap.skeleton.motion_skeleton import find_motion_skeleton
from geomocap.skeleton.motion_skeleton_settings import RefinementSettings
from geomocap.skeleton.motion_smoothness import Smoothness, accelerations
from geomocap.skeleton.refinement import refine_motion, refine_skeleton
from tests.geomocap.moving_chains import Chain, chain, seen_by_single_cameras


def linked(scene: Chain, hinges: bool = False):
    """Linkage, true motion and skin of a chain."""
    count = len(scene.joints) + 1
    hierarchy = Hierarchy(0, np.array([[b, b + 1] for b in range(count - 1)], np.int32))
    origin = scene.positions[scene.body == 0, 0].mean(axis=0)
    linkage = Linkage(hierarchy, scene.joints, scene.axes, np.full(count - 1, hinges), origin)
    root = scene.rotations[:, 0] @ origin + scene.translations[:, 0]
    points = SkinPoints.of_weights(scene.positions[:, 0], np.eye(count)[scene.body])
    return linkage, joint_motion(linkage, scene.rotations, root), points


def prior(linkage, turn=0.05, shift=0.02):
    return Smoothness(np.full(linkage.body_count, turn), shift, 3.0)


def disturbed(linkage, motion, size, seed=0):
    step = np.random.default_rng(seed).normal(0, size, (motion.frames, linkage.joint_dof[-1]))
    return moved_by(linkage, motion, step)


def turn_errors_deg(found, true):
    return np.rad2deg(turn_angles(np.swapaxes(found, -1, -2) @ true))


@pytest.mark.parametrize("hinges", [False, True])
def test_forward_kinematics_are_those_of_the_chain(hinges):
    scene = chain(4)
    linkage, motion, points = linked(scene, hinges)
    bodies = body_motion(linkage, motion)
    np.testing.assert_allclose(bodies.rotations, scene.rotations, atol=1e-12)
    np.testing.assert_allclose(bodies.translations, scene.translations, atol=1e-12)
    carried = bodies.carry(points.rest, points.bodies, points.fractions)
    np.testing.assert_allclose(carried.swapaxes(0, 1), scene.positions, atol=1e-12)


def test_another_frame_can_be_the_rest_pose():
    linkage, motion, _ = linked(chain(3))
    bodies = body_motion(linkage, motion)
    places = linkage.joint_positions(bodies)
    moved, again = posed(linkage, bodies, 5), since(bodies, 5)
    np.testing.assert_allclose(again.rotations[5], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(moved.joint_positions(again), places, atol=1e-12)


def test_kernel_agrees_with_the_sums_written_out():
    rng = np.random.default_rng(1)
    frames, bodies, unknowns, count, seen, cutoff = 2, 3, 7, 6, 11, 2.0
    rotations = Rotation.random(frames * bodies, rng=1).as_matrix().reshape(frames, bodies, 3, 3)
    translations = rng.normal(size=(frames, bodies, 3))
    twists = rng.normal(size=(frames, unknowns, 6))
    chains = [[0, 1], [0, 1, 2, 3], [0, 1, 4, 5, 6]]
    start = np.array([0, 5, seen])
    skin = SkinPoints.of_weights(rng.normal(size=(count, 3)), rng.dirichlet(np.ones(bodies), count))
    point = rng.integers(0, count, seen).astype(np.int32)
    target = rng.normal(size=(seen, 3))
    normal = rng.normal(size=(seen, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    isotropic, across = rng.random((2, seen))
    matrix, right, cost = np.zeros((frames, unknowns, unknowns)), np.zeros((frames, unknowns)), np.empty(frames)
    unknowns_of = np.concatenate(chains), np.concatenate([[0], np.cumsum([len(c) for c in chains])])
    observed = start, point, target, normal, isotropic, across
    motion = rotations, translations, twists
    normal_equations(0, frames, motion, unknowns_of, skin.arrays, observed, cutoff, matrix, right, cost)
    for t in range(frames):
        expected, side, total = np.zeros((unknowns, unknowns)), np.zeros(unknowns), 0.0
        for m in range(start[t], start[t + 1]):
            place, jacobian = np.zeros(3), np.zeros((3, unknowns))
            for b, fraction in zip(skin.bodies[point[m]], skin.fractions[point[m]], strict=True):
                x = rotations[t, b] @ skin.rest[point[m]] + translations[t, b]
                place += fraction * x
                for u in chains[b]:
                    jacobian[:, u] += fraction * (np.cross(twists[t, u, :3], x) + twists[t, u, 3:])
            miss = target[m] - place
            weight = isotropic[m] * np.eye(3) + across[m] * np.outer(normal[m], normal[m])
            chi2 = miss @ weight @ miss
            total += 0.5 * cutoff**2 * np.log1p(chi2 / cutoff**2)
            weight /= 1.0 + chi2 / cutoff**2
            expected += jacobian.T @ weight @ jacobian
            side += jacobian.T @ weight @ miss
        np.testing.assert_allclose(matrix[t], expected, atol=1e-10)
        np.testing.assert_allclose(right[t], side, atol=1e-10)
        np.testing.assert_allclose(cost[t], total, rtol=1e-12)


def test_poses_and_joints_are_recovered():
    scene = chain(4)
    linkage, motion, points = linked(scene)
    shifted = replace(linkage, joints=linkage.joints + np.random.default_rng(2).normal(0, 0.02, (3, 3)))
    observations = Observations.of_paths(scene.positions, np.full(scene.positions.shape[:2], 0.002))
    found = adjust(
        shifted,
        disturbed(linkage, motion, 0.1),
        points,
        observations,
        smoothness=prior(linkage, 1.0, 1.0),
        joint_prior=JointPrior(shifted.joints, 1.0),
        rounds=30,
    )
    assert turn_errors_deg(found.bodies.rotations, scene.rotations).max() < 0.05
    along = np.abs(np.einsum("ji,ji->j", found.linkage.joints - scene.joints, scene.axes))
    across = np.linalg.norm(found.linkage.joints - scene.joints, axis=1) ** 2 - along**2
    assert np.sqrt(np.maximum(across, 0)).max() < 2e-4  # along a hinge every point is common


def test_frames_without_observations_are_bridged():
    scene = chain(3, frames=60, turn_deg=30.0)
    linkage, motion, points = linked(scene)
    seen = scene.positions.copy()
    seen[:, 20:26] = np.nan
    start = joint_motion(linkage, scene.rotations.copy(), motion.root.copy())
    start.local[20:26], start.root[20:26] = start.local[19], start.root[19]
    observations = Observations.of_paths(seen, np.full(seen.shape[:2], 0.002))
    found = adjust(linkage, start, points, observations, smoothness=prior(linkage, 0.02, 0.005), rounds=30)
    held = turn_errors_deg(body_motion(linkage, start).rotations, scene.rotations)[20:26].max()
    assert held > 10.0
    assert turn_errors_deg(found.bodies.rotations, scene.rotations)[20:26].max() < 1.0


def test_noise_goes_and_a_kick_stays_without_lag():
    scene = chain(2, frames=41)
    linkage, motion, points = linked(scene)
    angle = np.deg2rad(60.0) * (np.arange(41) >= 20)  # from one frame to the next
    local = motion.local.copy()
    local[:, 1] = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    true = replace(motion, local=local)
    positions = body_motion(linkage, true).carry(points.rest, points.bodies, points.fractions).swapaxes(0, 1)
    noisy = disturbed(linkage, true, np.deg2rad(0.5), seed=3)
    shaken = body_motion(linkage, noisy).carry(points.rest, points.bodies, points.fractions).swapaxes(0, 1)
    observations = Observations.of_paths(shaken, np.full(positions.shape[:2], 0.05))
    found = adjust(linkage, noisy, points, observations, smoothness=prior(linkage, 0.005, 0.001), rounds=30)
    turned = Rotation.from_matrix(found.motion.local[:, 1]).as_rotvec()[:, 2]
    shaking = np.abs(accelerations(linkage, noisy)[:18]).mean()
    assert np.abs(accelerations(linkage, found.motion)[:18]).mean() < 0.5 * shaking
    assert turned[19] < np.deg2rad(3.0) and turned[20] > np.deg2rad(57.0)


def test_hinge_turns_about_its_axis_only():
    scene = chain(3)
    linkage, motion, points = linked(scene, hinges=True)
    shaken = scene.positions + np.random.default_rng(4).normal(0, 0.01, scene.positions.shape)
    observations = Observations.of_paths(shaken, np.full(shaken.shape[:2], 0.01))
    found = adjust(linkage, motion, points, observations, rounds=20)
    for j in range(2):
        vectors = Rotation.from_matrix(found.motion.local[:, j + 1]).as_rotvec()
        np.testing.assert_allclose(np.cross(vectors, linkage.axes[j]), 0.0, atol=1e-9)
    assert turn_errors_deg(found.bodies.rotations, scene.rotations).max() < 2.0


def test_right_sides_are_the_slopes_of_the_cost():
    linkage, motion, points = linked(chain(4))
    linkage = replace(linkage, hinge=np.array([True, False, True]))
    observations = Observations.of_paths(chain(4).positions, np.full((len(points), motion.frames), 0.01))
    loose = np.array([0.01, 0.02, 0.03])
    rng, size = np.random.default_rng(0), int(linkage.joint_dof[-1])
    away = replace(motion, slip=rng.normal(0, 0.05, (motion.frames, 3, 3)))
    away = moved_by(linkage, away, rng.normal(0, 0.05, (motion.frames, size + 9)))
    priors = (None, None, JointPrior(linkage.joints + 0.01, 0.1), loose)
    system = _system(linkage, away, points, observations, priors, 3.0)

    def cost(step, shift):
        bent = replace(linkage, joints=linkage.joints + shift)
        return _system(bent, moved_by(linkage, away, step), points, observations, priors, 3.0).cost

    for t, k in ((0, 0), (5, 4), (7, 6), (8, 8), (3, size), (4, size + 5), (23, size + 8)):
        step = np.zeros((motion.frames, size + 9))
        step[t, k] = 1e-6
        slope = (cost(step, 0.0) - cost(-step, 0.0)) / 2e-6
        np.testing.assert_allclose(-slope, system.right[t, k], rtol=1e-5, atol=1e-3)
    for k in range(9):
        shift = np.zeros((3, 3))
        shift.flat[k] = 1e-6
        slope = (cost(0.0 * step, shift) - cost(0.0 * step, -shift)) / 2e-6
        np.testing.assert_allclose(-slope, system.corner_right[k], rtol=1e-5, atol=1e-3)


def test_joint_that_is_none_does_not_bend_the_motion():
    scene = chain(3)
    linkage, _, points = linked(scene)
    ends = scene.body != 1  # the body between was not found: its neighbours share no point
    paths = MotionPaths(scene.positions[ends])
    pair = Linkage(
        Hierarchy(0, np.array([[0, 1]], np.int32)),
        linkage.joints[1:],
        linkage.axes[1:],
        np.zeros(1, bool),
        linkage.origin,
    )
    root = scene.rotations[:, 0] @ linkage.origin + scene.translations[:, 0]
    start = joint_motion(pair, scene.rotations[:, [0, 2]], root)
    skin = SkinPoints.of_weights(points.rest[ends], np.eye(2)[scene.body[ends] // 2])
    held = refine_motion(pair, start, skin, paths, 1.3)
    loose = refine_motion(pair, start, skin, paths, 1.3, misses=np.array([0.1]))
    true = scene.rotations[:, [0, 2]]
    assert turn_errors_deg(held.bodies.rotations, true).mean() > 5.0
    assert turn_errors_deg(loose.bodies.rotations, true).mean() < 0.5


def test_refinement_hardly_heeds_what_is_unsure_along_the_ray():
    scene = chain(3)
    linkage, motion, points = linked(scene)
    positions, ray = seen_by_single_cameras(scene, 0.02)
    errors = [
        turn_errors_deg(refine_motion(linkage, motion, points, paths, 1.3).bodies.rotations, scene.rotations).mean()
        for paths in (MotionPaths(positions), MotionPaths(positions, ray=ray))
    ]
    assert errors[1] < 0.4 * errors[0]


def test_refinement_is_the_same_in_another_unit():
    scene = chain(3, frames=40)
    positions = scene.positions + np.random.default_rng(7).normal(0, 0.004, scene.positions.shape)
    joints = []
    for unit in (1.0, 2.0**20):
        paths = MotionPaths(unit * positions)
        bodies = find_motion_bodies(paths, MotionBodiesSettings(bodies=3))
        refined, _ = refine_skeleton(find_motion_skeleton(bodies, 30.0), bodies, paths)
        joints.append(refined.skeleton.joint_positions / unit)
    np.testing.assert_allclose(joints[0], joints[1], atol=2e-4)  # a twentieth of the noise


def test_refined_skeleton_is_nearer_to_the_truth_and_keeps_its_bones():
    scene = chain(3, frames=40)
    rng = np.random.default_rng(7)
    positions = scene.positions + rng.normal(0, 0.004, scene.positions.shape)
    paths = MotionPaths(positions)
    bodies = find_motion_bodies(paths, MotionBodiesSettings(bodies=3))
    found = find_motion_skeleton(bodies, 30.0)
    skeleton, refined = refine_skeleton(found, bodies, paths)

    def errors(some):
        true = [np.bincount(scene.body[bodies.label == b]).argmax() for b in range(some.body_count)]
        return turn_errors_deg(some.rotations, scene.rotations[:, true]).mean()

    assert errors(refined) < errors(bodies)
    bone = np.linalg.norm(np.diff(skeleton.skeleton.joint_positions, axis=1), axis=2)  # both joints are the middle's
    np.testing.assert_allclose(bone, np.full_like(bone, bone[0, 0]), rtol=1e-9)
    np.testing.assert_allclose(refined.rotations[0], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(refined.weights.sum(axis=1), 1.0)


def test_perfect_paths_are_not_made_worse_and_results_repeat():
    scene = chain(3)
    linkage, motion, points = linked(scene)
    paths = MotionPaths(scene.positions)
    found = refine_motion(linkage, motion, points, paths, 1.3)
    assert turn_errors_deg(found.bodies.rotations, scene.rotations).max() < 0.05
    again = refine_motion(linkage, motion, points, paths, 1.3)
    np.testing.assert_array_equal(found.bodies.rotations, again.bodies.rotations)
    np.testing.assert_array_equal(found.points.fractions, again.points.fractions)


def test_no_rounds_mean_no_change():
    paths = MotionPaths(chain(2).positions)
    bodies = find_motion_bodies(paths)
    found = find_motion_skeleton(bodies, 30.0)
    assert refine_skeleton(found, bodies, paths, RefinementSettings(rounds=0)) == (found, bodies)


def test_points_are_carried_by_blends_of_bodies():
    rng = np.random.default_rng(5)
    rotations = Rotation.random(12, rng).as_matrix().reshape(4, 3, 3, 3)
    translations, points = rng.normal(size=(4, 3, 3)), rng.normal(size=(6, 3))
    bodies, fractions = rng.integers(0, 3, (6, 2)), rng.dirichlet([1.0, 1.0], 6)
    expected = sum(
        fractions[:, k, None]
        * (np.einsum("tnij,nj->tni", rotations[:, bodies[:, k]], points) + translations[:, bodies[:, k]])
        for k in range(2)
    )
    got = BodyMotion(rotations, translations).carry(points, bodies, fractions)
    np.testing.assert_allclose(got, expected, atol=1e-12)
