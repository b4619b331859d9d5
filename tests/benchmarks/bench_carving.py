"""Space carving: 8 silhouettes of 320×240 of a figure made in code, 256³ voxels."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from geomocap.carving.carving_settings import CarvingSettings, ConsistencySettings, HullSettings
from geomocap.carving.frames import carve_frame
from geomocap.carving.hull import hull
from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.subject_bounds import subject_box
from geomocap.carving.visibility import SurfaceVoxels, depth_buffers, enclosing_normals, normals
from geomocap.carving.voxel_grid import Grid
from tests.benchmarks.table import Row, measure
from tests.geomocap.carving_scenes import FIGURE, ring, silhouettes
from tests.geomocap.hull_reference import visual_hull_brute, visual_hull_numpy

GRID = Grid(np.array([-1.0, -1.0, -0.1]), 2 / 256, (256, 256, 256))


def carve_with_open3d(P: np.ndarray, masks: list[np.ndarray]) -> o3d.geometry.VoxelGrid:
    """Carve with what Open3D has for it; it wants intrinsics and extrinsics apart."""
    grid = o3d.geometry.VoxelGrid.create_dense(GRID.origin, [0.5, 0.5, 0.5], GRID.voxel_size, 2.0, 2.0, 2.0)
    for camera, mask in zip(P, masks, strict=True):
        K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
        parameters = o3d.camera.PinholeCameraParameters()
        parameters.intrinsic = o3d.camera.PinholeCameraIntrinsic(320, 240, K)
        parameters.extrinsic = np.vstack([np.linalg.solve(K, camera), [0, 0, 0, 1]])
        grid.carve_silhouette(o3d.geometry.Image(mask.astype(np.float32)), parameters, False)
    return grid


def textured_images(views: PinholeViews) -> np.ndarray:
    """Pictures of a surface with a texture fixed in space, and noise: what colour consistency has to read."""
    rng = np.random.default_rng(0)
    depth = depth_buffers(views, GRID, SurfaceVoxels.of(hull(views, GRID)))
    C, H, W = depth.shape
    v, u = np.mgrid[0:H, 0:W] + 0.5
    images = np.full((C, H, W, 3), 90.0)
    for c, P in enumerate(views.projections):
        hit = np.isfinite(depth[c])
        rays = np.stack([u, v, np.ones_like(u)], axis=-1)[hit] * depth[c][hit][:, None] - P[:, 3]
        phase = np.linalg.solve(P[:, :3], rays.T).T * 2 * np.pi / 0.15
        images[c][hit] = 128 + 90 * np.sin(phase + phase[:, [1, 2, 0]])
    return np.clip(images + rng.normal(0, 3, images.shape), 0, 255).astype(np.uint8)


def outward_sides() -> Row:
    """Which way a flying body's thin wings face, of whose 256³ grid the surface is known."""
    x, y, z = np.mgrid[-1:1:256j, -1:1:256j, -0.5:0.5:128j]
    wings = (np.abs(z - 0.3 * np.abs(x)) < 0.012) & (np.abs(y) < 0.3) & (np.abs(x) < 0.95)
    occupancy = Occupancy.of_dense(wings | ((x / 0.2) ** 2 + (y / 0.6) ** 2 + (z / 0.15) ** 2 < 1))
    surface = occupancy.surface_indices()
    right = normals(occupancy, surface)

    def with_open3d() -> np.ndarray:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(surface.astype(float)))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(15))
        cloud.orient_normals_consistent_tangent_plane(15)
        return np.asarray(cloud.normals)

    wrong = [float(((n * right).sum(axis=1) < 0).mean()) for n in (enclosing_normals(surface), with_open3d())]
    return Row(
        f"outward normals of {len(surface):,} surface voxels, thin wings",
        measure(lambda: enclosing_normals(surface), 5),
        "Open3D estimate_normals + consistent tangent plane",
        measure(with_open3d, 1, warm_up=False),
        note=f"wrong side {wrong[0]:.3f}, Open3D {min(wrong[1], 1 - wrong[1]):.3f} (either side of all)",
    )


def benchmark() -> list[Row]:
    """Time the hull beside what else there is, then what goes beyond it."""
    P = ring(8)
    masks = silhouettes(P, FIGURE)
    views = PinholeViews.of(P, masks)
    full = PinholeViews.of(P, [np.ones_like(m) for m in masks])
    images = textured_images(views)
    out = np.zeros(GRID.shape, np.uint8)
    brute = visual_hull_brute(views, GRID)
    same = "identical" if np.array_equal(hull(views, GRID).dense(), brute) else "DIFFERENT from brute force"
    plain = CarvingSettings(consistency=ConsistencySettings(enabled=False))
    consistent = CarvingSettings()

    ours = measure(lambda: hull(PinholeViews.of(P, masks), GRID), 25)
    brute_time = measure(lambda: visual_hull_brute(views, GRID), 7)
    note = f"{same}; {int(brute.sum()):,} voxels, {len(hull(views, GRID).surface_indices()):,} on the surface"
    return [
        Row("hull, 8 × 320×240, 256³", ours, "Numba brute force", brute_time, "≤ 6 ms, ≥ 10 ×", note),
        Row(
            "hull into an array of bytes",
            measure(lambda: hull(views, GRID).dense(out), 25),
            "Numba brute force",
            brute_time,
            "",
            "16 MB written",
        ),
        Row(
            "hull",
            ours,
            "Open3D create_dense + carve_silhouette",
            measure(lambda: carve_with_open3d(P, masks), 1, warm_up=False),
        ),
        Row("hull", ours, "NumPy", measure(lambda: visual_hull_numpy(views, GRID), 1, warm_up=False)),
        Row(
            "hull, everything foreground",
            measure(lambda: hull(full, GRID), 15),
            "Numba brute force",
            measure(lambda: visual_hull_brute(full, GRID), 3),
        ),
        Row("hull, outside unseen", measure(lambda: hull(views, GRID, HullSettings(outside="unseen")), 15)),
        Row("surface voxels of the hull, sorted", measure(lambda: hull(views, GRID).surface_indices(), 25)),
        Row("one frame, colours by visibility", measure(lambda: carve_frame(views, GRID, plain, images), 9)),
        Row(
            "one frame, colour consistency",
            measure(lambda: carve_frame(views, GRID, consistent, images), 9),
            goal="≤ 100 ms",
            note=f"{consistent.consistency.max_passes} passes at most",
        ),
        Row("box round the subject", measure(lambda: subject_box(views, HullSettings()), 9)),
        outward_sides(),
    ]
