import re

import numpy as np
import pytest

from geomocap.export.bvh import read_bvh, write_bvh
from geomocap.export.conventions import BVH, Convention
from geomocap.export.export_errors import MotionError
from geomocap.export.skeleton_motion import motion_from_skeleton
from tests.geomocap.articulated import articulated_skeleton, skeleton_arrays, skeleton_of

KINDS = [{}, {"jump_mm": 15.0}, {"wander_mm": 10.0}]


def joints_of(back, motion, convention=BVH):
    """World positions of the joints, (T, J, 3), of a motion that was read back."""
    p = convention.world_points(back.forward_kinematics()[1] * 1.0, "z")
    positions = np.empty((len(p), (motion.joints >= 0).sum(), 3))
    for node, joint in enumerate(motion.joints):
        if joint >= 0:
            positions[:, joint] = p[:, back.names.index(motion.names[node])]
    return positions


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("unit", ["m", "cm"])
def test_read_back_by_ourselves(tmp_path, kind, unit):
    arrays = skeleton_arrays(**kind)
    motion = motion_from_skeleton(skeleton_of(arrays))
    write_bvh(tmp_path / "m.bvh", motion, unit=unit)
    back = read_bvh(tmp_path / "m.bvh", unit=unit)
    np.testing.assert_allclose(joints_of(back, motion), arrays["joint_positions"], atol=1e-5)
    assert back.fps == pytest.approx(motion.fps)


@pytest.mark.parametrize("kind", KINDS)
def test_read_back_by_an_independent_reader(tmp_path, kind):
    bvhsdk = pytest.importorskip("bvhsdk")
    arrays = skeleton_arrays(**kind)
    motion = motion_from_skeleton(skeleton_of(arrays))
    write_bvh(tmp_path / "m.bvh", motion)
    other = bvhsdk.ReadFile(str(tmp_path / "m.bvh"))
    assert other.frames == 20
    assert 1 / other.frametime == pytest.approx(15)
    for node, joint in enumerate(motion.joints):
        if joint >= 0:
            bone = other.getJoint(motion.names[node])
            y_up = np.array([bone.getPosition(t) for t in range(20)])
            world = y_up[:, [0, 2, 1]] * [1, -1, 1]
            np.testing.assert_allclose(world, arrays["joint_positions"][:, joint], atol=1e-4)


def test_channels_are_stated_and_tabs_indent(tmp_path):
    write_bvh(tmp_path / "m.bvh", motion_from_skeleton(articulated_skeleton()))
    text = (tmp_path / "m.bvh").read_text()
    assert "\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation" in text
    assert "\n\t\tCHANNELS 3 Zrotation Xrotation Yrotation\n" in text
    assert "\n " not in text
    assert "Frames: 20\nFrame Time: 0.0666666667\n" in text


def test_other_channel_orders(tmp_path):
    (tmp_path / "m.bvh").write_text(
        "HIERARCHY\nROOT a\n{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
        " JOINT b\n {\n  OFFSET 0 100 0\n  CHANNELS 3 Xrotation Yrotation Zrotation\n  End Site\n  {\n   OFFSET 0 5 0\n"
        "  }\n }\n}\nMOTION\nFrames: 2\nFrame Time: 0.04\n0 0 0 0 0 0 0 0 0\n0 0 50 90 0 90 0 0 0\n"
    )
    motion = read_bvh(tmp_path / "m.bvh", unit="cm")
    _, p = motion.forward_kinematics()
    # b lies up by 1 m; turned 90° about z it points to -x, then 90° about y to +z; the root moved by 0.5 m along z.
    np.testing.assert_allclose(p[1, 1], [0, 0, 1.5], atol=1e-9)
    np.testing.assert_allclose(motion.tips[1], [0, 0.05, 0])
    assert motion.fps == pytest.approx(25)


def test_centimetres_are_a_hundred_times_metres():
    p = np.array([[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(Convention("y", "cm").points(p, "y"), 100 * BVH.points(p, "y"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda s: "", "no BVH"),
        (lambda s: s.replace("HIERARCHY", ""), "no BVH"),
        (lambda s: s[: len(s) * 2 // 3], "it was cut off or edited"),
        (lambda s: s.replace("Frame Time: 0.0666666667", "Frame Time: 0"), "Frame Time is 0.0 s"),
        (lambda s: s.replace("Frames: 20", "Frames: 21"), "21 frames of 24 channels are 504 numbers"),
        (lambda s: s.replace("}", "", 1), "braces don't close"),
        (lambda s: s.replace("body03", "body02"), "the name body02 stands for two joints"),
        (lambda s: s.replace("Zrotation", "Wrotation", 1), "expected Xposition"),
        (lambda s: s.replace("OFFSET 0.", "OFFSET O.", 1), "is damaged near 'OFFSET O."),
        (lambda s: s[: s.index("Frame Time")] + re.sub(r"\n-?\d+\.\d+ ", "\nnan ", s[s.index("Frame Time") :]), "NaN"),
        (lambda s: s[:-5] + "x.yz\n", "no number"),
    ],
)
def test_broken_files(tmp_path, change, says):
    write_bvh(tmp_path / "m.bvh", motion_from_skeleton(articulated_skeleton()))
    text = change((tmp_path / "m.bvh").read_text())
    (tmp_path / "m.bvh").write_text(text)
    with pytest.raises(MotionError, match=says) as caught:
        read_bvh(tmp_path / "m.bvh")
    assert "m.bvh" in str(caught.value)
    assert "\n" not in str(caught.value)
