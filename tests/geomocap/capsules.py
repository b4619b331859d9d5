"""Points on a flattened capsule that bends in the middle, and its node graph."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.nodes.node_graph import farthest_points, node_graph
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.surface_points import point_set, surface_graph

SMALL = NodeTrackingSettings(nodes=150, coarse_nodes=60, points=1200, coarse_points=800)


def capsule(count: int, length: float = 1.0, radius: float = 0.08, seed: int = 0) -> np.ndarray:
    """Points on a flattened capsule along x, evenly by area but for the flattening."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    side = rng.random(count) < length / (length + 2 * radius)
    d[side, 0] = 0
    d[side] /= np.linalg.norm(d[side], axis=1, keepdims=True)
    p = radius * d
    p[:, 0] += np.where(side, rng.uniform(0, length, count), np.where(d[:, 0] > 0, length, 0))
    return p * [1, 1, 0.7]


def bend(p: np.ndarray, angle: float) -> np.ndarray:
    """Bend what lies at x > 0.5 about z by an angle, smoothly over 10 cm; lengths along the middle stay."""
    fraction = np.clip((p[:, 0] - 0.45) / 0.1, 0, 1) * angle
    R = Rotation.from_rotvec(np.column_stack([0 * fraction, 0 * fraction, fraction])).as_matrix()
    joint = np.array([0.5, 0, 0])
    return np.einsum("nij,nj->ni", R, p - joint) + joint


def small_graph():
    surface = point_set(capsule(900), 900, 9)
    graph = surface_graph(surface.positions, surface.normals, 8)
    chosen = farthest_points(surface.positions, 50)
    return surface, graph, node_graph(surface, graph, chosen, 300)
