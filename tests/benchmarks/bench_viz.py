"""Rendering of 25,000 voxels at 640 × 480 and of a skeleton in its glass skin, beside Open3D's own renderer."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from tests.benchmarks.table import Row, measure
from viz.body_colors import body_colors
from viz.rendering import Look, render
from viz.viewpoints import stage_of
from viz.volumes import cubes, skin


def _figure(size: float = 0.0145) -> tuple[np.ndarray, np.ndarray]:
    """Surface voxels of six capsules, about 25,000: indices (N, 3) and the capsule of each."""
    rng = np.random.default_rng(0)
    found, owner = [], []
    capsules = [
        (0, 1.2, 0.5, 0.15),  # x, z, length, radius: metres
        (0, 1.65, 0.1, 0.1),
        (0.25, 1.1, 0.6, 0.05),
        (-0.25, 1.1, 0.6, 0.05),
        (0.1, 0.45, 0.8, 0.08),
        (-0.1, 0.45, 0.8, 0.08),
    ]
    for k, (x, z, length, radius) in enumerate(capsules):
        n = rng.normal(size=(60_000, 3))
        s = rng.uniform(-0.5, 0.5, len(n))
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        points = np.column_stack([np.full(len(s), x), np.zeros(len(s)), z + s * length]) + radius * n
        index = np.unique(np.floor(points / size).astype(int), axis=0)
        found.append(index)
        owner.append(np.full(len(index), k))
    return np.concatenate(found), np.concatenate(owner)


def benchmark() -> list[Row]:
    """Measure the renderer."""
    indices, owner = _figure()
    size = 0.0145
    points = (indices + 0.5) * size
    colors = body_colors(owner)
    stage = stage_of([points], [0], 1, np.array([0, 0, 1.0]))
    view = stage.view(35, 15, (640, 480))
    mesh = cubes(indices, np.zeros(3), size, colors)
    glass = skin(points, colors).translucent(0.2)
    look = Look()
    rows = [
        Row(
            f"{len(indices):,} voxels to a mesh of cubes, and rendered at 640 × 480, 4 rays a pixel",
            measure(lambda: render([cubes(indices, np.zeros(3), size, colors)], view, look, stage.up), 3),
            "Open3D Visualizer (EGL, 1 sample a pixel)",
            _open3d_seconds(indices, colors, size),
            note="no graphics stack; any camera, distortion included",
        ),
        Row("the same, only rendered", measure(lambda: render([mesh], view, look, stage.up), 3)),
        Row("smooth skin around the voxels", measure(lambda: skin(points, colors), 3)),
        Row("the skin rendered as glass, two layers", measure(lambda: render([glass], view, look, stage.up), 3)),
    ]
    return rows


def _open3d_seconds(indices: np.ndarray, colors: np.ndarray, size: float) -> float:
    """Time of drawing the voxels with Open3D's own window, NaN where it can't open one offscreen."""
    window = o3d.visualization.Visualizer()
    if not window.create_window(width=640, height=480, visible=False):
        return float("nan")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector((indices + 0.5) * size))
    cloud.colors = o3d.utility.Vector3dVector(colors / 255)

    def draw() -> object:
        window.clear_geometries()
        window.add_geometry(o3d.geometry.VoxelGrid.create_from_point_cloud(cloud, size))
        window.poll_events()
        window.update_renderer()
        return window.capture_screen_float_buffer(True)

    seconds = measure(draw, 3)
    window.destroy_window()
    return seconds
