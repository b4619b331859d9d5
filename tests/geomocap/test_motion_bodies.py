from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from geomocap.bodies import body_elimination
from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.bodies.path_smoothing import smooth_paths
from geomocap.bodies.point_labels import Voters, label_points
from geomocap.bodies.surface_graph import surface_graph
from geomocap.bodies.surface_noise import ring_misses, surface_noise
from geomocap.errors import GeometryError
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.rotations import turn_angles
from geomocap.motion import find_motion, unsure_turns
from geomocap.skeleton.bone_motion import forward_kinematics
from geomocap.skeleton.borders import Border
from geomocap.skeleton.common_points import INDEPENDENT, common_point
from geomocap.skeleton.motion_skeleton import find_motion_skeleton
from geomocap.skeleton.refinement import refine_skeleton
from tests.geomocap.moving_chains import chain, same_partition, seen_by_single_cameras


@pytest.fixture(scope="module")
def three():
    return chain(3)


@pytest.fixture(scope="module")
def found(three):
    return find_motion_bodies(MotionPaths(three.positions))


def test_bodies_of_a_chain_are_found_with_their_number(three, found):
    assert found.body_count == 3
    assert same_partition(found.label, three.body) > 0.97
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0)
    assert found.reliability.shape == (24, 3)


def test_motions_of_the_bodies_are_the_true_ones(three, found):
    for b in range(3):
        members = three.body[found.label == b]
        true = np.bincount(members).argmax()
        difference = np.swapaxes(found.rotations[:, b], 1, 2) @ three.rotations[:, true]
        assert np.rad2deg(turn_angles(difference)).max() < 0.5
    np.testing.assert_allclose(found.rotations[0], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(found.translations[0], 0.0, atol=1e-12)


def test_result_is_the_same_bit_for_bit(three, found):
    again = find_motion_bodies(MotionPaths(three.positions))
    np.testing.assert_array_equal(again.label, found.label)
    np.testing.assert_array_equal(again.rotations, found.rotations)


def test_turns_that_are_known_still_are_those_found_anew(three, monkeypatch):
    rng = np.random.default_rng(1)
    paths = MotionPaths(three.positions + rng.normal(scale=0.004, size=three.positions.shape))
    before, asked = find_motion_bodies(paths), []

    def all_turned(*models):
        stale, turned = changed(*models)
        asked.append(turned.mean())
        return stale, np.ones_like(turned)

    changed = body_elimination._changed
    monkeypatch.setattr(body_elimination, "_changed", all_turned)
    again = find_motion_bodies(paths)
    assert asked and min(asked) < 0.8  # there are turns to keep
    np.testing.assert_array_equal(again.rotations, before.rotations)
    assert [(step.strength, step.turn_deg) for step in again.curve] == [(s.strength, s.turn_deg) for s in before.curve]


def test_bodies_are_joined_of_known_parts(three):
    halves = 2 * three.body + (np.arange(len(three.body)) % 2)
    found = find_motion_bodies(MotionPaths(three.positions, parts=halves))
    assert found.body_count == 3
    assert same_partition(found.label, three.body) > 0.97
    together = find_motion_bodies(MotionPaths(three.positions, parts=(three.body > 0).astype(int)))
    assert together.body_count <= 2


def test_rigid_parts_that_turn_by_less_are_bodies():
    two = chain(2, turn_deg=13.0)
    assert find_motion_bodies(MotionPaths(two.positions)).body_count == 1
    assert find_motion_bodies(MotionPaths(two.positions, parts=two.body)).body_count == 2


@pytest.mark.parametrize("seed", [4, 5])
def test_bodies_are_not_split_where_turns_are_unsure(three, seed):
    drift = gaussian_filter1d(np.random.default_rng(seed).normal(size=three.positions.shape), 3, axis=1)
    drift *= 0.0027 / drift.std()  # metres, of boxes 0.12 m wide
    paths = MotionPaths(three.positions + drift, sigma=np.full(len(drift), 0.0027))
    assert find_motion_bodies(paths).body_count == 3


def test_turns_of_noise_are_called_unsure(three, found):
    assert unsure_turns(found) == ()
    noise = np.random.default_rng(0).normal(0, 0.2, three.positions.shape)  # metres, of boxes 0.12 m wide
    (warning,) = unsure_turns(find_motion_bodies(MotionPaths(three.positions + noise)))
    assert "not to be trusted" in warning and "more cameras" in warning


def test_number_of_bodies_can_be_given(three):
    for wanted in (2, 4):
        assert (
            find_motion_bodies(MotionPaths(three.positions), MotionBodiesSettings(bodies=wanted)).body_count == wanted
        )


def test_bodies_that_turn_less_are_one():
    small = chain(2, turn_deg=8.0)
    assert find_motion_bodies(MotionPaths(small.positions)).body_count == 1


@pytest.mark.parametrize("shared", [False, True])
def test_more_noise_gives_no_more_bodies(three, shared):
    noise = np.random.default_rng(6).normal(size=three.positions.shape)
    if shared:  # over 8 frames, and among samples within 40 mm
        near = np.linalg.norm(three.positions[:, None, 0] - three.positions[None, :, 0], axis=2) / 0.04
        noise = np.einsum("ij,jtc->itc", np.exp(-(near**2)), gaussian_filter1d(noise, 3.4, axis=1))
    noise /= noise.std()
    counts = []
    for size in (0.002, 0.005, 0.01, 0.02, 0.05):  # metres, of boxes 0.12 m wide
        bodies = find_motion_bodies(MotionPaths(three.positions + size * noise))
        counts.append(bodies.body_count)
        assert bodies.noise > 0.3 * size
    assert counts[0] == 3
    assert max(counts) == 3


@pytest.mark.parametrize("stated", [0.002, 0.05])  # metres
def test_standard_deviations_that_say_too_much_hide_no_bodies(three, stated):
    positions = three.positions + np.random.default_rng(6).normal(scale=0.002, size=three.positions.shape)
    bodies = find_motion_bodies(MotionPaths(positions, sigma=np.full(len(positions), stated)))
    assert same_partition(bodies.label, three.body) > 0.97


def test_what_is_stated_counts_on_the_scale_that_the_surface_shows(three):
    graph = surface_graph(three.positions, three.positions[:, 0], 10, 2.0)
    positions = three.positions + np.random.default_rng(3).normal(scale=0.004, size=three.positions.shape)
    weights = np.ones(positions.shape[:2])
    noise = surface_noise(positions, weights, three.positions[:, 0], None, graph, 1.2)
    near = np.random.default_rng(4).uniform(0.001, 0.008, len(positions))
    np.testing.assert_array_equal(noise.calibrated(near), near)
    far = 10.0 * near
    np.testing.assert_allclose(noise.calibrated(far) / noise.calibrated(far)[0], near / near[0])
    # half as much more than was added, which rings know to a third
    assert np.quantile(noise.calibrated(far), 0.25) == pytest.approx(0.006, rel=0.3)
    np.testing.assert_array_equal(noise.calibrated(0.0 * near), 0.0 * near)


def test_misses_of_rings_are_those_of_numpy(three):
    rng = np.random.default_rng(11)
    positions = three.positions[:40] + rng.normal(scale=0.01, size=three.positions[:40].shape)
    weights, rest = rng.random(positions.shape[:2]), three.positions[:40, 0]
    ring = rng.random((40, 40)) < 0.4
    misses = ring_misses(positions, weights, rest, ring)
    for i in (0, 17, 39):
        places, carried = [], []
        for t in range(24):
            w = weights[ring[i], t] / weights[ring[i], t].sum()
            now, before = w @ positions[ring[i], t], w @ rest[ring[i]]
            moments = (positions[ring[i], t] - now).T @ ((rest[ring[i]] - before) * w[:, None])
            u, _, vt = np.linalg.svd(moments)
            turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            places.append(turn.T @ (positions[i, t] - now) + before)
            carried.append((turn, now, before))
        place = weights[i] @ np.array(places) / weights[i].sum()
        expected = [positions[i, t] - (R @ (place - b) + a) for t, (R, a, b) in enumerate(carried)]
        np.testing.assert_allclose(misses[i], expected, atol=1e-9)


def test_noise_of_the_surface_is_what_was_added(three):
    graph = surface_graph(three.positions, three.positions[:, 0], 10, 2.0)
    weights = np.ones(three.positions.shape[:2])
    for size in (0.0, 0.004):
        positions = three.positions + np.random.default_rng(3).normal(scale=size, size=three.positions.shape)
        noise = surface_noise(positions, weights, three.positions[:, 0], None, graph, 1.2)
        per_axis = np.sqrt(noise.variance / 3.0)
        assert per_axis == pytest.approx(max(size, 2.4e-4), rel=0.3, abs=1e-3)
    # white noise: all samples count; noise in common: hardly more than one
    places = three.positions[:60, 0]
    assert noise.independent(places, 60) > 25
    common = replace(noise, correlation=np.ones_like(noise.correlation))
    assert common.independent(places, 60) == pytest.approx(1.0)


def test_smoothing_of_paths_takes_white_noise_only(three):
    np.testing.assert_allclose(smooth_paths(three.positions), three.positions, atol=5e-4)
    noisy = three.positions + np.random.default_rng(3).normal(scale=0.01, size=three.positions.shape)
    assert np.abs(smooth_paths(noisy) - three.positions).mean() < 0.8 * np.abs(noisy - three.positions).mean()
    np.testing.assert_array_equal(smooth_paths(noisy[:, :5]), noisy[:, :5])


def test_alternatives_have_other_numbers_of_bodies_nearest_first(found):
    alternatives = found.alternatives()
    counts = [len(np.unique(label)) for label in alternatives]
    assert alternatives.shape[1] == len(found.label)
    assert found.body_count not in counts
    assert counts[0] == 2
    assert [abs(c - 3) for c in counts] == sorted(abs(c - 3) for c in counts)


@pytest.mark.parametrize("moving", [True, False])
def test_a_single_rigid_body_is_one_without_joints(moving):
    one = chain(1, samples=150)
    positions = one.positions if moving else np.repeat(one.positions[:, :1], 24, axis=1)
    bodies = find_motion_bodies(MotionPaths(positions))
    assert bodies.body_count == 1
    skeleton = find_motion_skeleton(bodies, 30.0).skeleton
    assert skeleton.joint_positions.shape == (24, 0, 3)
    assert skeleton.root == 0


def test_bodies_that_single_cameras_see_turn_as_what_they_see_across_says(three):
    positions, ray = seen_by_single_cameras(three, 0.02)
    errors = []
    for known in (None, ray):
        paths = MotionPaths(positions, sigma=np.full(270, 0.012), ray=known)
        bodies = find_motion_bodies(paths, MotionBodiesSettings(bodies=3))
        true = [np.bincount(three.body[bodies.label == b]).argmax() for b in range(3)]
        difference = np.swapaxes(bodies.rotations, 2, 3) @ three.rotations[:, true]
        errors.append(np.rad2deg(turn_angles(difference)).mean())
    assert errors[1] < 0.4 * errors[0]


def test_joints_hinges_and_tree_of_a_chain(three, found):
    result, _ = refine_skeleton(find_motion_skeleton(found, 30.0), found, MotionPaths(three.positions))
    skeleton = result.skeleton
    assert len(skeleton.joint_positions[0]) == 2
    # the middle body is connected to both others
    middle = np.bincount(found.label[three.body == 1]).argmax()
    assert (skeleton.joint_bodies == middle).any(axis=1).all()
    for position, joint in zip(skeleton.joint_positions[0], result.joints, strict=True):
        true = int(np.linalg.norm(three.joints - position, axis=1).argmin())
        across = three.joints[true] - position
        across -= three.axes[true] * (across @ three.axes[true])
        assert np.linalg.norm(across) < 0.003
        assert np.linalg.norm(three.joints[true] - position) < 0.04  # along the axis the border decides
        assert joint.hinge
        assert np.rad2deg(np.arccos(min(1.0, abs(joint.axis @ three.axes[true])))) < 1.0


def test_where_on_its_axis_a_hinge_is():
    rng = np.random.default_rng(12)
    chest = rng.random((400, 3)) * [1.0, 0.5, 0.3]
    x, z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])

    def middle(other, border, point, axis):
        sides = chest[np.linalg.norm(chest - border, axis=1) < 0.3], other[np.linalg.norm(other - border, axis=1) < 0.3]
        return Border(0.0, sides, (chest, other)).middle_along(np.array(point), axis)

    # a lid beside the box: the lid's middle
    lid = rng.random((200, 3)) * [0.6, 0.5, 0.02] + [0.2, 0.0, 0.3]
    np.testing.assert_allclose(middle(lid, [0.2, 0.0, 0.3], [0.1, 0.0, 0.3], x), [0.5, 0.0, 0.3], atol=0.02)
    # a tower on top: where it stands
    tower = rng.random((200, 3)) * [0.2, 0.2, 1.0] + [0.4, 0.2, 0.3]
    np.testing.assert_allclose(middle(tower, [0.5, 0.3, 0.3], [0.5, 0.3, 0.9], z), [0.5, 0.3, 0.3], atol=0.07)
    # so does a head that is nearly as wide as high
    head = rng.random((200, 3)) * [0.3, 0.3, 0.18] + [0.35, 0.1, 0.3]
    np.testing.assert_allclose(middle(head, [0.5, 0.25, 0.3], [0.5, 0.25, 0.9], z), [0.5, 0.25, 0.3], atol=0.05)
    # a wheel at the side: the wheel's middle
    wheel = rng.random((200, 3)) * [0.1, 0.5, 0.5] + [1.0, 0.0, -0.1]
    np.testing.assert_allclose(middle(wheel, [1.0, 0.25, 0.15], [0.3, 0.25, 0.15], x), [1.05, 0.25, 0.15], atol=0.02)


def test_joints_stay_fixed_in_both_bodies_and_follow_forward_kinematics(found):
    skeleton = find_motion_skeleton(found, 30.0).skeleton
    bones = (skeleton.hierarchy, skeleton.offsets, skeleton.local_rotations, skeleton.root_positions)
    np.testing.assert_allclose(forward_kinematics(*bones)[0], skeleton.joint_positions, atol=1e-9)
    between = np.linalg.norm(skeleton.joint_positions[:, 0] - skeleton.joint_positions[:, 1], axis=1)
    siblings = skeleton.joint_bodies[0, 0] == skeleton.joint_bodies[1, 0]
    chained = skeleton.joint_bodies[0, 1] == skeleton.joint_bodies[1, 0]
    assert siblings or chained
    np.testing.assert_allclose(between, between[0], atol=1e-9)


def test_points_of_any_frame_get_the_bodies_of_the_samples(three, found):
    voters = Voters.of(found, MotionPaths(three.positions))
    rng = np.random.default_rng(5)
    for frame in (0, 13):
        points = three.positions[:, frame] + rng.normal(scale=0.003, size=(len(three.body), 3))
        labels = label_points(voters, frame, points)
        assert labels.dtype == np.int32
        assert (labels == found.label).mean() > 0.95
    assert len(label_points(voters, 0, np.empty((0, 3)))) == 0


def test_tracks_may_lie_on_one_another(three):
    motion = find_motion(np.repeat(three.positions, 2, axis=0), fps=30)
    once = find_motion(three.positions, fps=30)
    assert motion.voters.spacing == pytest.approx(once.voters.spacing, rel=0.05)
    assert same_partition(motion.label(0, three.positions[:, 0]), three.body) > 0.97


def test_wrong_paths_are_refused(three):
    with pytest.raises(GeometryError, match="expected \\(N, T, 3\\)"):
        MotionPaths(np.zeros((4, 3)))
    with pytest.raises(GeometryError, match="sigma"):
        MotionPaths(three.positions, sigma=np.ones(3))
    with pytest.raises(GeometryError, match="without any position"):
        MotionPaths(np.full((4, 5, 3), np.nan))
    with pytest.raises(GeometryError, match="5 samples"):
        find_motion_bodies(MotionPaths(three.positions[:5]))


def test_common_point_of_two_motions_and_its_axis():
    rng = np.random.default_rng(8)
    point = np.array([0.3, -0.2, 0.5])
    first = Rotation.from_rotvec(rng.normal(scale=0.3, size=(40, 3)))
    for hinge in (True, False):
        turns = rng.normal(scale=0.5, size=(40, 3))
        if hinge:
            turns = turns[:, :1] * np.array([0.0, 0.6, 0.8])
        second = first * Rotation.from_rotvec(turns)
        rotations = first.as_matrix(), second.as_matrix()
        start = rng.normal(scale=0.2, size=(40, 3))
        translations = start, start + rotations[0] @ point - rotations[1] @ point
        near = point + (np.array([0.0, 0.06, 0.08]) if hinge else np.array([0.1, 0.0, 0.0]))
        joint = common_point(rotations, translations, np.ones(40), near, 1e-6, 1.0, 1e-4)
        if hinge:  # along the axis the prior decides
            np.testing.assert_allclose(joint.point, near, atol=1e-4)
            np.testing.assert_allclose(np.abs(joint.axis), [0.0, 0.6, 0.8], atol=1e-3)
            assert joint.std[2] > 10 * joint.std[0]
        else:
            np.testing.assert_allclose(joint.point, point, atol=1e-4)


def test_joint_of_motions_that_do_not_tell_stays_at_the_interface():
    rng = np.random.default_rng(2)
    turns = Rotation.from_rotvec(rng.normal(scale=0.05, size=(40, 3)))  # hardly any, and the bodies come apart
    rotations = np.broadcast_to(np.eye(3), (40, 3, 3)), turns.as_matrix()
    near = np.array([0.2, 0.1, 1.0])
    apart = rng.normal(scale=0.05, size=(40, 3)) + np.array([0.3, 0.0, 0.0]) * rng.normal(size=(40, 1))
    translations = np.zeros((40, 3)), near - rotations[1] @ near + apart

    def away(spread: float) -> float:
        joint = common_point(rotations, translations, np.ones(40), near, 0.0, spread, 1e-4)
        return float(np.linalg.norm(joint.point - near))

    assert away(1e3) > 0.5 and away(0.05) < 0.05


def test_joint_of_motions_that_err_alike_in_all_frames_stays_where_bodies_touch():
    rng = np.random.default_rng(4)
    turns = Rotation.from_rotvec(np.linspace(-0.2, 0.2, 100)[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    still = np.broadcast_to(np.eye(3), (100, 3, 3))
    joint, deeper = np.array([0.1, 0.2, 0.5]), np.array([0.15, 0.0, 0.0])  # the second body is taken to lie deeper
    shifts = joint + deeper - turns @ (joint + deeper) + rng.normal(scale=0.01, size=(100, 3))
    near = joint + np.array([0.02, 0.0, 0.01])

    def missed(independence: float) -> float:
        motions = (still, turns), (np.zeros((100, 3)), shifts)
        point = common_point(*motions, np.ones(100), near, 0.005, 0.05, 4e-4, independence).point
        return float(np.linalg.norm(point - joint))

    assert missed(INDEPENDENT) > 0.08 and missed(0.0) < 0.5 * missed(INDEPENDENT)


def test_skeleton_of_found_depths_is_nearer_to_the_borders(found):
    shaken = np.random.default_rng(3).normal(scale=0.01, size=found.translations.shape)
    bodies = replace(found, translations=found.translations + shaken)

    def away(depths_found: bool) -> float:
        skeleton = find_motion_skeleton(bodies, 30.0, depths_found=depths_found)
        off = [j.point - b.middle for j, b in zip(skeleton.joints, skeleton.borders, strict=True)]
        return float(np.linalg.norm(off, axis=1).max())

    assert away(True) < 0.9 * away(False)


def test_precision_beyond_what_surfaces_give_hardly_counts():
    positions = np.zeros((3, 2, 3))
    positions[1:, :, 0] = [[1.0], [2.0]]
    paths = MotionPaths(positions, sigma=np.array([1e-5, 1e-4, 0.1]))  # 2 m long: surfaces give 2 mm
    precise, usual, poor = paths.weights()[:, 0]
    assert usual == 1.0 and 1.0 < precise < 1.01
    np.testing.assert_allclose(poor, 0.002**2 / 0.1**2, rtol=0.01)
