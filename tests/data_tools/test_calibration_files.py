"""Calibrations of other tools: nothing is lost on the way out and back, and wrong conventions are named."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import tomli_w

from data_tools import calibration_files as formats
from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig

MODELS = {
    "PINHOLE": [800.25, 801.5, 641.123456789, 355.75],
    "OPENCV": [800.25, 801.5, 641.123456789, 355.75, -0.21, 0.034, 1.1e-3, -7e-4],
    "FULL_OPENCV": [800.25, 801.5, 641.123456789, 355.75, -0.21, 0.034, 1.1e-3, -7e-4, 0.012, 0.0, 0.0, 0.0],
}
RATIONAL = [800.25, 801.5, 641.123456789, 355.75, -0.21, 0.034, 1.1e-3, -7e-4, 0.012, 0.003, -0.002, 0.001]


def rig_of(model: str, params: list[float] | None = None, n: int = 4) -> Rig:
    """Cameras in a ring of 3 m that look at (0, 0, 1)."""
    rng = np.random.default_rng(3)
    poses = []
    for k in range(n):
        a = 2 * np.pi * k / n + rng.uniform(-0.1, 0.1)
        c = np.array([3 * np.cos(a), 3 * np.sin(a), 1.4 + 0.2 * k])
        z = np.array([0, 0, 1.0]) - c
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        R = np.array([x, np.cross(z, x), z])
        poses.append(np.column_stack([R, -R @ c]))
    cameras = tuple(
        pycolmap.Camera(model=model, width=1280, height=720, params=params or MODELS[model]) for _ in range(n)
    )
    return Rig(tuple(f"cam{k:02d}" for k in range(n)), cameras, np.array(poses))


def assert_same(a: Rig, b: Rig) -> None:
    assert a.names == b.names
    np.testing.assert_array_equal(a.sizes, b.sizes)
    np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, rtol=1e-9, atol=1e-12)
    points = np.random.default_rng(0).uniform([-0.8, -0.8, 0], [0.8, 0.8, 2], (50, 3))
    np.testing.assert_allclose(a.project(points), b.project(points), rtol=1e-9)
    for one, other in zip(a.cameras, b.cameras, strict=True):
        np.testing.assert_allclose(one.calibration_matrix(), other.calibration_matrix(), rtol=1e-9)


ROUND_TRIPS = {
    "aniposelib": (lambda r, p: formats.write_aniposelib(r, p / "calibration.toml"), "calibration.toml"),
    "caliscope": (lambda r, p: formats.write_caliscope(r, p / "camera_array.toml"), "camera_array.toml"),
    "pose2sim": (lambda r, p: formats.write_pose2sim(r, p / "Calib.toml"), "Calib.toml"),
    "easymocap": (lambda r, p: formats.write_easymocap(r, p), "."),
    "opencv": (lambda r, p: formats.write_opencv(r, p), "."),
    "colmap text": (lambda r, p: formats.write_colmap(r, p), "."),
    "colmap binary": (lambda r, p: formats.write_colmap(r, p, binary=True), "."),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", ROUND_TRIPS)
def test_round_trip_keeps_cameras_and_recognises_the_format(kind: str, model: str, tmp_path: Path) -> None:
    write, name = ROUND_TRIPS[kind]
    rig = rig_of(model)
    write(rig, tmp_path)
    expected = {"caliscope": "aniposelib"}.get(kind, kind.split()[0])
    assert formats.detect_format(tmp_path / name) == expected
    assert_same(rig, formats.read_calibration(tmp_path / name))


@pytest.mark.parametrize("kind", [k for k in ROUND_TRIPS if k != "caliscope"])
def test_rational_distortion_is_kept(kind: str, tmp_path: Path) -> None:
    write, name = ROUND_TRIPS[kind]
    rig = rig_of("FULL_OPENCV", RATIONAL)
    write(rig, tmp_path)
    assert_same(rig, formats.read_calibration(tmp_path / name))


def test_a_format_that_would_drop_terms_says_which(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="caliscope keeps k1 k2 p1 p2 k3 only"):
        formats.write_caliscope(rig_of("FULL_OPENCV", RATIONAL), tmp_path / "c.toml")
    fisheye = rig_of("OPENCV_FISHEYE", [800, 800, 640, 360, 0.1, 0.01, 0, 0])
    with pytest.raises(CalibrationError, match="fisheye"):
        formats.write_easymocap(fisheye, tmp_path)
    formats.write_aniposelib(fisheye, tmp_path / "fisheye.toml")
    assert_same(fisheye, formats.read_aniposelib(tmp_path / "fisheye.toml"))


def test_half_pixel_between_opencv_and_colmap(tmp_path: Path) -> None:
    rig = rig_of("PINHOLE")
    formats.write_aniposelib(rig, tmp_path / "c.toml")
    table = tomllib.loads((tmp_path / "c.toml").read_text())["cam_0"]
    assert table["matrix"][0][2] == pytest.approx(641.123456789 - 0.5, abs=1e-12)


def test_caliscope_example(data: Path) -> None:
    folder = data / "captures" / "caliscope_charuco"
    one, other = (formats.read_calibration(folder / f) for f in ("config.toml", "camera_array.toml"))
    assert_same(one, other)
    assert one.names == ("cam_0", "cam_1", "cam_2", "cam_3")
    assert one.cameras[0].model.name == "FULL_OPENCV"
    assert one.cameras[0].params[8] == pytest.approx(0.0665682301495769)


def test_pose2sim_example_is_recognised(data: Path) -> None:
    file = data / "captures" / "pose2sim_single" / "calibration" / "Calib.qca.txt"
    assert formats.detect_format(file) == "qualisys"
    rig = formats.read_calibration(file)
    assert 4 < np.linalg.norm(rig.centers[0] - rig.centers[2]) < 9


def altered(tmp_path: Path, change: str) -> Path:
    rig = rig_of("OPENCV")
    file = tmp_path / "c.toml"
    formats.write_caliscope(rig, file)
    content = tomllib.loads(file.read_text())
    for table in content["cameras"].values():
        R, t = np.array(table["rotation"]), np.array(table["translation"])
        if change == "millimetres":
            t = t * 1000
        elif change == "centimetres":
            t = t * 100
        elif change == "transposed":
            R = R.T
        elif change == "inverse":
            R, t = R.T, -R.T @ t
        elif change == "mirrored":
            R = R @ np.diag([1, 1, -1])
        elif change == "backwards":
            R, t = np.diag([1, -1, -1]) @ R, np.diag([1, -1, -1]) @ t
        elif change == "matrix":
            table["matrix"] = np.array(table["matrix"]).T.tolist()
        elif change == "size":
            table["size"] = [640, 360]
        elif change == "portrait":
            table["size"] = [720, 1280]
            table["matrix"][0][2], table["matrix"][1][2] = 900.0, 300.0
        table["rotation"], table["translation"] = R.tolist(), t.tolist()
    file.write_text(tomli_w.dumps(content))
    return file


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("millimetres", "millimetres"),
        ("centimetres", "centimetres"),
        ("transposed", "transposed"),
        ("inverse", "world-from-camera"),
        ("mirrored", "mirrors the world"),
        ("backwards", "look backwards"),
        ("matrix", "transposed"),
        ("size", "2 times as large"),
        ("portrait", "swapped"),
    ],
)
def test_wrong_conventions_are_named(change: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=named):
        formats.read_calibration(altered(tmp_path, change))


def test_millimetres_are_read_when_said(tmp_path: Path) -> None:
    rig = formats.read_calibration(altered(tmp_path, "millimetres"), metres_per_unit=0.001)
    np.testing.assert_allclose(rig.centers, rig_of("OPENCV").centers, atol=1e-9)


def test_easymocap_with_transposed_rotation_and_without_size(tmp_path: Path) -> None:
    rig = rig_of("OPENCV")
    formats.write_easymocap(rig, tmp_path)
    text = (tmp_path / "intri.yml").read_text()
    (tmp_path / "intri.yml").write_text("\n".join(line for line in text.splitlines() if line[:2] not in ("H_", "W_")))
    with pytest.raises(CalibrationError, match="image size"):
        formats.read_calibration(tmp_path)
    sizes = dict.fromkeys(rig.names, (1280, 720))
    assert_same(rig, formats.read_calibration(tmp_path, sizes=sizes))
    storage = cv2.FileStorage(str(tmp_path / "extri.yml"), cv2.FileStorage_WRITE)
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    for name in rig.names:
        storage.write("", name)
    storage.endWriteStruct()
    for name, pose in zip(rig.names, rig.cam_from_world, strict=True):
        storage.write(f"R_{name}", cv2.Rodrigues(np.array(pose[:, :3]))[0])
        storage.write(f"Rot_{name}", np.ascontiguousarray(pose[:, :3].T))
        storage.write(f"T_{name}", np.array(pose[:, 3:]))
    storage.release()
    with pytest.raises(CalibrationError, match="transpose"):
        formats.read_calibration(tmp_path, sizes=sizes)


@pytest.mark.parametrize("text", ["", "no toml =", "[cam_0]\nsize = [1, 2]", "%YAML:1.0\n---\nnames: 3"])
def test_other_files_are_refused_in_one_line(text: str, tmp_path: Path) -> None:
    for name in ("c.toml", "c.xml", "c.txt"):
        (tmp_path / name).write_text(text)
        with pytest.raises(CalibrationError) as error:
            formats.read_calibration(tmp_path / name)
        assert "\n" not in str(error.value) and name in str(error.value)
    (tmp_path / "intri.yml").write_text(text)
    (tmp_path / "extri.yml").write_text(text)
    with pytest.raises(CalibrationError):
        formats.read_calibration(tmp_path)
    shutil.rmtree(tmp_path)
    with pytest.raises(CalibrationError):
        formats.read_calibration(tmp_path)
