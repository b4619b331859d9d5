"""Cameras as a scene in three dimensions shows them: where they stand, and their pictures without distortion."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np

from geomocap.errors import GeomocapError
from geomocap.export.conventions import GLB, Axis
from geomocap.files.capture import Capture
from geomocap.model.rig import Rig
from geomocap.scheduling import map_items, threads
from viz.drawing import webp
from viz.run_contents import Results

PICTURES = 320
"""Pictures of all cameras together that a page carries at most."""

LONGEST_SIDE = 288
"""Of such a picture, pixels."""


def frusta(results: Results, up: Axis) -> dict[str, Any]:
    """Return the cameras of a run's capture, y up, and the frames (places in the sequence) of which there are pictures.

    Each camera has its centre, the directions to the four corners of its picture at unit depth (from the top left
    clockwise), and its pictures as data for a page.
    """
    capture = results.capture
    if capture is None or not capture.is_calibrated:
        return {"cameras": [], "pictured": []}
    rig, frames = capture.rig, results.frames
    count = max(1, min(len(frames), PICTURES // max(len(rig), 1)))
    places = sorted({round(p) for p in np.linspace(0, len(frames) - 1, count)})

    def one(c: int) -> dict[str, Any]:
        width, height = rig.sizes[c]
        camera, R = rig.cameras[c], rig.cam_from_world[c, :, :3]
        f = np.array([camera.focal_length_x, camera.focal_length_y])
        middle = np.array([camera.principal_point_x, camera.principal_point_y])
        corners = (np.array([[0, 0], [width, 0], [width, height], [0, height]]) - middle) / f
        directions = np.column_stack([corners, np.ones(4)]) @ R
        half = np.abs(corners).max(axis=0)
        return {
            "name": rig.names[c],
            "doubtful": rig.names[c] in results.camera_doubts.contradicting,
            "center": _rounded(GLB.points(rig.centers[c], up)),
            "corners": _rounded(GLB.points(directions, up)),
            "forward": _rounded(GLB.points(R[2], up)),
            "up": _rounded(GLB.points(-R[1], up)),
            "half": _rounded(half),
            "pictures": _pictures(capture, rig, c, [frames[p] for p in places]),
        }

    with threads() as executor:
        return {"cameras": list(map_items(one, list(range(len(rig))), executor)), "pictured": places}


def undistorting_maps(rig: Rig, camera: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Say where each pixel of a small picture without distortion comes from in a small picture with it.

    Both have `size` (width, height) and show as much; camera constant and principal point stay. As `cv2.remap` wants
    it: (h, w) float32 array indices.
    """
    own = rig.cameras[camera]
    scale = np.array(size, float) / rig.sizes[camera]
    x, y = np.meshgrid((np.arange(size[0]) + 0.5) / scale[0], (np.arange(size[1]) + 0.5) / scale[1])
    n = np.column_stack(
        [
            (x.ravel() - own.principal_point_x) / own.focal_length_x,
            (y.ravel() - own.principal_point_y) / own.focal_length_y,
            np.ones(x.size),
        ]
    )
    source = np.nan_to_num(np.asarray(own.img_from_cam(n), float) * scale - 0.5, nan=-1e6).astype(np.float32)
    return source[:, 0].reshape(x.shape), source[:, 1].reshape(x.shape)


def _pictures(capture: Capture, rig: Rig, camera: int, frames: list[int]) -> list[str]:
    scale = min(1.0, LONGEST_SIDE / float(rig.sizes[camera].max()))
    width, height = (max(1, round(float(s) * scale)) for s in rig.sizes[camera])
    maps = None if rig.cameras[camera].is_undistorted() else undistorting_maps(rig, camera, (width, height))
    found = []
    for frame in frames:
        try:
            image = capture.frame(rig.names[camera], frame)
        except GeomocapError:
            return []  # the cameras are shown without
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        if maps is not None:
            small = cv2.remap(small, *maps, interpolation=cv2.INTER_LINEAR, borderValue=(128, 128, 128))
        data = webp(np.asarray(small, np.uint8), 60)
        found.append(f"data:image/webp;base64,{base64.b64encode(data).decode()}")
    return found


def _rounded(values: np.ndarray) -> list[Any]:
    return np.round(values, 5).tolist()
