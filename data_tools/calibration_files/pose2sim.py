"""Calibrations in Pose2Sim's TOML: one table a camera, OpenCV's conventions, metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from data_tools.calibration_files.opencv_cameras import camera_from_opencv, camera_to_opencv
from geomocap.errors import CalibrationError
from geomocap.files.atomic import write_text
from geomocap.model.rig import Rig
from geomocap.reading import read_toml, reason


def read_pose2sim(path: Path) -> Rig:
    """Read a Pose2Sim calibration (`Calib*.toml`).

    Each table has name, size (pixels), matrix, distortions, rotation (Rodrigues vector) and translation (metres):
    x_cam = R X + t. Tables without a matrix, such as [metadata], are passed over. Images are taken to have the centre
    of the top-left pixel at (0, 0), as in OpenCV.

    Raises
    ------
    CalibrationError
        If the file is no TOML, holds no camera, or one lacks something.
    """
    path = Path(path)
    tables = read_toml(path, CalibrationError, "give a calibration file")
    names, cameras, poses = [], [], []
    for key, table in tables.items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue
        where = f"{path}: camera {key}"
        for needed in ("size", "rotation", "translation"):
            if needed not in table:
                raise CalibrationError(f"{where}: has no `{needed}`; calibrate again with Pose2Sim")
        try:
            width, height = (round(float(v)) for v in table["size"])
            matrix = np.array(table["matrix"], dtype=float)
            distortions = [float(v) for v in table.get("distortions", [])]
            R = Rotation.from_rotvec(np.array(table["rotation"], dtype=float).reshape(3)).as_matrix()
            t = np.array(table["translation"], dtype=float).reshape(3)
        except (TypeError, ValueError, OverflowError) as error:
            raise CalibrationError(f"{where}: numbers missing or misplaced ({reason(error)})") from None
        fisheye = bool(table.get("fisheye", False))
        cameras.append(camera_from_opencv(matrix, distortions, width, height, fisheye=fisheye, where=where))
        names.append(str(table.get("name", key)))
        poses.append(np.column_stack([R, t]))
    if not names:
        raise CalibrationError(f"{path}: holds no camera (a table with `matrix`); is it a Pose2Sim calibration?")
    return Rig.of_file(str(path), names, cameras, np.array(poses))


def write_pose2sim(rig: Rig, path: Path) -> None:
    """Write a rig as a Pose2Sim calibration.

    Raises
    ------
    CalibrationError
        If a camera has a lens model that OpenCV does not know.
    """
    tables: dict[str, dict] = {}
    for name, camera, pose in zip(rig.names, rig.cameras, rig.cam_from_world, strict=True):
        matrix, distortions, fisheye = camera_to_opencv(camera)
        tables[name] = {
            "name": name,
            "size": [float(camera.width), float(camera.height)],
            "matrix": matrix.tolist(),
            "distortions": distortions,
            "rotation": Rotation.from_matrix(pose[:, :3]).as_rotvec().tolist(),
            "translation": pose[:, 3].tolist(),
            "fisheye": fisheye,
        }
    tables["metadata"] = {"adjusted": False, "error": 0.0}
    write_text(Path(path), tomli_w.dumps(tables))
