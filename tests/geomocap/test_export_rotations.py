import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.export.skeleton_motion import fill_positions
from geomocap.model.rotations import fill_rotations, quaternions, rotation_about, zxy_angles


def compose(angles):
    return rotation_about(2, angles[..., 0]) @ rotation_about(0, angles[..., 1]) @ rotation_about(1, angles[..., 2])


def test_rotation_about_agrees_with_scipy():
    for axis, name in enumerate("xyz"):
        np.testing.assert_allclose(rotation_about(axis, np.array(0.7)), Rotation.from_euler(name, 0.7).as_matrix())


def test_angles_compose_to_the_rotation():
    R = Rotation.random(200, rng=np.random.default_rng(0)).as_matrix().reshape(20, 10, 3, 3)
    np.testing.assert_allclose(compose(zxy_angles(R)), R, atol=1e-12)


def test_angles_run_on_over_full_turns():
    angle = np.linspace(0, 6 * np.pi, 200)
    angles = zxy_angles(rotation_about(2, angle))
    np.testing.assert_allclose(angles[:, 0], angle, atol=1e-9)
    np.testing.assert_allclose(angles[:, 1:], 0, atol=1e-9)


def test_angles_run_on_over_the_pole():
    angle = np.linspace(0, np.pi, 91)  # passes 90° exactly
    R = rotation_about(0, angle)
    angles = zxy_angles(R)
    np.testing.assert_allclose(angles[:, 1], angle, atol=1e-7)
    np.testing.assert_allclose(compose(angles), R, atol=1e-12)


@pytest.mark.parametrize("pole", [np.pi / 2, -np.pi / 2])
def test_gimbal_lock_keeps_the_rotation_and_the_first_angle(pole):
    angles = np.array([[0.3, pole * 0.99, 0.2], [0.3, pole, 0.4]])
    R = compose(angles)
    found = zxy_angles(R)
    np.testing.assert_allclose(compose(found), R, atol=1e-9)
    assert found[1, 0] == pytest.approx(found[0, 0], abs=1e-6)


def test_quaternions_have_no_sign_flips():
    q = quaternions(rotation_about(1, np.linspace(0, 5 * np.pi, 300)))
    assert (np.sum(q[1:] * q[:-1], axis=-1) > 0.99).all()
    np.testing.assert_allclose(q[:, 1], np.sin(np.linspace(0, 5 * np.pi, 300) / 2), atol=1e-9)


def test_filled_rotations_turn_evenly_and_hold_the_ends():
    R = rotation_about(2, np.arange(7) * 0.1)
    gappy = R.copy()
    gappy[[0, 2, 3, 6]] = np.nan
    np.testing.assert_allclose(fill_rotations(gappy), rotation_about(2, np.array([0.1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.5])))


def test_a_body_never_seen_stays_still():
    np.testing.assert_allclose(fill_rotations(np.full((3, 3, 3), np.nan)), np.tile(np.eye(3), (3, 1, 1)))
    np.testing.assert_allclose(fill_positions(np.full((3, 3), np.nan)), 0)


def test_filled_positions_are_linear():
    p = np.array([[0.0, 0, 0], [np.nan] * 3, [2, 4, 6], [np.nan] * 3])
    np.testing.assert_allclose(fill_positions(p), [[0, 0, 0], [1, 2, 3], [2, 4, 6], [2, 4, 6]])
