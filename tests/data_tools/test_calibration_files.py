from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from data_tools.calibration_files import read_pose2sim, read_qualisys, write_pose2sim
from data_tools.calibration_files.opencv_cameras import camera_from_opencv, camera_to_opencv
from data_tools.views import look_at
from geomocap.cameras import Rig
from geomocap.errors import CalibrationError

QUALISYS = """<?xml version='1.0' encoding='ASCII'?>
<calibration><cameras>
<camera active="1" serial="left" viewrotation="0">
 <fov_video bottom="479" left="{left}" right="{right}" top="{top}"/>
 <transform {rotation} x="{c[0]}" y="{c[1]}" z="{c[2]}"/>
 <intrinsic centerPointU="{cu}" centerPointV="{cv}" focalLengthU="38400" focalLengthV="38464" skew="0.0"
  radialDistortion1="-0.05" radialDistortion2="0.01" radialDistortion3="{k3}"
  tangentalDistortion1="0.001" tangentalDistortion2="-0.002"
  sensorMaxU="40896" sensorMaxV="30656" sensorMinU="0" sensorMinV="0"/>
</camera>
<camera active="0" serial="unused"/>
</cameras></calibration>"""

POSE = look_at(np.array([2.0, -3.0, 1.5]), np.array([0.0, 0.0, 1.0]))


def qualisys(left: int = 0, top: int = 0, k3: float = 0.0, text: str = QUALISYS) -> str:
    R = np.diag([1.0, -1.0, -1.0]) @ POSE[:, :3]  # its own inverse
    rotation = " ".join(
        f'r{i + 1}{j + 1}="{R[i, j]!r}"'.replace("np.float64(", "").replace(")", "") for i in range(3) for j in range(3)
    )
    return text.format(
        rotation=rotation,
        c=(2000.0, -3000.0, 1500.0),
        left=left,
        right=639,
        top=top,
        cu=64 * 310.0,
        cv=64 * 245.0,
        k3=k3,
    )


def opencv_project(points: np.ndarray, K: np.ndarray, distortions: list[float]) -> np.ndarray:
    rotation = cv2.Rodrigues(POSE[:, :3])[0]
    return cv2.projectPoints(points, rotation, POSE[:, 3], K, np.array(distortions))[0].reshape(-1, 2)


POINTS = np.random.default_rng(0).uniform([-0.6, -0.6, 0.2], [0.6, 0.6, 1.8], (40, 3))


@pytest.mark.parametrize("k3", [0.0, 0.02])
def test_qualisys_projects_as_its_conventions_say(tmp_path: Path, k3: float) -> None:
    file = tmp_path / "a.qca.txt"
    file.write_text(qualisys(k3=k3))
    rig = read_qualisys(file)
    assert rig.names == ("left",)
    assert rig.sizes.tolist() == [[640, 480]]
    np.testing.assert_allclose(rig.centers, [[2, -3, 1.5]], atol=1e-9)
    K = np.array([[600.0, 0, 310], [0, 601, 245], [0, 0, 1]])
    expected = opencv_project(POINTS, K, [-0.05, 0.01, 0.001, -0.002, k3]) + 0.5
    np.testing.assert_allclose(rig.project(POINTS)[0], expected, atol=1e-6)


def test_qualisys_field_of_view_moves_the_principal_point(tmp_path: Path) -> None:
    file = tmp_path / "a.qca.txt"
    file.write_text(qualisys(left=40, top=8))
    camera = read_qualisys(file).cameras[0]
    assert (camera.width, camera.height) == (600, 472)
    assert (camera.principal_point_x, camera.principal_point_y) == (310 - 40 + 0.5, 245 - 8 + 0.5)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("<calibration>", "", "no readable XML"),
        ('active="1"', 'active="0"', "no active camera"),
        ('viewrotation="0"', 'viewrotation="90"', "viewrotation"),
        ('focalLengthU="38400"', "", "focalLengthU"),
        ('skew="0.0"', 'skew="2.0"', "skew"),
        ("<transform", "<transported", "<transform>"),
        ('x="2000.0"', 'x="far"', "number x"),
        ("<calibration>", "<!DOCTYPE x><calibration>", "document type"),
    ],
)
def test_broken_qualisys_says_what_is_wrong(tmp_path: Path, before: str, after: str, message: str) -> None:
    file = tmp_path / "a.qca.txt"
    file.write_text(qualisys().replace(before, after, 1))
    with pytest.raises(CalibrationError, match=message):
        read_qualisys(file)


def test_real_qualisys_cameras_stand_round_the_person(data: Path) -> None:
    rig = read_qualisys(data / "captures" / "pose2sim_single" / "calibration" / "Calib.qca.txt")
    assert rig.names == ("cam01", "cam02", "cam03", "cam04")
    assert rig.sizes.tolist() == [[1088, 1920]] * 4
    assert np.all((rig.centers[:, 2] > 1.5) & (rig.centers[:, 2] < 2.2))
    seen = rig.project(np.array([[-0.7, 0.0, 1.0]]))[:, 0]  # a person's hips on the treadmill
    assert np.all((seen > 0) & (seen < rig.sizes))
    up = -rig.cam_from_world[:, 1, 2]  # images stand upright: y is down, z is up
    assert np.all(up > 0.8)


@given(
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
    k=st.lists(st.floats(-0.3, 0.3), min_size=4, max_size=4),
    fisheye=st.booleans(),
)
def test_pose2sim_comes_back_as_written(tmp_path_factory, rotation, k, fisheye: bool) -> None:
    model = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    camera = pycolmap.Camera(model=model, width=640, height=480, params=[600, 610, 320.25, 241.5, *k])
    pose = np.column_stack([Rotation.from_rotvec(rotation).as_matrix(), [0.1, -0.2, 3.0]])
    file = tmp_path_factory.mktemp("pose2sim") / "Calib.toml"
    write_pose2sim(Rig(("a",), (camera,), pose[None]), file)
    back = read_pose2sim(file)
    np.testing.assert_allclose(back.cam_from_world[0], pose, atol=1e-9)
    np.testing.assert_allclose(back.cameras[0].params[:4], camera.params[:4], atol=1e-9)
    if any(k) or fisheye:
        np.testing.assert_allclose(back.cameras[0].params[4:], k)


def test_pose2sim_is_read_as_opencv_means_it(tmp_path: Path) -> None:
    rotation = Rotation.from_matrix(POSE[:, :3]).as_rotvec().tolist()
    file = tmp_path / "Calib.toml"
    file.write_text(
        f"""[cam_1]
name = "left"
size = [640.0, 480.0]
matrix = [[600.0, 0.0, 310.0], [0.0, 601.0, 245.0], [0.0, 0.0, 1.0]]
distortions = [-0.05, 0.01, 0.001, -0.002]
rotation = {rotation}
translation = {POSE[:, 3].tolist()}
fisheye = false
[metadata]
adjusted = false
"""
    )
    rig = read_pose2sim(file)
    assert rig.names == ("left",)
    K = np.array([[600.0, 0, 310], [0, 601, 245], [0, 0, 1]])
    expected = opencv_project(POINTS, K, [-0.05, 0.01, 0.001, -0.002]) + 0.5
    np.testing.assert_allclose(rig.project(POINTS)[0], expected, atol=1e-6)


def test_opencv_distortions_of_all_lengths() -> None:
    K = np.array([[600.0, 0, 310], [0, 601, 245], [0, 0, 1]])
    for distortions, model in (
        ([], "PINHOLE"),
        ([0.1, 0, 0, 0], "OPENCV"),
        ([0.1, 0.2, 0, 0, 0.3], "FULL_OPENCV"),
        ([0.1, 0.2, 0.01, 0.02, 0.3, 0.1, 0.2, 0.05], "FULL_OPENCV"),
    ):
        camera = camera_from_opencv(K, distortions, 640, 480, where="here")
        assert camera.model.name == model
        matrix, back, fisheye = camera_to_opencv(camera)
        np.testing.assert_allclose(matrix, K)
        padded = np.zeros(len(back))
        padded[: len(distortions)] = distortions
        np.testing.assert_allclose(back, padded)
        assert not fisheye


@pytest.mark.parametrize(
    ("matrix", "distortions", "message"),
    [
        (np.array([[600.0, 0, 0], [0, 600, 0], [310, 245, 1]]), [], "transposed"),
        (np.array([[600.0, 3, 310], [0, 600, 245], [0, 0, 1]]), [], "skew"),
        (np.array([[-600.0, 0, 310], [0, 600, 245], [0, 0, 1]]), [], "positive"),
        (np.eye(2), [], "3×3"),
        (np.array([[600.0, 0, 310], [0, 600, 245], [0, 0, 1]]), [0.1, 0.2], "2 distortion coefficients"),
    ],
)
def test_bad_matrices_are_refused(matrix, distortions, message: str) -> None:
    with pytest.raises(CalibrationError, match=f"here: .*{message}"):
        camera_from_opencv(matrix, distortions, 640, 480, where="here")


def test_broken_pose2sim_says_what_is_wrong(tmp_path: Path) -> None:
    file = tmp_path / "Calib.toml"
    for text, message in (
        ("[metadata]\nerror = 0.0", "holds no camera"),
        ("[a]\nmatrix = [[1", "not valid TOML"),
        ("[a]\nmatrix = [[1.0]]\n", "has no `size`"),
        ('[a]\nmatrix = [["x"]]\nsize = [1, 2]\nrotation = [0, 0, 0]\ntranslation = [0, 0, 0]', "camera a: numbers"),
    ):
        file.write_text(text)
        with pytest.raises(CalibrationError, match=message):
            read_pose2sim(file)
    with pytest.raises(CalibrationError, match="can't be read"):
        read_pose2sim(tmp_path / "none.toml")
