"""Calibrations as COLMAP models, text or binary."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_tools.calibration_files.plausibility import check_rig, in_metres
from geomocap.files.rigs import read_rig, write_rig
from geomocap.model.rig import Rig


def read_colmap(folder: Path, metres_per_unit: float = 1.0) -> Rig:
    """Read the cameras of a COLMAP model; a folder with `sparse/0`, `sparse` or the model itself.

    Parameters
    ----------
    folder : Path
    metres_per_unit : float
        Length of the model's unit, metres. A model from images alone has an arbitrary one.

    Raises
    ------
    CalibrationError
        If there is no model, a camera moves, or its unit can't be the metre.
    """
    folder = Path(folder)
    places = (folder / "sparse" / "0", folder / "sparse", folder)
    model = next((p for p in places if any(p.glob("cameras.*"))), folder)
    rig = read_rig(model)
    poses = np.array(rig.cam_from_world)
    poses[:, :, 3] = in_metres(poses[:, :, 3], metres_per_unit, str(model))
    rig = Rig.of_file(str(model), rig.names, rig.cameras, poses, rig.notes)
    check_rig(rig, str(model))
    return rig


def write_colmap(rig: Rig, folder: Path, *, binary: bool = False) -> None:
    """Write a rig as a COLMAP model.

    Raises
    ------
    RunError
        If the folder can't be written.
    """
    write_rig(Path(folder), rig, binary=binary)
