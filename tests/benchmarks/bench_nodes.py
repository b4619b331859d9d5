"""Node tracking: a bending figure of five limbs, 4,096 points sampled afresh in each frame."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from geomocap.model.point_grid import PointGrid
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_tracking import track_nodes
from geomocap.nodes.surface_points import point_set
from tests.benchmarks.table import Row, measure
from tests.geomocap.star_scenes import star_points, star_truth

FRAMES = 12
POINTS = 4096


def normals_with_open3d(points: np.ndarray) -> np.ndarray:
    """Oriented normals with what Open3D has for it."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(10))
    cloud.orient_normals_consistent_tangent_plane(10)
    return np.asarray(cloud.normals)


def nearest_points() -> Row:
    """Time points of a bent figure, with normals and colours, found from another frame's, beside SciPy's tree."""
    now, then = (point_set(star_points(t / FRAMES, POINTS, seed=t), POINTS, 9) for t in (0, 1))
    colours = np.random.default_rng(0).random((2, POINTS, 3))
    data, asked = (
        np.hstack([p.positions, 0.05 * p.normals, 0.05 * c[: len(p)]])
        for p, c in zip((now, then), colours, strict=True)
    )
    return Row(
        f"nearest of {len(now):,} points with normals and colours for as many, grid made anew",
        measure(lambda: PointGrid.of(data).query(asked), 20),
        "SciPy cKDTree",
        measure(lambda: cKDTree(data).query(asked), 20),
    )


def benchmark() -> list[Row]:
    """Time nearest points, the normals beside Open3D's, and the whole tracking."""
    frames = [star_points(t / FRAMES, POINTS, seed=t) for t in range(FRAMES)]
    settings = NodeTrackingSettings()
    tracks = track_nodes(lambda t: frames[t], FRAMES, settings)
    error = star_truth(tracks, FRAMES)
    fraction = 60 / FRAMES
    normals = measure(lambda: point_set(frames[0], POINTS, 9), 5)
    tracking = measure(lambda: track_nodes(lambda t: frames[t], FRAMES, settings), 2, warm_up=False)
    return [
        nearest_points(),
        Row(
            f"normals turned outwards, {POINTS:,} points",
            normals,
            "Open3D estimate_normals + consistent tangent plane",
            measure(lambda: normals_with_open3d(frames[0]), 3),
        ),
        Row(
            f"nodes through 60 frames ({FRAMES} timed × {fraction:.0f}), {settings.nodes:,} nodes, {POINTS:,} points",
            tracking * fraction,
            goal="≤ 30 s",
            note=f"drift median {np.nanmedian(error) * 1000:.1f} mm, p95 {np.nanpercentile(error, 95) * 1000:.1f} mm",
        ),
    ]
