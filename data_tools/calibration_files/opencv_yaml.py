"""Calibrations in OpenCV's YAML: EasyMocap's intri.yml and extri.yml, and one file a camera.

EasyMocap names its matrices `K_<camera>`, `dist_<camera>`, `R_<camera>` (Rodrigues vector), `Rot_<camera>` (3×3),
`T_<camera>`, and lists the cameras in `names`. Files of one camera have `camera_matrix`, `distortion_coefficients`,
`image_width`, `image_height` and, for the pose, `R` or `rvec` and `T` or `tvec`, as OpenCV's samples write them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.calibration_files.opencv_cameras import camera_from_opencv, camera_to_opencv
from data_tools.calibration_files.opencv_text import read_opencv_file
from data_tools.calibration_files.plausibility import check_rig, check_size, in_metres, rotation_matrix
from geomocap.errors import CalibrationError
from geomocap.files.atomic import write_text
from geomocap.model.colmap_library import pycolmap
from geomocap.model.rig import Rig
from geomocap.reading import harmless

MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "K", "intrinsic_matrix", "M")
DISTORTION_KEYS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "dist", "D")
ROTATION_KEYS = ("R", "rotation_matrix", "rvec", "rotation_vector", "rotation")
TRANSLATION_KEYS = ("T", "t", "tvec", "translation_vector", "translation")

_KEY_PART = re.compile(r"[A-Za-z0-9_-]+")  # of which OpenCV lets keys be made


def read_easymocap(
    folder: Path, sizes: Mapping[str, tuple[int, int]] | None = None, metres_per_unit: float = 1.0
) -> Rig:
    """Read EasyMocap's `intri.yml` and `extri.yml`.

    Parameters
    ----------
    folder : Path
        With both files.
    sizes : mapping of camera name to (width, height), optional
        Image sizes; needed where the file does not say them (`W_<camera>`, `H_<camera>`).
    metres_per_unit : float

    Raises
    ------
    CalibrationError
        If a file is missing or no YAML, a camera lacks something, or its convention is evidently another.
    """
    folder = Path(folder)
    intrinsic, extrinsic = read_opencv_file(folder / "intri.yml"), read_opencv_file(folder / "extri.yml")
    names = intrinsic.texts("names") or extrinsic.texts("names")
    if not names:
        raise CalibrationError(f"{folder / 'intri.yml'}: lists no cameras (`names`); is it an EasyMocap calibration?")
    cameras, poses = [], []
    for name in names:
        where = f"{folder}: camera {name}"
        K, d = intrinsic.matrix(f"K_{name}"), intrinsic.matrix(f"dist_{name}", f"D_{name}")
        if K is None or d is None:
            raise CalibrationError(f"{where}: intri.yml has no K_{name} and dist_{name}")
        width, height = (intrinsic.number(f"{k}_{name}") for k in "WH")
        if width <= 0 or height <= 0:
            if sizes is None or name not in sizes:
                raise CalibrationError(f"{where}: intri.yml does not say its image size; give it")
            width, height = sizes[name]
        cameras.append(_camera(K, d, width, height, where))
        R, r, t = (extrinsic.matrix(f"{k}_{name}") for k in ("Rot", "R", "T"))
        if t is None or (R is None and r is None):
            raise CalibrationError(f"{where}: extri.yml has no R_{name} or Rot_{name}, and T_{name}")
        turn_given = R if R is not None else r
        assert turn_given is not None
        poses.append(_pose(turn_given, t, metres_per_unit, where))
        if R is not None and r is not None and r.size == 3:
            turn = Rotation.from_rotvec(np.ravel(r)).as_matrix()
            if np.abs(turn - R).max() > 1e-4:
                what = "the transpose of" if np.abs(turn.T - R).max() < 1e-4 else "another rotation than"
                raise CalibrationError(f"{where}: in extri.yml Rot_{name} is {what} R_{name}")
    rig = Rig.of_file(str(folder), names, cameras, np.array(poses))
    check_rig(rig, str(folder))
    return rig


def write_easymocap(rig: Rig, folder: Path) -> None:
    """Write a rig as EasyMocap's `intri.yml` and `extri.yml` (with `W_`, `H_` for the image sizes), metres.

    Raises
    ------
    CalibrationError
        If a camera is a fisheye, which EasyMocap does not know.
    """
    for name in rig.names:
        if not _KEY_PART.fullmatch(name):
            raise CalibrationError(
                f"camera {harmless(name)}: EasyMocap's files can't hold this name; use letters, digits, - and _"
            )
    intrinsic, extrinsic = _new(), _new()
    for storage in (intrinsic, extrinsic):
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in rig.names:
            storage.write("", name)
        storage.endWriteStruct()
    for name, camera, pose in zip(rig.names, rig.cameras, rig.cam_from_world, strict=True):
        matrix, distortions = _described(name, camera)
        intrinsic.write(f"K_{name}", matrix)
        intrinsic.write(f"dist_{name}", distortions[None])
        intrinsic.write(f"H_{name}", int(camera.height))
        intrinsic.write(f"W_{name}", int(camera.width))
        extrinsic.write(f"R_{name}", Rotation.from_matrix(pose[:, :3]).as_rotvec()[:, None])
        extrinsic.write(f"Rot_{name}", np.array(pose[:, :3]))
        extrinsic.write(f"T_{name}", np.array(pose[:, 3:]))
    write_text(Path(folder) / "intri.yml", intrinsic.releaseAndGetString())
    write_text(Path(folder) / "extri.yml", extrinsic.releaseAndGetString())


def read_opencv(folder: Path, metres_per_unit: float = 1.0) -> Rig:
    """Read a folder of OpenCV files, `<camera>.yml`, `.yaml`, `.xml` or `.json`, one a camera.

    Parameters
    ----------
    folder : Path
    metres_per_unit : float

    Raises
    ------
    CalibrationError
        If there are none, one lacks matrix, size or pose, or its convention is evidently another.
    """
    folder = Path(folder)
    endings = (".yml", ".yaml", ".xml", ".json")
    files = sorted(f for f in folder.glob("*") if f.suffix.lower() in endings and not f.name.startswith("."))
    names, cameras, poses = [], [], []
    for file in files:
        storage = read_opencv_file(file)
        K = storage.matrix(*MATRIX_KEYS)
        if K is None:
            continue
        where = str(file)
        d = storage.matrix(*DISTORTION_KEYS)
        R, t = storage.matrix(*ROTATION_KEYS), storage.matrix(*TRANSLATION_KEYS)
        if R is None or t is None:
            raise CalibrationError(f"{where}: has no pose (R or rvec, and T or tvec)")
        width, height = (storage.number(k) for k in ("image_width", "image_height"))
        if width <= 0 or height <= 0:
            raise CalibrationError(f"{where}: does not say image_width and image_height")
        names.append(file.stem)
        cameras.append(_camera(K, np.zeros(0) if d is None else d, width, height, where))
        poses.append(_pose(R, t, metres_per_unit, where))
    if not names:
        raise CalibrationError(f"{folder}: holds no OpenCV calibration (<camera>.yml with camera_matrix)")
    rig = Rig.of_file(str(folder), names, cameras, np.array(poses))
    check_rig(rig, str(folder))
    return rig


def write_opencv(rig: Rig, folder: Path) -> None:
    """Write a rig as OpenCV files `<camera>.yml`, metres.

    Raises
    ------
    CalibrationError
        If a camera is a fisheye, whose model the files have no word for.
    """
    for name, camera, pose in zip(rig.names, rig.cameras, rig.cam_from_world, strict=True):
        matrix, distortions = _described(name, camera)
        storage = _new()
        storage.write("image_width", int(camera.width))
        storage.write("image_height", int(camera.height))
        storage.write("camera_matrix", matrix)
        storage.write("distortion_coefficients", distortions[None])
        storage.write("R", np.array(pose[:, :3]))
        storage.write("T", np.array(pose[:, 3:]))
        write_text(Path(folder) / f"{name}.yml", storage.releaseAndGetString())


def _new() -> cv2.FileStorage:
    return cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)


def _camera(K: np.ndarray, d: np.ndarray, width: int, height: int, where: str) -> pycolmap.Camera:
    camera = camera_from_opencv(K, np.ravel(d).tolist(), width, height, where=where)
    check_size(camera, where)
    return camera


def _pose(R: np.ndarray, t: np.ndarray, metres_per_unit: float, where: str) -> np.ndarray:
    if t.size != 3:
        raise CalibrationError(f"{where}: its translation has {t.size} numbers instead of 3")
    turn = Rotation.from_rotvec(np.ravel(R)).as_matrix() if R.size == 3 else rotation_matrix(R, where)
    return np.column_stack([turn, in_metres(np.ravel(t), metres_per_unit, where)])


def _described(name: str, camera: pycolmap.Camera) -> tuple[np.ndarray, np.ndarray]:
    matrix, distortions, fisheye = camera_to_opencv(camera)
    if fisheye:
        raise CalibrationError(f"camera {name}: the format has no fisheye model; write aniposelib instead")
    return matrix, np.array([*distortions, 0.0] if len(distortions) == 4 else distortions)
