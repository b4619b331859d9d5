from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.model.hierarchy import Hierarchy
from geomocap.model.skeleton import Skeleton
from geomocap.segmentation.axis_joints import grow_joints
from geomocap.segmentation.body_connections import connect_bodies
from geomocap.segmentation.m3 import segment_m3
from geomocap.segmentation.m3_result import Segmentation
from geomocap.segmentation.m3_settings import SegmentationSettings
from geomocap.segmentation.skeleton_settings import SkeletonSettings
from geomocap.skeleton.bone_motion import fit_motion, fit_offsets, forward_kinematics
from geomocap.skeleton.m3_skeleton import skeleton_m3
from tests.geomocap.articulated import alike
from tests.geomocap.segmentation_scenes import hinged_arm

SPACING = 0.008
SETTINGS = SegmentationSettings(max_depth=4, merge_error=1.0)
CHAIN = Hierarchy(0, np.array([[0, 1], [1, 2], [0, 3]], np.int32))


def chain_motion(frames: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Known bones and turns: offsets, body_offsets, world rotations, root, joint positions."""
    rng = np.random.default_rng(0)
    offsets = np.array([[0.3, 0, 0.1], [0.4, 0.1, 0], [-0.2, 0.3, 0]])
    body_offsets = np.array([[0.0, 0, 0], [0.2, 0.05, 0], [0.15, 0, 0.1], [-0.1, 0.2, 0]])
    t = np.linspace(0, 3, frames)[:, None]
    curves = np.sin(t * rng.uniform(1, 3, 4))[:, :, None] * rng.normal(size=(4, 3)) * 0.6
    local = Rotation.from_rotvec(curves.reshape(-1, 3)).as_matrix().reshape(frames, 4, 3, 3)
    root = np.cumsum(rng.normal(size=(frames, 3)) * 0.01, axis=0)
    joints, world = forward_kinematics(CHAIN, offsets, local, root)
    return offsets, body_offsets, world, root, joints


def centers_of(body_offsets, world, root, joints) -> np.ndarray:
    own = CHAIN.body_joints
    starts = np.stack([root if own[b] < 0 else joints[:, own[b]] for b in range(4)], axis=1)
    return starts + np.einsum("tbij,bj->tbi", world, body_offsets)


def grow_reference(centers, radii, rotations, pair, step):
    """One joint of one frame, as the paper tells it."""
    for n in range(10000):
        inside = []
        for k, other in (pair, pair[::-1]):
            for axis in range(3):
                for sign in (-1, 1):
                    if n * step <= radii[k, axis]:
                        sample = centers[k] + sign * n * step * rotations[k][:, axis]
                        local = (sample - centers[other]) @ rotations[other]
                        if ((local / radii[other]) ** 2).sum() <= 1:
                            inside.append(sample)
        if inside:
            return np.mean(inside, axis=0)
    return None


def test_growing_agrees_with_the_slow_way():
    rng = np.random.default_rng(1)
    radii = np.sort(rng.uniform(0.2, 0.5, size=(4, 5, 3)))[..., ::-1].copy()
    centers = rng.uniform(-0.3, 0.3, size=(4, 5, 3))
    rotations = Rotation.random(20, rng=rng).as_matrix().reshape(4, 5, 3, 3)
    pairs = np.array([[0, 1], [1, 2], [3, 4]], np.int32)
    positions, overlapping = grow_joints(centers, radii, rotations, pairs, 0.01)
    checked = 0
    for t in range(4):
        for j, pair in enumerate(pairs.tolist()):
            if overlapping[t, j]:
                expected = grow_reference(centers[t], radii[t], rotations[t], pair, 0.01)
                np.testing.assert_allclose(positions[t, j], expected, atol=1e-12)
                checked += 1
    assert checked > 6


def test_joint_of_touching_ends_and_of_apart_bodies():
    centers = np.array([[[0.0, 0, 0], [0.9, 0, 0], [3.0, 0, 0]]])
    radii = np.tile([0.5, 0.1, 0.1], (1, 3, 1))
    rotations = np.tile(np.eye(3), (1, 3, 1, 1))
    positions, overlapping = grow_joints(centers, radii, rotations, np.array([[0, 1], [0, 2]], np.int32), 0.001)
    np.testing.assert_allclose(positions[0, 0], [0.45, 0, 0], atol=0.002)  # the ends reach in equally far
    np.testing.assert_allclose(positions[0, 1], [1.5, 0, 0], atol=1e-9)
    assert overlapping.tolist() == [[True, False]]


def test_connections_go_on_where_there_is_most_contact():
    contacts = np.zeros((4, 4))
    for a, b, amount in [(0, 1, 2), (0, 2, 9), (1, 2, 5), (1, 3, 4), (2, 3, 3)]:
        contacts[a, b] = contacts[b, a] = amount
    tree = connect_bodies(contacts, np.ones((4, 4)), np.zeros((1, 4, 3)), 0.5)
    assert tree.joint_bodies.tolist() == [[0, 2], [2, 1], [1, 3]]


def test_connections_follow_contact_that_lasts():
    contacts = np.zeros((5, 5))
    touching = np.zeros((5, 5))
    for a, b, amount, fraction in [(0, 1, 9, 1.0), (1, 2, 5, 0.9), (0, 2, 50, 0.1), (0, 3, 3, 0.2)]:
        contacts[a, b] = contacts[b, a] = amount
        touching[a, b] = touching[b, a] = fraction
    centers = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [0, 2, 0]]])
    tree = connect_bodies(contacts, touching, centers, 0.5)
    # 2 touches 0 much but seldom; 3 touches 0 alone; 4 touches nothing and is nearest to 3
    assert tree.joint_bodies.tolist() == [[0, 1], [1, 2], [0, 3], [3, 4]]
    assert tree.parents.tolist() == [-1, 0, 1, 0, 3]
    assert tree.body_joints.tolist() == [-1, 0, 1, 2, 3]


@pytest.mark.parametrize("pairs", [[[0, 1], [1, 0]], [[1, 2], [0, 1]], [[0, 1], [0, 1]]])
def test_no_tree_no_hierarchy(pairs):
    with pytest.raises(GeometryError, match="no tree"):
        Hierarchy(0, np.array(pairs, np.int32))


def test_forward_kinematics_by_hand():
    turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    local = np.tile(np.eye(3), (1, 4, 1, 1))
    local[0, 0] = turn
    local[0, 1] = turn
    offsets = np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    joints, world = forward_kinematics(CHAIN, offsets, local, np.array([[5.0, 0, 0]]))
    np.testing.assert_allclose(joints[0], [[5, 1, 0], [4, 1, 0], [4, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(world[0, 1], turn @ turn, atol=1e-12)
    np.testing.assert_allclose(CHAIN.local_rotations(world), local, atol=1e-12)


def test_offsets_of_known_bones_are_recovered():
    offsets, body_offsets, world, root, joints = chain_motion()
    centers = centers_of(body_offsets, world, root, joints)
    found, found_body = fit_offsets(CHAIN, world, root, joints, centers)
    np.testing.assert_allclose(found, offsets, atol=1e-4)
    np.testing.assert_allclose(found_body, body_offsets, atol=1e-4)


def test_wrong_rotations_are_turned_towards_the_joints():
    _, body_offsets, world, root, joints = chain_motion()
    # frame 0 is the rest pose
    since_start = np.einsum("tbij,bkj->tbik", world, world[0])
    centers = centers_of(body_offsets, world, root, joints)
    rng = np.random.default_rng(2)
    noise = Rotation.from_rotvec(rng.normal(size=(world.shape[0] * 4, 3)) * 0.3).as_matrix()
    noisy = noise.reshape(world.shape) @ since_start
    noisy[0] = np.eye(3)
    turned, offsets, _ = fit_motion(CHAIN, noisy, root, joints, centers)
    fitted, _ = forward_kinematics(CHAIN, offsets, CHAIN.local_rotations(turned), root)
    before, _ = fit_offsets(CHAIN, noisy, root, joints, centers)
    unfitted, _ = forward_kinematics(CHAIN, before, CHAIN.local_rotations(noisy), root)
    miss = np.linalg.norm(fitted - joints, axis=-1).mean()
    assert miss < 0.6 * np.linalg.norm(unfitted - joints, axis=-1).mean()
    np.testing.assert_array_equal(turned[0], np.tile(np.eye(3), (4, 1, 1)))
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)


@pytest.fixture(scope="module")
def segmentation() -> Segmentation:
    points, _, _ = hinged_arm()
    return segment_m3(points, spacing=SPACING, settings=SETTINGS)


@pytest.fixture(scope="module", params=[True, False], ids=["fixed", "found"])
def skeleton(request, segmentation) -> Skeleton:
    return skeleton_m3(segmentation, 15, SkeletonSettings(fixed_joints=request.param))


def test_hinge_is_found(segmentation, skeleton):
    # the capsules end 1 cm from the hinge at the origin: one of the joints must stay there
    nearest = np.linalg.norm(skeleton.joint_positions, axis=-1).min(axis=1)
    assert np.median(nearest) < 0.06


def test_fixed_joints_are_the_forward_kinematics(skeleton):
    bones = (skeleton.hierarchy, skeleton.offsets, skeleton.local_rotations, skeleton.root_positions)
    positions = forward_kinematics(*bones)[0]
    if skeleton.fixed_joints:
        np.testing.assert_array_equal(skeleton.joint_positions, positions)
    else:
        assert 0 < np.linalg.norm(skeleton.joint_positions - positions, axis=-1).mean() < 0.08


def test_skeleton_keeps_its_promises(segmentation, skeleton):
    bodies = segmentation.body_count
    assert skeleton.joint_positions.shape[1] == bodies - 1
    assert skeleton.joint_names[0] == f"joint_{skeleton.body_names[skeleton.joint_bodies[0, 0]]}_body01"
    assert len(set(skeleton.joint_names.tolist())) == bodies - 1
    np.testing.assert_allclose(skeleton.body_rotations[0], np.tile(np.eye(3), (bodies, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(skeleton.body_rotations), 1.0)
    steps = np.einsum("tbji,tbjk->tbik", skeleton.body_rotations[:-1], skeleton.body_rotations[1:])
    assert Rotation.from_matrix(steps.reshape(-1, 3, 3)).magnitude().max() < 1.2  # no axis flips
    assert skeleton.hierarchy.parents[skeleton.root] == -1


def test_the_same_twice(segmentation, skeleton):
    again = skeleton_m3(segmentation, 15, SkeletonSettings(fixed_joints=skeleton.fixed_joints))
    alike(skeleton, again)


def test_bad_shapes_are_refused(skeleton):
    with pytest.raises(GeometryError, match="offsets has shape"):
        replace(skeleton, offsets=skeleton.offsets[:-1])
    with pytest.raises(GeometryError, match="frames per second"):
        replace(skeleton, fps=0.0)


def test_single_scan_has_no_skeleton():
    points, _, _ = hinged_arm(frames=1)
    scan = segment_m3(points, spacing=SPACING, settings=SETTINGS)
    with pytest.raises(GeometryError, match="no rigid bodies"):
        skeleton_m3(scan, 15)


def test_one_body_is_a_skeleton_without_joints():
    points, _, _ = hinged_arm(frames=1)
    still = segment_m3(points * 3, spacing=SPACING, settings=SegmentationSettings(max_depth=4, merge_error=0))
    skeleton = skeleton_m3(still, 15)
    assert skeleton.joint_positions.shape == (3, 0, 3)
    assert skeleton.joint_names.dtype.kind == "U"
