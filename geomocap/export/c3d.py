"""C3D, the format of motion laboratories: markers with residuals and the bodies' rotations, written and read.

Axes z up (POINT:X_SCREEN and Y_SCREEN say so), millimetres. Gaps are invalid points (residual -1), points that were
filled in have residual 0. Bodies stand as 4×4 transforms in the ROTATION group, as Theia and Visual3D write them.
Writing needs the package `ezc3d`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomocap.export.c3d_file import read_c3d_file
from geomocap.export.conventions import C3D, UNITS_PER_METRE, Axis
from geomocap.export.export_errors import MotionError, require
from geomocap.export.markers import Markers
from geomocap.export.motion_tree import MotionTree
from geomocap.files.atomic import by_library, write_atomic
from geomocap.version import __version__

FINEST_RESIDUAL = 0.01  # mm; residuals are bytes, multiples of POINT:SCALE
_BLOCK = 512  # bytes
LABELS_PER_PARAMETER = 255  # a dimension of a C3D parameter is a byte


def write_c3d(path: Path, markers: Markers, motion: MotionTree | None = None) -> None:
    """Write markers, and the bodies of a motion, as C3D, whole or not at all.

    Parameters
    ----------
    path : Path
    markers : Markers
    motion : MotionTree, optional
        Its nodes become 4×4 transforms in the ROTATION group.

    Raises
    ------
    MissingPackageError
        If ezc3d isn't installed.
    MotionError
        If motion and markers have different numbers of frames.
    """
    ezc3d = require("ezc3d", extra="c3d", purpose="C3D files")
    if motion is not None and motion.n_frames != markers.n_frames:
        raise MotionError(f"{path}: {markers.n_frames} frames of markers, but {motion.n_frames} of rotations")
    file = ezc3d.c3d()
    points = np.ones((4, len(markers.names), markers.n_frames))
    points[:3] = C3D.points(markers.positions, markers.up).transpose(2, 1, 0)
    residuals = _residuals_mm(markers)
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [markers.fps]
    point["UNITS"]["value"] = [C3D.unit]
    point["SCALE"]["value"] = [-max(FINEST_RESIDUAL, float(residuals.max(initial=0.0)) / 250)]
    _add_texts(file, "POINT", "LABELS", markers.names)
    _add_texts(file, "POINT", "DESCRIPTIONS", markers.descriptions or ("",) * len(markers.names))
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", [f"+{C3D.up.upper()}"])
    file.add_parameter("MANUFACTURER", "COMPANY", ["geomocap"])
    file.add_parameter("MANUFACTURER", "SOFTWARE", [f"geomocap {__version__}"])
    file["data"]["points"] = points
    file["data"]["meta_points"] = {
        "residuals": residuals.T[None],
        "camera_masks": np.zeros((7, *points.shape[1:]), bool),
    }
    if motion is not None:
        file["data"]["rotations"] = _transforms(motion)
        _add_texts(file, "ROTATION", "LABELS", motion.names)
        file.add_parameter("ROTATION", "DESCRIPTIONS", ["world from body since the first frame, mm"] * motion.n_nodes)
    write_atomic(path, by_library(lambda p: file.write(str(p))), lambda p: _is_whole(p, markers, motion))


def _is_whole(path: Path, markers: Markers, motion: MotionTree | None) -> bool:
    """Whether a C3D holds its points and, from the next block on, its rotations; ezc3d tells of no full disk."""
    data = path.read_bytes()
    first = int.from_bytes(data[16:18], "little") - 1  # blocks before the points
    points = 4 * 4 * len(markers.names) * markers.n_frames  # bytes
    rotations = 0 if motion is None else 17 * 4 * motion.n_nodes * motion.n_frames
    return first > 0 and len(data) >= _BLOCK * (first + -(-points // _BLOCK)) + rotations


def _add_texts(file: dict, group: str, name: str, texts: tuple[str, ...]) -> None:
    """Add texts as NAME, NAME2, NAME3 … of at most 255 each."""
    for k, start in enumerate(range(0, len(texts), LABELS_PER_PARAMETER)):
        part = list(texts[start : start + LABELS_PER_PARAMETER])
        file.add_parameter(group, name if k == 0 else f"{name}{k + 1}", part)  # type: ignore[attr-defined]


def _residuals_mm(markers: Markers) -> np.ndarray:
    """Residuals in mm, (T, K): -1 in gaps, 0 where not known."""
    known = np.zeros(markers.present.shape) if markers.residuals is None else markers.residuals * 1000
    return np.where(markers.present, np.nan_to_num(known), -1.0)


def _transforms(motion: MotionTree) -> np.ndarray:
    """4×4 transforms, world from node, in the file's axes and unit: (4, 4, N, T)."""
    R, p = motion.forward_kinematics()
    matrices = np.zeros((4, 4, motion.n_nodes, motion.n_frames))
    matrices[:3, :3] = C3D.rotations(R, motion.up).transpose(2, 3, 1, 0)
    matrices[:3, 3] = C3D.points(p, motion.up).transpose(2, 1, 0)
    matrices[3, 3] = 1
    return matrices


def read_c3d(path: Path, *, up: Axis | None = None) -> Markers:
    """Read the markers of a C3D file of any system, in metres.

    Parameters
    ----------
    path : Path
    up : "x", "y" or "z", optional
        The file's axis that points up; by default what POINT:Y_SCREEN says, or z.

    Raises
    ------
    MotionError
        If the file is no C3D, ends too early, holds no points, names one twice, or says no usable rate or unit.
    """
    file = read_c3d_file(path)
    unit = (file.texts("POINT:UNITS") or [""])[0].strip().lower()
    if unit not in UNITS_PER_METRE:
        raise MotionError(f"{path}: POINT:UNITS is {unit!r}; expected one of {', '.join(UNITS_PER_METRE)}")
    names = file.texts("POINT:LABELS")[: file.points.shape[1]]
    gaps = (file.residuals < 0) | ~np.isfinite(file.points).all(axis=2)
    positions = np.where(gaps[..., None], np.nan, file.points / UNITS_PER_METRE[unit])
    known = np.where(gaps, np.nan, file.residuals / UNITS_PER_METRE[unit])
    axes: dict[str, Axis] = {"+X": "x", "+Y": "y", "+Z": "z"}
    screen = (file.texts("POINT:Y_SCREEN") or [""])[0].strip().upper()
    try:
        return Markers(tuple(names), positions, file.rate, up or axes.get(screen, "z"), known)
    except MotionError as error:
        raise MotionError(f"{path}: {error}") from None
