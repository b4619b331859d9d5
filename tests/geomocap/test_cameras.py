"""Rigs: projection, rays, undistortion, COLMAP models."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geomocap.errors import CalibrationError
from geomocap.files.rigs import colmap_model, read_rig, write_rig
from geomocap.model.rig import Rig


def make_rig(seed: int = 0, count: int = 3, distortion: bool = True) -> Rig:
    rng = np.random.default_rng(seed)
    cameras, poses = [], []
    for i in range(count):
        angle = 2 * np.pi * i / count
        center = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.2])
        z = -center / np.linalg.norm(center)
        x = np.cross([0.0, 0.0, -1.0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        R = Rotation.from_rotvec(rng.normal(size=3) * 0.02).as_matrix() @ R
        k = rng.normal(size=4) * [0.05, 0.02, 0.001, 0.001] if distortion else np.zeros(4)
        cameras.append(pycolmap.Camera(model="OPENCV", width=320, height=240, params=[300, 302, 161, 119, *k]))
        poses.append(np.column_stack([R, -R @ center]))
    return Rig(tuple(f"cam{i}" for i in range(count)), tuple(cameras), np.array(poses))


def test_projection_is_opencv_s_in_colmap_pixels():
    rig = make_rig()
    points = np.random.default_rng(1).normal(size=(50, 3)) * 0.4
    pixels = rig.project(points)
    for c, camera in enumerate(rig.cameras):
        rvec = cv2.Rodrigues(rig.cam_from_world[c, :, :3].copy())[0]
        expected = cv2.projectPoints(
            points, rvec, rig.cam_from_world[c, :, 3].copy(), camera.calibration_matrix(), np.array(camera.params[4:])
        )[0][:, 0]
        np.testing.assert_allclose(pixels[c], expected, atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_rays_invert_projection(seed):
    rig = make_rig(seed)
    points = np.random.default_rng(seed).normal(size=(20, 3)) * 0.3
    pixels = rig.project(points)
    for c in range(len(rig)):
        origin, directions = rig.rays(c, pixels[c])
        along = ((points - origin) * directions).sum(axis=1)
        np.testing.assert_allclose(origin + along[:, None] * directions, points, atol=1e-6)


def test_points_behind_a_camera_have_no_pixel():
    rig = make_rig(count=1)
    behind = rig.centers[0] - rig.viewing_directions[0]
    assert np.isnan(rig.project(behind[None])).all()


@pytest.mark.parametrize("factor", [2, 7])  # 320 × 240: 7 doesn't divide it
def test_shrunk_images_show_points_at_the_same_fraction_of_their_size(factor):
    rig = make_rig(3)
    small = rig.shrunk(factor)
    np.testing.assert_array_equal(small.sizes, np.ceil(rig.sizes / factor))
    points = np.array([[0.15, -0.1, 0.2], [0.0, 0.3, -0.2]])
    where = rig.project(points) / rig.sizes[:, None]
    np.testing.assert_allclose(small.project(points) / small.sizes[:, None], where, atol=1e-9)


def test_undistorted_image_shows_what_the_pinhole_camera_sees():
    rig = make_rig(3)
    flat = rig.undistorted()
    assert flat.is_pinhole and not rig.is_pinhole
    point = np.array([[0.15, -0.1, 0.2]])
    for c in range(len(rig)):
        # a blob around the point's image in the real camera must land on its image in the pinhole camera
        y, x = np.mgrid[0:240, 0:320] + 0.5
        u, v = rig.project(point)[c, 0]
        image = np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8).astype(np.float32)
        map_x, map_y = rig.undistortion_map(c)
        warped = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR)
        Y, X = np.mgrid[0 : warped.shape[0], 0 : warped.shape[1]] + 0.5
        center = np.array([(X * warped).sum(), (Y * warped).sum()]) / warped.sum()
        np.testing.assert_allclose(center, flat.project(point)[c, 0], atol=0.05)
        # and every original corner falls inside the undistorted picture
        corners = np.array([[0.5, 0.5], [319.5, 0.5], [0.5, 239.5], [319.5, 239.5]])
        _, directions = rig.rays(c, corners)
        pixels = flat.project(rig.centers[c] + directions)[c]
        assert (pixels >= 0).all() and (pixels <= flat.sizes[c]).all()


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_model_round_trip(tmp_path, binary):
    rig = make_rig()
    if binary:
        colmap_model(rig).write_binary(str(tmp_path))
    else:
        write_rig(tmp_path, rig)
    back = read_rig(tmp_path, ("cam2", "cam0"))
    assert back.names == ("cam2", "cam0")
    np.testing.assert_allclose(back.cam_from_world, rig.cam_from_world[[2, 0]], atol=1e-12)
    np.testing.assert_allclose(back.cameras[1].params, rig.cameras[0].params, rtol=1e-12)


def test_rigs_can_be_sent_to_other_processes():
    rig = make_rig()
    back = pickle.loads(pickle.dumps(rig))
    points = np.random.default_rng(0).normal(size=(5, 3)) * 0.2
    np.testing.assert_array_equal(back.project(points), rig.project(points))


def test_what_is_no_rig_is_named(tmp_path):
    rig = make_rig()
    mirrored = np.array(rig.cam_from_world)
    mirrored[1, 0] *= -1
    with pytest.raises(CalibrationError, match="cam1: its rotation mirrors"):
        Rig(rig.names, rig.cameras, mirrored)
    with pytest.raises(CalibrationError, match="unique"):
        Rig(("a", "a", "b"), rig.cameras, rig.cam_from_world)
    with pytest.raises(CalibrationError, match="no readable COLMAP model"):
        read_rig(tmp_path / "nothing")
    write_rig(tmp_path, rig)
    with pytest.raises(CalibrationError, match="no posed image of camera cam9"):
        read_rig(tmp_path, ("cam9",))
