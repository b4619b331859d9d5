"""CSV and Parquet tables of joint positions and angles, for people who plot.

World axes as they are, one row for each frame:

| column | what |
|---|---|
| frame, time_s | number and time |
| <joint>_x_m, _y_m, _z_m | joint position, metres, world; empty in gaps |
| <body>_z_deg, _x_deg, _y_deg | turn against the parent body since the first frame, R = Rz Rx Ry, world axes |
| <body>_turn_deg | angle of that turn, whatever its axis |

Parquet needs the package `pyarrow`.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from geomocap.export.export_errors import MotionError, require
from geomocap.export.markers import Markers
from geomocap.export.motion_tree import MotionTree
from geomocap.files.atomic import by_library, write_atomic, write_text
from geomocap.model.rotations import turn_angles, zxy_angles


def motion_table(markers: Markers, motion: MotionTree) -> dict[str, np.ndarray]:
    """Return the table's columns, each (T,).

    Parameters
    ----------
    markers : Markers
        Joints and other points.
    motion : MotionTree
        Of the same frames.

    Raises
    ------
    MotionError
        If they have different numbers of frames.
    """
    if motion.n_frames != markers.n_frames:
        raise MotionError(f"table: {markers.n_frames} frames of markers, but {motion.n_frames} of rotations")
    frames = np.arange(markers.n_frames)
    columns: dict[str, np.ndarray] = {"frame": frames, "time_s": frames / markers.fps}
    for k, name in enumerate(markers.names):
        for axis, letter in enumerate("xyz"):
            columns[f"{name}_{letter}_m"] = markers.positions[:, k, axis]
    euler = np.rad2deg(zxy_angles(motion.rotations))
    turn = np.rad2deg(turn_angles(motion.rotations))
    for n, name in enumerate(motion.names):
        if motion.bodies[n] < 0:
            continue
        for i, letter in enumerate("zxy"):
            columns[f"{name}_{letter}_deg"] = euler[:, n, i]
        columns[f"{name}_turn_deg"] = turn[:, n]
    return columns


def write_csv(path: Path, table: dict[str, np.ndarray]) -> None:
    """Write a table as CSV with a header row, whole or not at all; gaps are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    whole = [np.issubdtype(c.dtype, np.integer) for c in table.values()]
    for row in zip(*(c.tolist() for c in table.values()), strict=True):
        writer.writerow([v if w else "" if v != v else f"{v:.6f}" for v, w in zip(row, whole, strict=True)])
    write_text(path, text.getvalue())


def write_parquet(path: Path, table: dict[str, np.ndarray]) -> None:
    """Write a table as Parquet, whole or not at all; gaps are nulls.

    Raises
    ------
    MissingPackageError
        If pyarrow isn't installed.
    """
    arrow = require("pyarrow", extra="parquet", purpose="Parquet files")
    parquet = require("pyarrow.parquet", extra="parquet", purpose="Parquet files")
    columns = {name: arrow.array(c, from_pandas=True) for name, c in table.items()}
    write_atomic(path, by_library(lambda p: parquet.write_table(arrow.table(columns), p)))
