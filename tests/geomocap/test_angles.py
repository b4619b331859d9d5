from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.angles.anatomical_frames import anatomical_frames, axes_on_sole
from geomocap.angles.joint_angles import joint_angles, turn_covariances
from geomocap.export.angle_files import mot_text
from geomocap.model.rotations import rotation_about
from geomocap.naming.found_names import FoundNames, find_names
from geomocap.naming.mean_posture import BodySurface
from geomocap.naming.name_templates import read_template
from tests.geomocap.articulated import skeleton_arrays, skeleton_of
from tests.geomocap.template_figures import figure

HUMAN = read_template("human")
LABELS = [f"{p}_{s}" if s else p for p, s in zip(HUMAN.parts, HUMAN.sides, strict=True)]
HAND = {side: LABELS.index(f"hand_{side}") for side in ("left", "right")}
BENDS = {"hip": ("thigh", -1), "knee": ("shank", 1), "elbow": ("forearm", -1), "shoulder": ("upper_arm", -1)}


def swing(part, side, frames=24):
    """The angle by which `figure` turns a part about the axis to the left, degrees."""
    t = np.arange(frames) / frames
    amplitude = HUMAN.mobility[HUMAN.parts.index(part)] / 3
    return np.rad2deg(amplitude * np.sin(2 * np.pi * t + (0 if side == "left" else np.pi)))


@pytest.mark.parametrize("turn", [0.0, 2.0])
@pytest.mark.parametrize("joint", list(BENDS))
@pytest.mark.parametrize("side", ["left", "right"])
def test_flexion_is_that_of_the_figure_whichever_way_it_faces(joint, side, turn):
    skeleton, _ = figure(HUMAN, turn=turn)
    angles = joint_angles(skeleton, find_names(skeleton, 2), tuple(skeleton.joint_names))
    part, sign = BENDS[joint]
    flexion = angles.column(f"{joint}_{side}_flexion")
    true = sign * swing(part, side)
    assert flexion - flexion[0] == pytest.approx(true - true[0], abs=0.01 if joint in ("knee", "elbow") else 0.6)


def test_a_straight_limb_has_no_flexion_and_a_bent_one_that_of_its_joints():
    skeleton, _ = figure(HUMAN)
    angles = joint_angles(skeleton, find_names(skeleton, 2), tuple(skeleton.joint_names))
    hip, knee, ankle = (HUMAN.joint_places[HUMAN.parts.index(p)] for p in ("thigh", "shank", "foot"))
    up, low = (knee - hip)[[0, 2]], (ankle - knee)[[0, 2]]
    bend = np.rad2deg(np.arccos(up @ low / np.linalg.norm(up) / np.linalg.norm(low)))
    assert angles.column("knee_left_flexion")[0] == pytest.approx(bend, abs=0.1)
    assert angles.column("knee_right_flexion")[0] == pytest.approx(bend, abs=0.1)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_forearm_that_has_its_hand_in_one_body_points_where_the_other_sides_does(side):
    skeleton, names = figure(HUMAN, without=[("hand", side)])
    plain, other = find_names(skeleton, 2), {"left": "right", "right": "left"}[side]
    assert plain.bodies[names.index(f"forearm_{side}")] == f"forearm_hand_{side}"
    number = {name: j for j, name in plain.joints.items()}
    elbow, wrist = (
        skeleton.joint_positions[0, number[f"{joint}_{other}"]] * [1, -1, 1] for joint in ("elbow", "wrist")
    )
    along = (wrist - elbow) / np.linalg.norm(wrist - elbow)
    bent = rotation_about(1, np.deg2rad(50.0)) @ along  # the hand
    reach = np.linspace(0, 1, 600)[:, None]
    ring = 0.03 * np.stack([np.cos(np.arange(600)), np.sin(np.arange(600)), np.zeros(600)], axis=1)
    arm = [elbow + reach * (wrist - elbow) + ring, wrist + 0.18 * reach * bent + ring]
    surface = BodySurface(np.concatenate(arm), np.full(1200, names.index(f"forearm_{side}")))
    joints = tuple(skeleton.joint_names)
    found = joint_angles(skeleton, replace(plain, surface=surface), joints)
    true = found.column(f"elbow_{other}_flexion")[0]  # the figure begins in a posture that is the same on both sides
    assert found.column(f"elbow_{side}_flexion")[0] == pytest.approx(true, abs=1.0)
    whole = replace(
        plain, surface=surface, joint_parts={j: p for j, p in plain.joint_parts.items() if p != HAND[other]}
    )
    assert abs(joint_angles(skeleton, whole, joints).column(f"elbow_{side}_flexion")[0] - true) > 5


def test_all_angles_are_zero_where_the_user_says():
    skeleton, _ = figure(HUMAN)
    angles = joint_angles(skeleton, find_names(skeleton, 2), tuple(skeleton.joint_names), zero_frame=7)
    zero = [k for k, n in enumerate(angles.names) if n.endswith(("flexion", "adduction", "rotation", "turn"))]
    assert np.abs(angles.values[7, zero]).max() < 1e-6
    assert np.abs(angles.values[0, zero]).max() > 5


def test_without_left_and_right_joints_turn_about_their_own_axes():
    skeleton, _ = figure(HUMAN)
    assert anatomical_frames(skeleton, FoundNames()) is None
    angles = joint_angles(skeleton, FoundNames(), tuple(f"j{j}" for j in range(skeleton.joint_count)))
    assert angles.names[:2] == ("j0_turn", "j0_off_axis")
    for k in range(0, len(angles.names), 2):
        assert np.ptp(angles.values[:, k]) > 5
        assert angles.values[:, k + 1].max() < 1e-6


def test_frames_without_rotation_have_no_angles():
    arrays = skeleton_arrays(3)
    arrays["body_rotations"][4, 1] = np.nan
    skeleton = skeleton_of(arrays)
    angles = joint_angles(skeleton, FoundNames(), ("a", "b"))
    assert np.isnan(angles.values[4]).any()
    assert np.isfinite(angles.values[[3, 5]]).all()


def test_the_uncertainty_of_turns_is_that_of_repeated_measurements():
    rng = np.random.default_rng(4)
    frames, count, noise = 400, 60, 0.003
    rest = rng.uniform(-1, 1, (count, 3)) * [0.05, 0.1, 0.3]
    true = rotation_about(2, np.linspace(0, 1, frames))
    seen = np.einsum("tij,nj->nti", true, rest) + rng.normal(0, noise, (count, frames, 3))
    measured = np.empty_like(true)
    for t in range(frames):
        u, _, vt = np.linalg.svd((seen[:, t] - seen[:, t].mean(0)).T @ (rest - rest.mean(0)))
        measured[t] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    error = Rotation.from_matrix(measured @ np.swapaxes(true, 1, 2)).as_rotvec()
    covariances = turn_covariances(measured[:, None], seen, np.zeros(count, int))[:, 0]
    local = np.einsum("tji,tj->ti", true, error)
    predicted = np.einsum("tji,tjk,tkl->til", true, covariances, true).mean(axis=0)
    assert np.sqrt(np.diag(predicted)) == pytest.approx(local.std(axis=0), rel=0.15)


def test_a_motion_file_says_its_size_and_unit():
    text = mot_text("angles", ("a", "b"), np.array([0.0, 0.1]), np.array([[1.0, 2], [3, 4]]), degrees=True)
    lines = text.splitlines()
    assert {"nRows=2", "nColumns=3", "inDegrees=yes"} <= set(lines)
    assert lines[lines.index("endheader") + 1].split("\t") == ["time", "a", "b"]
    assert [float(v) for v in lines[-1].split("\t")] == [0.1, 3, 4]


@pytest.mark.parametrize("pointed_deg", [-20.0, 0.0, 35.0])
def test_a_foot_lies_along_its_sole(pointed_deg):
    rng = np.random.default_rng(0)
    corners = np.array([[-0.06, -0.08], [0.20, -0.08], [0.20, -0.05], [0.02, 0.0], [-0.05, 0.0]])  # heel, toes, instep
    shares = rng.dirichlet(np.ones(len(corners)) * 0.3, 4000)
    inside = np.column_stack([shares @ corners, rng.uniform(-0.04, 0.04, 4000)])
    shank = Rotation.random(random_state=1).as_matrix()
    turn = Rotation.from_euler("z", -pointed_deg, degrees=True).as_matrix()
    leg = np.column_stack([rng.uniform(-0.05, 0.05, 500), rng.uniform(0.001, 0.1, 500), np.zeros(500)])
    ankle = np.array([0.3, -0.2, 0.1])
    foot = np.concatenate([inside @ turn.T, leg]) @ shank.T + ankle
    axes = axes_on_sole(foot, ankle, shank)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    found = Rotation.from_matrix(shank.T @ axes).as_euler("zxy", degrees=True)
    np.testing.assert_allclose(found, [-pointed_deg, 0, 0], atol=3)
    assert axes_on_sole(foot[:0], ankle, shank) is shank and axes_on_sole(foot, None, shank) is shank
