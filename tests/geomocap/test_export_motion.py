from dataclasses import replace

import numpy as np
import pytest

from geomocap.export.export_errors import MotionError
from geomocap.export.names import Names
from geomocap.export.skeleton_motion import motion_from_skeleton
from tests.geomocap.articulated import articulated_skeleton, skeleton_arrays, skeleton_of


def deviation(motion, arrays):
    return motion.largest_deviation_mm(arrays["joint_positions"])


def test_fixed_joints_need_no_translations():
    arrays = skeleton_arrays()
    motion = motion_from_skeleton(skeleton_of(arrays))
    assert motion.moving.tolist() == [True] + [False] * 6
    assert deviation(motion, arrays) < 1e-9


def test_world_rotations_are_the_bodies():
    arrays = skeleton_arrays()
    motion = motion_from_skeleton(skeleton_of(arrays))
    R, _ = motion.forward_kinematics()
    np.testing.assert_allclose(R, arrays["body_rotations"][:, motion.bodies], atol=1e-12)


def test_a_wandering_centre_does_not_unfix_the_joints():
    arrays = skeleton_arrays(wander_mm=20)
    motion = motion_from_skeleton(skeleton_of(arrays))
    assert motion.moving.sum() == 1
    assert deviation(motion, arrays) < 1e-9


def test_jumping_joints_move_by_default_and_are_reported_when_fixed():
    arrays = skeleton_arrays(jump_mm=20)
    assert deviation(motion_from_skeleton(skeleton_of(arrays)), arrays) < 1e-9
    fixed = motion_from_skeleton(skeleton_of(arrays), joints="fixed")
    assert fixed.moving.sum() == 1
    assert 20 < deviation(fixed, arrays) < 300


def test_a_body_without_joints():
    arrays = skeleton_arrays(n_bodies=1)
    motion = motion_from_skeleton(skeleton_of(arrays))
    np.testing.assert_allclose(motion.forward_kinematics()[1][:, 0], arrays["body_positions"][:, 0])


@pytest.mark.parametrize("size", [0.05, 1.0, 20.0])
@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_end_bones_are_as_large_as_the_subject_and_point_up(size, up):
    arrays = skeleton_arrays()
    leaf = int(np.setdiff1d(arrays["joint_bodies"][:, 1], arrays["joint_bodies"][:, 0])[0])
    joint = int(np.flatnonzero(arrays["joint_bodies"][:, 1] == leaf)[0])
    arrays["body_positions"][:, leaf] = arrays["joint_positions"][:, joint]
    whole = motion_from_skeleton(skeleton_of(arrays), up=up)
    arrays |= {k: size * arrays[k] for k in ("joint_positions", "body_positions")}
    motion = motion_from_skeleton(skeleton_of(arrays), up=up)
    np.testing.assert_allclose(motion.tips, size * whole.tips)
    tip = motion.tips[motion.bodies.tolist().index(leaf)]
    assert tip @ np.eye(3)["xyz".index(up)] == pytest.approx(np.linalg.norm(tip))
    assert 0.01 * size < np.linalg.norm(tip) < 0.1 * size


def test_a_single_body_has_a_bone_of_its_own_size():
    motion = motion_from_skeleton(articulated_skeleton(n_bodies=1), up="y", radius=0.004)
    np.testing.assert_allclose(motion.tips, [[0, 0.004, 0]])


def test_missing_joints_are_filled_from_the_body():
    arrays = skeleton_arrays()
    gappy = dict(arrays, joint_positions=arrays["joint_positions"].copy())
    gappy["joint_positions"][4:8, 2] = np.nan
    motion = motion_from_skeleton(skeleton_of(gappy))
    assert deviation(motion, arrays) < 1e-2  # the root's origin comes from its centre then


def test_missing_rotations_are_filled():
    arrays = skeleton_arrays()
    arrays["body_rotations"][5, 3] = np.nan
    motion = motion_from_skeleton(skeleton_of(arrays))
    R, _ = motion.forward_kinematics()
    assert np.isfinite(R).all()
    np.testing.assert_allclose(np.linalg.det(R), 1)


def test_motion_checks_itself():
    motion = motion_from_skeleton(articulated_skeleton())
    with pytest.raises(MotionError, match="two nodes are called body00"):
        replace(motion, names=("body00",) * 7)
    with pytest.raises(MotionError, match="hold NaN"):
        replace(motion, translations=motion.translations * np.nan)


def test_names_of_the_user(tmp_path):
    file = tmp_path / "names.toml"
    file.write_text("pelvis = 0\nthigh_left = 1\n[joints]\nhip_right = 2\n")
    arrays = skeleton_arrays()
    names = Names.read(file)
    motion = motion_from_skeleton(skeleton_of(arrays), names=names)
    assert motion.names[0] == "pelvis"
    assert motion.names[motion.bodies.tolist().index(1)] == "thigh_left"
    bodies = names.body_names(7)
    joints = names.joint_names(arrays["joint_bodies"], bodies, arrays["joint_names"])
    assert joints[0] == "joint_pelvis_thigh_left"
    assert joints[2] == "hip_right"


def test_a_body_s_number_is_no_name_of_another():
    found = ["hips", "thigh", "shank"]
    assert Names({0: "body00", 1: "body07"}).body_names(3, found) == ("body00", "body07", "shank")
    with pytest.raises(MotionError, match="the name body01 stands for two things"):
        Names({0: "body01"}).over({1: "knee"}, {}).body_names(3, found)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("thigh = 'left'", "thigh = 'left'; expected the number of a body"),
        ("a = 1\nb = 1", "body 1 is named twice, a and b"),
        ("thigh = 99", "thigh names body 99, but there are 7 bodies"),
        ("'left thigh' = 1", "'left thigh' is no usable name"),
        ("body02 = 1", "the name body02 stands for two things"),
        ("= 3", "not valid TOML"),
    ],
)
def test_bad_names(tmp_path, text, says):
    file = tmp_path / "names.toml"
    file.write_text(text)
    with pytest.raises(MotionError, match=says):
        motion_from_skeleton(articulated_skeleton(), names=Names.read(file))
