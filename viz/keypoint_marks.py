"""Key-points drawn over a camera's picture: circles, names and links."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.model.keypoint_paths import KeyPoints
from geomocap.model.rig import Rig
from viz.drawing import write_on

MEASURED = (0, 150, 120)
"""Colour of key-points that trajectories inside move, RGB 0–255."""

BRIDGED = (236, 140, 20)
"""Colour of key-points that the body round them carries."""

LOST = (205, 208, 212)
"""Colour of frames in which a key-point has no place."""

CHOSEN = (20, 110, 230)
"""Colour of the key-point that is being edited."""

LINK = (60, 66, 75)
"""Colour of lines between key-points."""

_SHIFT = 4  # binary places of subpixels


@dataclass(frozen=True)
class Marks:
    """Key-points through time, to be drawn.

    Attributes
    ----------
    names : tuple of K str
    positions : (T, K, 3) float, metres
        NaN in gaps.
    radius : (K,) float, metres
    bridged : (T, K) bool
    links : (L, 2) int
        Key-points that a line joins.
    chosen : str or None
        The one being edited.
    """

    names: tuple[str, ...]
    positions: np.ndarray
    radius: np.ndarray
    bridged: np.ndarray
    links: np.ndarray
    chosen: str | None = None

    @property
    def states(self) -> np.ndarray:
        """What is known in each frame, (T, K) int: 0 nothing, 1 bridged, 2 measured."""
        present = np.isfinite(self.positions[:, :, 0])
        return np.where(present, np.where(self.bridged, 1, 2), 0)

    def color(self, frame: int, k: int) -> tuple[int, int, int]:
        """Return the colour of a key-point in a frame."""
        return BRIDGED if self.bridged[frame, k] else CHOSEN if self.names[k] == self.chosen else MEASURED


def marks_of_run(points: KeyPoints) -> Marks:
    """Return a run's key-points to be drawn."""
    return Marks(points.names, points.paths.positions, points.radius, points.paths.bridged, points.links)


def marked(image: np.ndarray, camera: Rig, marks: Marks, frame: int) -> np.ndarray:
    """Return a camera's picture with the key-points of a frame drawn over it.

    Parameters
    ----------
    image : (H, W, 3) uint8
        At any size.
    camera : Rig
        Of this one camera.
    marks : Marks
    frame : int
        Place in the arrays of `marks`.
    """
    drawn = np.ascontiguousarray(image).copy()
    scale = image.shape[1] / camera.sizes[0, 0]
    places = marks.positions[frame]
    pixels = camera.project(places)[0] * scale
    depth = camera.to_camera(places)[0, :, 2]
    focal = camera.cameras[0].focal_length_x * scale
    seen = np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e4).all(axis=1)
    thick = max(1, round(image.shape[1] / 400))
    for a, b in marks.links:
        if seen[a] and seen[b]:
            start, end = _fixed(pixels[a]), _fixed(pixels[b])
            cv2.line(drawn, start, end, (255, 255, 255), thick + 2, cv2.LINE_AA, _SHIFT)
            cv2.line(drawn, start, end, LINK, thick, cv2.LINE_AA, _SHIFT)
    for k in np.flatnonzero(seen).tolist():
        color, radius = marks.color(frame, k), max(2.5, focal * marks.radius[k] / depth[k])
        size = round(radius * 2**_SHIFT)
        center = _fixed(pixels[k])
        cv2.circle(drawn, center, size, (255, 255, 255), thick + 2, cv2.LINE_AA, _SHIFT)
        cv2.circle(drawn, center, size, color, thick, cv2.LINE_AA, _SHIFT)
        cv2.circle(drawn, center, 2**_SHIFT * (thick + 1), color, -1, cv2.LINE_AA, _SHIFT)
    letters = max(9, round(image.shape[1] / 42))
    height, width = image.shape[:2]
    for k in np.flatnonzero(seen).tolist():
        x, y = pixels[k]
        if 0 <= x < width and 0 <= y < height:
            reach = max(2.5, focal * marks.radius[k] / depth[k]) + 3
            at = (float(x + reach), float(y)) if x < 0.7 * width else (float(x - reach), float(y))
            anchor = "lm" if x < 0.7 * width else "rm"
            plate = (255, 255, 255)
            drawn = write_on(drawn, marks.names[k], at, letters, marks.color(frame, k), anchor=anchor, plate=plate)
    return drawn


def _fixed(pixel: np.ndarray) -> tuple[int, int]:
    """Return a COLMAP pixel as OpenCV's drawing functions want it, in parts of a pixel."""
    x, y = np.rint((pixel - 0.5) * 2**_SHIFT).astype(int)
    return int(x), int(y)
