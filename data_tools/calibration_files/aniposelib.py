"""Calibrations of aniposelib and caliscope: TOML, OpenCV's conventions, unit of the calibration board.

aniposelib has one table a camera, `[cam_0]`, with name, size, matrix, distortions, rotation (Rodrigues vector) and
translation; caliscope's `config.toml` is the same with 3×3 rotations, its `camera_array.toml` has `[cameras.0]` tables
and metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from data_tools.calibration_files.opencv_cameras import camera_from_opencv, camera_to_opencv
from data_tools.calibration_files.plausibility import check_rig, check_size, in_metres, rotation_matrix
from geomocap.errors import CalibrationError
from geomocap.files.atomic import write_text
from geomocap.model.rig import Rig
from geomocap.reading import read_toml, reason


def read_aniposelib(path: Path, metres_per_unit: float = 1.0) -> Rig:
    """Read an aniposelib or caliscope calibration.

    Cameras marked `ignore`, and those of caliscope without a pose, are passed over.

    Parameters
    ----------
    path : Path
        aniposelib's `calibration.toml`, caliscope's `config.toml` or `camera_array.toml`.
    metres_per_unit : float
        Length of the file's unit, metres: 0.001 if the board was given in millimetres.

    Raises
    ------
    CalibrationError
        If the file is no TOML, holds no camera, lacks something, or its convention or unit is evidently another.
    """
    path = Path(path)
    content = read_toml(path, CalibrationError, "give a calibration file")
    nested = content.get("cameras")
    tables = nested if isinstance(nested, dict) else content
    names, cameras, poses = [], [], []
    for key, table in tables.items():
        if not isinstance(table, dict) or "matrix" not in table or table.get("ignore", False):
            continue
        name = str(table.get("name") or (f"cam_{key}" if tables is nested else key))
        where = f"{path}: camera {name}"
        if "rotation" not in table or "translation" not in table:
            if tables is nested or "cam_id" in table:
                continue
            raise CalibrationError(f"{where}: has no rotation and translation; calibrate the cameras' poses first")
        if "size" not in table:
            raise CalibrationError(f"{where}: has no `size` (image width and height)")
        try:
            width, height = (round(float(v)) for v in table["size"])
            matrix = np.array(table["matrix"], dtype=float)
            distortions = [float(v) for v in np.ravel(table.get("distortions", []))]
            turn = np.array(table["rotation"], dtype=float)
            t = np.array(table["translation"], dtype=float).reshape(3)
        except (TypeError, ValueError, OverflowError) as error:
            raise CalibrationError(f"{where}: numbers missing or misplaced ({reason(error)})") from None
        if turn.size == 3:
            R = Rotation.from_rotvec(turn.reshape(3)).as_matrix()
        else:
            R = rotation_matrix(turn, where)
        fisheye = bool(table.get("fisheye", False))
        if fisheye:
            distortions = distortions[:4]
        camera = camera_from_opencv(matrix, distortions, width, height, fisheye=fisheye, where=where)
        check_size(camera, where)
        names.append(name)
        cameras.append(camera)
        poses.append(np.column_stack([R, in_metres(t, metres_per_unit, str(path))]))
    if not names:
        raise CalibrationError(f"{path}: holds no camera (a table with `matrix`); is it an aniposelib calibration?")
    rig = Rig.of_file(str(path), names, cameras, np.array(poses))
    check_rig(rig, str(path))
    return rig


def write_aniposelib(rig: Rig, path: Path) -> None:
    """Write a rig as an aniposelib calibration, in metres.

    Nothing is lost; aniposelib itself uses the first five distortion coefficients in its own adjustment.

    Raises
    ------
    CalibrationError
        If a camera has a lens model that OpenCV does not know.
    """
    tables: dict[str, dict] = {}
    for k, (name, camera, pose) in enumerate(zip(rig.names, rig.cameras, rig.cam_from_world, strict=True)):
        matrix, distortions, fisheye = camera_to_opencv(camera)
        tables[f"cam_{k}"] = {
            "name": name,
            "size": [int(camera.width), int(camera.height)],
            "matrix": matrix.tolist(),
            "distortions": distortions if fisheye or len(distortions) > 4 else [*distortions, 0.0],
            "rotation": Rotation.from_matrix(pose[:, :3]).as_rotvec().tolist(),
            "translation": pose[:, 3].tolist(),
            **({"fisheye": True} if fisheye else {}),
        }
    tables["metadata"] = {"adjusted": True, "error": 0.0}
    write_text(Path(path), tomli_w.dumps(tables))


def write_caliscope(rig: Rig, path: Path) -> None:
    """Write a rig as caliscope's `camera_array.toml`, in metres.

    Raises
    ------
    CalibrationError
        If a camera has more than the five distortion coefficients that caliscope keeps, or is a fisheye.
    """
    tables = {}
    for k, (name, camera, pose) in enumerate(zip(rig.names, rig.cameras, rig.cam_from_world, strict=True)):
        matrix, distortions, fisheye = camera_to_opencv(camera)
        if fisheye or any(distortions[5:]):
            raise CalibrationError(
                f"camera {name}: caliscope keeps k1 k2 p1 p2 k3 only, its model {camera.model.name} would lose terms; "
                "write aniposelib instead"
            )
        tables[str(k)] = {
            "cam_id": k,
            "name": name,
            "rotation_count": 0,
            "ignore": False,
            "size": [int(camera.width), int(camera.height)],
            "matrix": matrix.tolist(),
            "distortions": [*distortions, 0.0][:5],
            "rotation": pose[:, :3].tolist(),
            "translation": pose[:, 3].tolist(),
        }
    write_text(Path(path), tomli_w.dumps({"cameras": tables}))
