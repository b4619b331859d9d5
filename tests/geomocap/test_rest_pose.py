from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.angles.anatomical_frames import anatomical_frames
from geomocap.angles.joint_angles import joint_angles
from geomocap.export.export_errors import MotionError
from geomocap.export.rest_pose import at_rest
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.skinned_mesh import bone_mesh
from geomocap.naming.found_names import find_names
from geomocap.naming.name_templates import read_template
from tests.geomocap.template_figures import figure, with_a_thigh_in_two

HUMAN, QUADRUPED = (read_template(name) for name in ("human", "quadruped"))


@pytest.mark.parametrize("pose", ["T", "A"])
def test_a_rest_pose_is_the_same_whatever_the_first_frame(pose):
    skeleton, labels = figure(HUMAN, turn=0.7)
    turned = []
    for first in (0, 6):
        rotations = skeleton.body_rotations[first:] @ np.swapaxes(skeleton.body_rotations[first], 1, 2)
        # joints and centres stay where they are; only the frame in which nothing is turned is another one
        begun = replace(
            skeleton,
            body_rotations=rotations,
            joint_positions=skeleton.joint_positions[first:],
            body_positions=skeleton.body_positions[first:],
        )
        found = find_names(begun, 2)
        frames = anatomical_frames(begun, found)
        rested, _ = at_rest(motion_from_skeleton(begun), None, found, pose, frames)
        R, _ = rested.forward_kinematics()
        node = {labels[b]: n for n, b in enumerate(rested.bodies)}
        turned.append({name: R[-1, node["pelvis"]].T @ R[-1, n] for name, n in node.items()})
    for name in ("upper_arm_left", "upper_arm_right", "forearm_left", "forearm_right", "thorax"):
        between = Rotation.from_matrix(turned[0][name] @ turned[1][name].T)
        assert np.rad2deg(between.magnitude()) < 2, name


def test_elbows_bend_forward_in_a_rest_pose():
    skeleton, labels = figure(HUMAN, turn=0.7)
    found = find_names(skeleton, 2)
    frames = anatomical_frames(skeleton, found)
    rested, _ = at_rest(motion_from_skeleton(skeleton), None, found, "T", frames)
    R, _ = rested.forward_kinematics()
    elbow = {labels[b]: n for n, b in enumerate(rested.bodies)}["forearm_left"]
    t = int(np.argmax(joint_angles(skeleton, found, tuple(skeleton.joint_names)).column("elbow_left_flexion")))
    bent = np.einsum("tji,tjk->tik", R[:, rested.parents[elbow]], R[:, elbow])[t]
    hand = bent @ np.array([1.0, 0, 0])  # the forearm points to the left in the pose, which looks along -y
    forward, up = -hand[1], abs(hand[2])
    assert forward > 0.2 and up < forward / 2


@pytest.mark.parametrize("pose", ["T", "A"])
def test_a_rest_pose_changes_the_skeleton_but_not_the_motion(pose):
    skeleton, labels = figure(HUMAN, turn=0.7)
    found = find_names(skeleton, 2)
    motion = motion_from_skeleton(skeleton)
    mesh = bone_mesh(motion)
    rested, bound = at_rest(motion, mesh, found, pose)
    assert rested.largest_deviation_mm(skeleton.joint_positions) < 1e-6
    assert bound is not None
    assert bound.bind_frame is None
    assert np.abs(bound.posed(rested) - mesh.posed(motion)).max() < 1e-9
    R, p = rested.bind_pose(None)
    assert np.abs(R - np.eye(3)).max() == 0
    place = {labels[b]: p[n] for n, b in enumerate(rested.bodies)}
    left = np.array([1.0, 0, 0])  # the pose looks along -y, +z of the files
    along = place["hand_left"] - place["upper_arm_left"]
    wanted = left if pose == "T" else (left - [0, 0, 1]) / np.sqrt(2)
    assert along @ wanted > 0.98 * np.linalg.norm(along)
    leg = place["foot_right"] - place["thigh_right"]
    assert leg[2] < -0.99 * np.linalg.norm(leg)


def test_a_rest_pose_of_a_person_needs_a_person():
    skeleton, _ = figure(QUADRUPED)
    with pytest.raises(MotionError, match="rest pose"):
        at_rest(motion_from_skeleton(skeleton), None, find_names(skeleton, 2), "T")


def test_a_piece_of_a_limb_hangs_beside_the_chain_in_a_rest_pose(tmp_path):
    skeleton, labels = with_a_thigh_in_two(tmp_path, 0.42)
    found = find_names(skeleton, 2, templates=[HUMAN])
    motion = motion_from_skeleton(skeleton)
    mesh = bone_mesh(motion)
    rested, bound = at_rest(motion, mesh, found, "T", anatomical_frames(skeleton, found))
    assert rested.largest_deviation_mm(skeleton.joint_positions) < 1e-6
    assert bound is not None and np.abs(bound.posed(rested) - mesh.posed(motion)).max() < 1e-9
    pieces = {b for b in range(skeleton.body_count) if b not in found.whole}
    assert {labels[b] for b in pieces} & {"thigh_left", "thigh_low_left"} and len(pieces) == 1
    (piece,) = (n for n, b in enumerate(rested.bodies.tolist()) if b in pieces)
    assert not rested.children(piece) and np.isfinite(rested.tips[piece]).all()
    thigh = next(n for n, b in enumerate(rested.bodies) if found.bodies.get(b) == "thigh_left")
    assert found.bodies[rested.bodies[rested.parents[thigh]]] == "pelvis"
    mine = next(n for n, b in enumerate(motion.bodies) if found.bodies.get(b) == "thigh_left")
    before, after = (m.forward_kinematics()[0][:, n] for m, n in ((motion, mine), (rested, thigh)))
    turned = np.einsum("tji,tjk->tik", before, after)
    assert np.abs(turned - turned[0]).max() < 1e-9  # the same turns from another rest
