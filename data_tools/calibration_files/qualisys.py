"""Calibrations of Qualisys Track Manager: XML, 1/64 pixels, millimetres."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from data_tools.calibration_files.opencv_cameras import HALF_PIXEL
from geomocap.errors import CalibrationError
from geomocap.model.colmap_library import pycolmap
from geomocap.model.orientations import LONGEST_SIDE, NOTED, nearest_rotation
from geomocap.model.rig import Rig
from geomocap.reading import read_text, reason

SUBPIXELS = 64.0


def read_qualisys(path: Path) -> Rig:
    """Read a Qualisys calibration (`*.qca.txt`).

    Focal lengths and principal points are in 1/64 pixel; the camera's centre C is in millimetres, and
    x_cam = diag(1, −1, −1) R (X − C) with R's rows r11 r12 r13 and so on. The distortion is OpenCV's (k1 k2 p1 p2,
    and k3 if it isn't zero).

    Pixels: the files give a sensor of 1088 pixels the range sensorMinU = 0 to sensorMaxU = 1087 · 64, so the first
    pixel's centre is 0 and not 32: the centre of the top-left pixel is (0, 0). A field of view that does not begin
    at pixel 0 moves the principal point by its left and top border.

    Raises
    ------
    CalibrationError
        If the file is no such XML, holds no camera, or lacks something, or the sensor is turned (viewrotation).
    """
    path = Path(path)
    text = read_text(path, CalibrationError, "give a calibration file")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CalibrationError(f"{path}: has a document type or entities, which a Qualisys calibration never has")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise CalibrationError(
            f"{path}: no readable XML ({reason(error)}); export the calibration from QTM again"
        ) from None
    names: list[str] = []
    cameras: list[pycolmap.Camera] = []
    poses: list[np.ndarray] = []
    notes: list[str] = []
    for node in root.iter("camera"):
        if node.get("active", "1") != "1":
            continue
        name = node.get("serial") or f"cam{len(names) + 1:02d}"
        where = f"{path}: camera {name}"
        if "viewrotation" in node.attrib and _number(node, "viewrotation", where) != 0:
            raise CalibrationError(f"{where}: viewrotation is not 0; export the calibration without rotated views")
        intrinsic, transform = _part(node, "intrinsic", where), _part(node, "transform", where)
        view = node.find("fov_video")
        if view is None:
            view = _part(node, "fov_marker", where)
        left, top, right, bottom = (_number(view, k, where) for k in ("left", "top", "right", "bottom"))
        fx, fy = (_number(intrinsic, f"focalLength{k}", where) / SUBPIXELS for k in "UV")
        cx = _number(intrinsic, "centerPointU", where) / SUBPIXELS - left + HALF_PIXEL
        cy = _number(intrinsic, "centerPointV", where) / SUBPIXELS - top + HALF_PIXEL
        if abs(_number(intrinsic, "skew", where)) > 1e-9:
            raise CalibrationError(f"{where}: a skew can't be represented; calibrate without skew")
        k1, k2, k3 = (_number(intrinsic, f"radialDistortion{k}", where) for k in (1, 2, 3))
        p1, p2 = (_number(intrinsic, f"tangentalDistortion{k}", where) for k in (1, 2))
        params = [fx, fy, cx, cy, k1, k2, p1, p2]
        if not (0 <= right - left < LONGEST_SIDE and 0 <= bottom - top < LONGEST_SIDE):
            raise CalibrationError(
                f"{where}: its view, {left:g} to {right:g} by {top:g} to {bottom:g}, can't be an image"
            )
        model = "OPENCV" if k3 == 0 else "FULL_OPENCV"
        cameras.append(
            pycolmap.Camera(
                model=model,
                width=round(right - left) + 1,
                height=round(bottom - top) + 1,
                params=params if k3 == 0 else [*params, k3, 0.0, 0.0, 0.0],
            )
        )
        R = np.diag([1.0, -1.0, -1.0]) @ [[_number(transform, f"r{i}{j}", where) for j in "123"] for i in "123"]
        center = np.array([_number(transform, k, where) for k in "xyz"]) / 1000.0
        nearest, off = nearest_rotation(R, where)  # printed with few digits in some versions
        if off > NOTED:
            notes.append(f"camera {name}: its rotation is orthonormal to {off:.1g} only; the nearest rotation is taken")
        names.append(name)
        poses.append(np.column_stack([nearest, -nearest @ center]))
    if not names:
        raise CalibrationError(f"{path}: holds no active camera; is it a Qualisys calibration?")
    return Rig.of_file(str(path), names, cameras, np.array(poses), notes)


def _part(node: ElementTree.Element, tag: str, where: str) -> ElementTree.Element:
    part = node.find(tag)
    if part is None:
        raise CalibrationError(f"{where}: has no <{tag}>; export the calibration from QTM again")
    return part


def _number(node: ElementTree.Element, key: str, where: str) -> float:
    try:
        value = float(node.attrib[key])
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise CalibrationError(f"{where}: <{node.tag}> has no number {key}; export it from QTM again")
    return value
