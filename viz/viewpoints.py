"""Where a picture is taken from: free views that take in a whole motion, and the cameras of a capture.

A view says which pixel a world point falls on and which ray belongs to a pixel. Pixels are COLMAP's: the centre of
the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.rig import Rig

_AROUND = 1.5  # of the subject's size in an image, that is shown of it
_WHOLE = 0.8  # of an image's size from which all of it is shown
_LEAST = 0.1  # of an image's size that is shown
_LARGEST = 4.0  # times that a part of an image is enlarged at most


class View(Protocol):
    """A picture's size and geometry."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        ...

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (N, 2) of world points (N, 3), NaN behind the view, and depths (N,), metres."""
        ...

    def rays(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the origin (3,) and unit directions (N, 3), world, of the rays through pixels (N, 2)."""
        ...


@dataclass(frozen=True)
class PinholeView:
    """A view without distortion.

    Attributes
    ----------
    size : (int, int)
        Width and height, pixels.
    K : (3, 3) float
        Calibration matrix, pixels.
    cam_from_world : (3, 4) float
        [R | t]; x right, y down, z forward, metres.
    """

    size: tuple[int, int]
    K: np.ndarray
    cam_from_world: np.ndarray

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (N, 2) of world points (N, 3), NaN behind the view, and depths (N,), metres."""
        in_camera = np.asarray(points, float) @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3]
        depth = in_camera[:, 2]
        safe = np.where(depth > 1e-9, depth, np.nan)
        homogeneous = in_camera @ self.K.T
        return homogeneous[:, :2] / safe[:, None], depth

    def rays(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the origin (3,) and unit directions (N, 3), world, of the rays through pixels (N, 2)."""
        R, t = self.cam_from_world[:, :3], self.cam_from_world[:, 3]
        homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
        directions = homogeneous @ (R.T @ np.linalg.inv(self.K)).T
        directions /= np.sqrt(np.einsum("ij,ij->i", directions, directions))[:, None]
        return -R.T @ t, directions

    def moved(self, offset: np.ndarray) -> PinholeView:
        """Return the same view moved by `offset` (3,), metres, world."""
        pose = np.array(self.cam_from_world)
        pose[:, 3] -= pose[:, :3] @ np.asarray(offset, float)
        return PinholeView(self.size, self.K, pose)


@dataclass(frozen=True)
class CameraView:
    """What a camera of a rig sees, distortion included, or a part of it, at its own or another size.

    Attributes
    ----------
    rig : Rig
    camera : int
        Index in the rig.
    size : (int, int)
        Width and height of the picture, pixels; what is seen is scaled to it.
    window : (int, int, int, int)
        Left, top, width and height of what is seen, pixels of the camera's image.
    """

    rig: Rig
    camera: int
    size: tuple[int, int]
    window: tuple[int, int, int, int]

    @property
    def _scale(self) -> np.ndarray:
        return np.array(self.size, float) / self.window[2:]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (N, 2) of world points (N, 3), NaN behind the view, and depths (N,), metres."""
        one = self.rig.select([self.rig.names[self.camera]])
        pixels = (one.project(points)[0] - self.window[:2]) * self._scale
        return pixels, one.to_camera(np.asarray(points, float))[0, :, 2]

    def rays(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the origin (3,) and unit directions (N, 3), world, of the rays through pixels (N, 2)."""
        return self.rig.rays(self.camera, np.asarray(pixels, float) / self._scale + self.window[:2])

    def part_of(self, image: np.ndarray) -> np.ndarray:
        """Return what is seen of the camera's image (H, W, …)."""
        left, top, width, height = self.window
        return image[top : top + height, left : left + width]


def camera_view(rig: Rig, camera: int, longest_side: int | None = None, around: np.ndarray | None = None) -> CameraView:
    """Return the view of a rig's camera, made smaller so that its longest side has `longest_side` pixels at most.

    `around` (N, 3), metres, world: only what is around these points is shown, where that is much less than the image,
    and enlarged if it is small.
    """
    width, height = (int(v) for v in rig.sizes[camera])
    window = 0, 0, width, height
    if around is not None and len(around):
        pixels = rig.select([rig.names[camera]]).project(around)[0]
        window = window_around(pixels, (width, height))
    return CameraView(rig, camera, shown_size(window, (width, height), longest_side or max(width, height)), window)


def shown_size(window: tuple[int, int, int, int], whole: tuple[int, int], longest_side: int) -> tuple[int, int]:
    """Return width and height of the picture of a window of an image whose size is `whole`; only parts are enlarged."""
    most = 1.0 if window[2:] == whole else _LARGEST
    scale = min(most, longest_side / max(window[2:]))
    return max(1, round(window[2] * scale)), max(1, round(window[3] * scale))


def window_around(pixels: np.ndarray, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, width and height of the part of an image that shows what is around pixels (N, 2).

    It has the image's proportions; the whole image where that is hardly less, or where nothing is seen.
    """
    width, height = size
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    seen = seen[((seen >= 0) & (seen <= size)).all(axis=1)]
    if not len(seen):
        return 0, 0, width, height
    low, high = seen.min(axis=0), seen.max(axis=0)
    part = float(np.clip(_AROUND * ((high - low) / size).max(), _LEAST, 1.0))
    if part > _WHOLE:
        return 0, 0, width, height
    w, h = max(1, round(part * width)), max(1, round(part * height))
    left, top = np.clip(np.rint(0.5 * (low + high) - 0.5 * np.array([w, h])), 0, [width - w, height - h]).astype(int)
    return int(left), int(top), w, h


def up_vector(up: str) -> np.ndarray:
    """Return the unit vector of the world axis "x", "y" or "z"."""
    return np.eye(3)["xyz".index(up)]


def look(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the pose (3, 4) of a view from `eye` towards `target` in which `up` points up."""
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    return np.column_stack([R, -R @ np.asarray(eye, float)])


@dataclass(frozen=True)
class ViewStage:
    """Where the motion takes place: what free views must take in.

    Attributes
    ----------
    points : (N, 3) float
        Sample of the subject's points over the whole motion, relative to `centers` of their frames, metres.
    centers : (T, 3) float
        Point that the views look at, for each frame: the same for all frames unless the subject travels far.
    up : (3,) float
        Unit vector that points up.
    broad : (3,) float
        Horizontal unit vector along which the subject is broadest.
    floor : float
        Lowest coordinate along `up`, metres.
    """

    points: np.ndarray
    centers: np.ndarray
    up: np.ndarray
    broad: np.ndarray
    floor: float

    @cached_property
    def diagonal(self) -> float:
        """Diagonal of the box of `points`, metres."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def view(
        self, azimuth_deg: float, elevation_deg: float, size: tuple[int, int], fov_deg: float = 18.0
    ) -> PinholeView:
        """Return the view of the first frame from a direction, as near as the whole motion allows.

        Parameters
        ----------
        azimuth_deg : float
            0 looks at the broad side, 90 along the broad axis.
        elevation_deg : float
            0 looks horizontally, 90 straight down.
        size : (int, int)
            Width and height, pixels.
        fov_deg : float
            Field of view of the longer side.
        """
        azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
        front = np.cross(self.broad, self.up)
        flat = np.cos(azimuth) * front + np.sin(azimuth) * self.broad
        back = np.cos(elevation) * flat + np.sin(elevation) * self.up
        head = np.cos(elevation) * self.up - np.sin(elevation) * flat
        R = look(back, np.zeros(3), head)[:, :3]
        focal = 0.5 * max(size) / np.tan(np.radians(fov_deg / 2))
        K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
        seen = self.points @ R.T
        middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
        half = np.array(size) / 2 / focal * 0.93  # a margin all around
        distance = 0.0
        for _ in range(3):  # centring in perspective depends on the distance a little
            q = seen - middle
            distance = float((np.abs(q[:, :2]) / half - q[:, 2:]).max())
            image = q[:, :2] / (q[:, 2:] + distance)
            middle[:2] += (image.min(axis=0) + image.max(axis=0)) / 2 * distance
        q = seen - middle
        distance = float((np.abs(q[:, :2]) / half - q[:, 2:]).max())
        t = -middle + [0, 0, max(distance, 1e-3)]
        return PinholeView(size, K, np.column_stack([R, t])).moved(self.centers[0])

    def at(self, view: PinholeView, frame: int) -> PinholeView:
        """Return a view of the first frame as it is for frame number `frame` of the motion."""
        return view.moved(self.centers[min(frame, len(self.centers) - 1)] - self.centers[0])


def stage_of(clouds: list[np.ndarray], positions: list[int], n_frames: int, up: np.ndarray) -> ViewStage:
    """Find where the motion takes place from some frames' points.

    Parameters
    ----------
    clouds : list of (N, 3) float
        Points of some frames, metres, world.
    positions : list of int
        Their places in the sequence, increasing.
    n_frames : int
        Length of the sequence.
    up : (3,) float

    Raises
    ------
    GeometryError
        If there are no points.
    """
    filled = [(p, c) for p, c in zip(positions, clouds, strict=True) if len(c)]
    if not filled:
        raise GeometryError("nothing to look at: all frames are empty")
    low, high = (np.array([np.percentile(c, q, axis=0) for _, c in filled]) for q in (0.2, 99.8))
    middles, sizes = (low + high) / 2, (high - low).max(axis=0)
    horizontal = np.eye(3) - np.outer(up, up)
    travel = np.ptp(middles @ horizontal, axis=0).max()
    times = np.arange(n_frames)
    if travel > 1.5 * np.linalg.norm(sizes):  # follow along a straight line: nothing may wobble
        degree = 1 if len(filled) > 1 else 0
        line = np.polynomial.polynomial.polyfit([p for p, _ in filled], middles @ horizontal, degree)
        centers = np.polynomial.polynomial.polyval(times, line).T
    else:
        centers = np.tile((low.min(axis=0) + high.max(axis=0)) / 2 @ horizontal, (n_frames, 1))
    chosen = [c[:: max(1, len(c) // 2000)] for _, c in filled]
    inside = [c[((c >= lo) & (c <= hi)).all(axis=1)] for c, lo, hi in zip(chosen, low, high, strict=True)]
    inside = [i if len(i) else c for i, c in zip(inside, chosen, strict=True)]
    relative = np.concatenate([c - centers[p] for (p, _), c in zip(filled, inside, strict=True)])
    own = np.concatenate([c - c.mean(axis=0) for c in inside]) @ horizontal
    broad = np.linalg.eigh(own.T @ own)[1][:, -1]
    broad = broad @ horizontal
    broad = broad / np.linalg.norm(broad) if np.linalg.norm(broad) > 1e-6 else np.roll(up, 1)
    broad = broad * np.sign(broad[np.argmax(np.abs(broad))])
    return ViewStage(relative, centers, up, broad, float((low @ up).min()))
