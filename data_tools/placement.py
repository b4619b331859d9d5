"""Cameras around a moving subject, so that its whole motion fills each picture."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from data_tools.camera_views import framing_distance
from geomocap.model.colmap_library import pycolmap
from geomocap.model.rig import Rig


def camera_names(count: int) -> tuple[str, ...]:
    """Names cam01, cam02 …"""
    return tuple(f"cam{k + 1:02d}" for k in range(count))


def make_camera(
    width: int, height: int, hfov_deg: float, distortion: float, random: np.random.Generator
) -> pycolmap.Camera:
    """Make an OPENCV camera, each a little different, as lenses are.

    Parameters
    ----------
    hfov_deg : float
        Angle of view across the longer side of the image, degrees.
    distortion : float
        0 for none, 1 for mild barrel distortion (k1 about −0.1: 3 % at the corners of a 50° view).
    """
    focal = max(width, height) / 2 / np.tan(np.deg2rad(hfov_deg) / 2) * random.uniform(0.98, 1.02)
    aspect = random.uniform(0.999, 1.001)
    cx, cy = np.array([width, height]) * random.uniform(0.49, 0.51, 2)
    k1, k2 = random.uniform(-0.12, -0.07), random.uniform(0.01, 0.03)
    p1, p2 = random.uniform(-5e-4, 5e-4, 2)
    params = [focal, focal * aspect, cx, cy, *(distortion * np.array([k1, k2, p1, p2]))]
    return pycolmap.Camera(model="OPENCV", width=width, height=height, params=params)


def outline(points: np.ndarray) -> np.ndarray:
    """Vertices of the convex hull, which a camera sees all points inside of: (K, 3)."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # flat subjects have no hull in space
        return points


def place_cameras(
    cameras: list[pycolmap.Camera],
    points: np.ndarray,
    arc_deg: float,
    camera_height: float | None,
    distance: float | None,
    fill: float,
) -> Rig:
    """Place cameras on an arc around the subject.

    Parameters
    ----------
    cameras : list of C pycolmap.Camera
    points : (N, 3) float, metres, world
        All places that the subject ever fills; see `outline`.
    arc_deg : float
        360 for a whole circle; the first camera of a smaller arc is at its right end, seen from the subject.
    camera_height : float, optional
        Metres above the floor; alternately 0.6 and 1.4 of the subject's height if not given.
    distance : float, optional
        From the middle of the subject, metres; for each camera as near as `fill` allows if not given.
    fill : float
        Fraction of the half width and height of the image within which the subject stays.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    middle, top = (low + high) / 2, float(high[2])
    count = len(cameras)
    step = arc_deg / count if arc_deg >= 360 else arc_deg / max(count - 1, 1)
    start = 0.0 if arc_deg >= 360 else -step * (count - 1) / 2
    poses = []
    for k, camera in enumerate(cameras):
        angle = np.deg2rad(start + k * step - 90)  # from the front, which is −y
        above = camera_height if camera_height is not None else max(0.3, (0.6, 1.4)[k % 2] * top)

        def place(d: float, angle: float = angle, above: float = above) -> tuple[np.ndarray, np.ndarray]:
            flat = middle[:2] + d * np.array([np.cos(angle), np.sin(angle)])
            return np.array([*flat, above]), middle

        closest = distance if distance is not None else float(np.linalg.norm(high[:2] - low[:2])) / 2 + 0.1
        poses.append(framing_distance(camera, place, points, 10.0 if distance is not None else fill, closest)[0])
    return Rig(camera_names(count), tuple(cameras), np.array(poses))
