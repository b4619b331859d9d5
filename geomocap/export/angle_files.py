"""Joint angles as CSV and as OpenSim's MOT.

| column of angles.csv | what |
|---|---|
| frame, time_s | number and time |
| <joint>_flexion_deg, _adduction_deg, _rotation_deg | anatomical angles of named joints |
| <joint>_turn_deg, _off_axis_deg | of others: about the axis of most turns, and the size of what is left |
| ..._std_deg | standard deviation of the column before it, where it is known |
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomocap.angles.angle_set import AngleSet
from geomocap.angles.joint_angles import joint_angles, turn_covariances
from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.names import Names
from geomocap.files.atomic import write_text
from geomocap.files.results import DIAGNOSTICS, read_diagnostics
from geomocap.files.run import Run
from geomocap.model.skeleton import Skeleton
from geomocap.naming.found_names import FoundNames


def run_angles(
    run: Run, skeleton: Skeleton, names: Names | None, found: FoundNames, settings: ExportSettings
) -> AngleSet:
    """Return the joint angles of a run.

    Parameters
    ----------
    run : Run
    skeleton : Skeleton
    names : Names, optional
    found : FoundNames
    settings : ExportSettings

    Raises
    ------
    MotionError
        If the frame of zero angles isn't there.
    """
    if settings.zero_frame is not None and settings.zero_frame >= skeleton.frame_count:
        raise MotionError(f"zero frame {settings.zero_frame}: the motion ends with frame {skeleton.frame_count - 1}")
    given = names or Names()
    bodies = given.body_names(skeleton.body_count, skeleton.body_names)
    joints = given.joint_names(skeleton.joint_bodies, bodies, skeleton.joint_names)
    covariances = None
    if run.has(DIAGNOSTICS):
        made = read_diagnostics(run)
        samples, labels = made.sample_positions, made.sample_body
        if samples is not None and labels is not None and samples.shape[1] == skeleton.frame_count:
            covariances = turn_covariances(skeleton.body_rotations, samples, labels)
    return joint_angles(skeleton, found, joints, covariances, settings.zero_frame)


def angle_table(angles: AngleSet) -> dict[str, np.ndarray]:
    """Return the columns of `angles.csv`, each (T,)."""
    frames = np.arange(len(angles.values))
    columns: dict[str, np.ndarray] = {"frame": frames, "time_s": frames / angles.fps}
    for k, name in enumerate(angles.names):
        columns[f"{name}_deg"] = angles.values[:, k]
        if np.isfinite(angles.std[:, k]).any():
            columns[f"{name}_std_deg"] = angles.std[:, k]
    return columns


def write_mot(path: Path, angles: AngleSet) -> None:
    """Write angles as a motion file of OpenSim, degrees, whole or not at all."""
    times = np.arange(len(angles.values)) / angles.fps
    write_text(path, mot_text("angles", angles.names, times, angles.values, degrees=True))


def mot_text(name: str, columns: tuple[str, ...], times: np.ndarray, values: np.ndarray, *, degrees: bool) -> str:
    """Return a table of OpenSim's storage format.

    Parameters
    ----------
    name : str
    columns : tuple of K str
    times : (T,) float, seconds
    values : (T, K) float
    degrees : bool
        Whether angles are degrees; else radians.
    """
    lines = [
        name,
        "version=1",
        f"nRows={len(times)}",
        f"nColumns={len(columns) + 1}",
        f"inDegrees={'yes' if degrees else 'no'}",
        "endheader",
        "\t".join(["time", *columns]),
    ]
    digits = 6 if degrees else 9
    for time, row in zip(times.tolist(), values.tolist(), strict=True):
        lines.append("\t".join([f"{time:.6f}", *(f"{v:.{digits}f}" for v in row)]))
    return "\n".join(lines) + "\n"
