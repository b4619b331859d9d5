"""The centre of a ball's image is not the image of its centre.

A sphere's outline is the rim of a cone of rays, an ellipse whose centre lies farther from the principal point than the
centre's own image, by about the squared ratio of radius and distance; distortion bends it further. The shift is
computed by sending the rim through the camera.
"""

from __future__ import annotations

import numpy as np

from geomocap.calibration.network import Network
from geomocap.calibration.projection import camera_of
from geomocap.calibration.target_observations import TargetObservations


def ball_radius(network: Network, radii: np.ndarray) -> float:
    """Estimate the balls' radius, metres, from their radii in the images.

    Parameters
    ----------
    network : Network
    radii : (M,) float
        Radius of each observed target, pixels.
    """
    depth = _in_camera(network)[:, 2]
    focal = network.interior[network.view_camera[network.view], :2].mean(axis=1)
    return float(np.median(radii * depth / focal))


def shifts(network: Network, radius: float) -> np.ndarray:
    """How far the centres of the balls' images are from the images of the balls' centres, (M, 2) float, pixels.

    Parameters
    ----------
    network : Network
    radius : float
        Of the balls, metres.
    """
    points = _in_camera(network)
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    axis = points / distance
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(axis, across)
    sine = np.minimum(radius / distance, 0.5)
    slope = sine / np.sqrt(1 - sine**2)
    angles = np.arange(32) * (np.pi / 16)
    rim = axis[:, None] + slope[:, :, None] * (
        np.cos(angles)[:, None] * across[:, None] + np.sin(angles)[:, None] * other[:, None]
    )
    out = np.zeros((len(points), 2))
    for c in range(len(network.names)):
        rows = np.flatnonzero(network.view_camera[network.view] == c)
        if not len(rows):
            continue
        camera = camera_of(network.interior[c], (int(network.sizes[c, 0]), int(network.sizes[c, 1])))
        image = camera.img_from_cam(rim[rows].reshape(-1, 3)).reshape(len(rows), -1, 2)
        out[rows] = _outline_center(image) - camera.img_from_cam(points[rows])
    return out


def _outline_center(rim: np.ndarray) -> np.ndarray:
    """Centres of gravity of the areas within outlines (n, k, 2): (n, 2)."""
    origin = rim.mean(axis=1, keepdims=True)
    p = rim - origin
    q = np.roll(p, -1, axis=1)
    cross = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    area = cross.sum(axis=1, keepdims=True) / 2
    return origin[:, 0] + np.einsum("nk,nki->ni", cross, p + q) / (6 * area)


def _in_camera(network: Network) -> np.ndarray:
    X = network.bars[network.bar, network.end]
    return np.einsum("mij,mj->mi", network.rotation[network.view], X) + network.translation[network.view]


def observed_radii(network: Network, observations: TargetObservations, chosen: np.ndarray) -> np.ndarray:
    """Radii (M,) of the observed targets of a network whose views are the observations' cameras."""
    t = np.searchsorted(observations.frames, network.frames)[network.bar]
    c = network.view_camera[network.view]
    return observations.radii[c, t, chosen[c, t, network.end]]
