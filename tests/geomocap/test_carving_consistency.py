"""Visibility, colours and colour consistency, against ray casting of known surfaces."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from geomocap.carving.carving_settings import CarvingSettings, ConsistencySettings
from geomocap.carving.coloring import GREY, voxel_colors
from geomocap.carving.consistency import camera_gains, carve_inconsistent, color_deviation
from geomocap.carving.frames import carve_frame, needs_images
from geomocap.carving.hull import hull
from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.visibility import (
    SurfaceVoxels,
    VoxelVisibility,
    depth_buffers,
    enclosing_normals,
    normals,
    observations,
)
from geomocap.carving.voxel_grid import Grid
from tests.geomocap.carving_scenes import look_at, ring

WIDTH, HEIGHT = 240, 180


def box_mesh(low, high) -> o3d.t.geometry.TriangleMesh:
    size = np.subtract(high, low)
    mesh = o3d.geometry.TriangleMesh.create_box(*size).translate(low)
    return o3d.t.geometry.TriangleMesh.from_legacy(mesh)


def scene_of(*meshes) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        scene.add_triangles(mesh)
    return scene


def rays_through(P: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Rays (N, 6) of COLMAP pixels (N, 2), directions with unit depth along the axis."""
    inverse = np.linalg.inv(P[:, :3])
    directions = np.column_stack([pixels, np.ones(len(pixels))]) @ inverse.T
    center = -inverse @ P[:, 3]
    return np.column_stack([np.broadcast_to(center, directions.shape), directions]).astype(np.float32)


def texture(points: np.ndarray) -> np.ndarray:
    """Strong smooth texture in space, (N, 3) uint8, with details of about 6 cm."""
    x, y, z = points.T * 2 * np.pi / 0.12
    waves = [np.sin(x + 0.5 * y) * np.cos(z), np.sin(y - 0.7 * z) * np.cos(x), np.sin(z + 0.3 * x) * np.cos(0.8 * y)]
    return np.clip(128 + 110 * np.column_stack(waves), 0, 255).astype(np.uint8)


def photograph(scene: o3d.t.geometry.RaycastingScene, P: np.ndarray) -> tuple[PinholeViews, np.ndarray]:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    pixels = np.column_stack([u.ravel(), v.ravel()])
    masks, images = [], []
    for camera in P:
        rays = rays_through(camera, pixels)
        t = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        hit = np.isfinite(t)
        image = np.full((HEIGHT * WIDTH, 3), 90, np.uint8)
        image[hit] = texture(rays[hit, :3] + t[hit, None] * rays[hit, 3:])
        masks.append(hit.reshape(HEIGHT, WIDTH))
        images.append(image.reshape(HEIGHT, WIDTH, 3))
    return PinholeViews.of(P, masks), np.array(images)


def cameras(count: int = 10) -> np.ndarray:
    """A ring at two heights, the upper ones looking well down."""
    lower = ring(count, radius=2.0, target=(0, 0, 0.3), focal=330, width=WIDTH, height=HEIGHT)
    upper = ring(count, radius=1.4, target=(0, 0, 1.6), focal=330, width=WIDTH, height=HEIGHT)
    centers = -np.linalg.solve(upper[:, :, :3], upper[:, :, 3:])[:, :, 0]
    return np.concatenate([lower, [look_at(c, [0, 0, 0.3], 330, WIDTH, HEIGHT) for c in centers]])


GRID = Grid.of_box([-0.45, -0.45, -0.15], [0.45, 0.45, 0.65], resolution=90)


@pytest.fixture(scope="module")
def bowl():
    """A textured box with a deep square hollow in its top, open only upwards: no silhouette shows the hollow."""
    walls = [
        box_mesh([-0.35, -0.35, 0], [0.35, 0.35, 0.3]),
        box_mesh([-0.35, -0.35, 0.3], [-0.25, 0.35, 0.5]),
        box_mesh([0.25, -0.35, 0.3], [0.35, 0.35, 0.5]),
        box_mesh([-0.25, -0.35, 0.3], [0.25, -0.25, 0.5]),
        box_mesh([-0.25, 0.25, 0.3], [0.25, 0.35, 0.5]),
    ]
    return photograph(scene_of(*walls), cameras())


@pytest.fixture(scope="module")
def solid():
    """The same box without the hollow."""
    return photograph(scene_of(box_mesh([-0.35, -0.35, 0], [0.35, 0.35, 0.5])), cameras())


def in_hollow(indices: np.ndarray) -> np.ndarray:
    x, y, z = GRID.centers(indices).T
    return (np.abs(x) < 0.24) & (np.abs(y) < 0.24) & (z > 0.31) & (z < 0.5)


def test_a_hollow_is_carved_and_the_rest_stays(bowl):
    views, images = bowl
    start = hull(views, GRID)
    settings = ConsistencySettings(max_passes=12, threshold=20)
    carved = carve_inconsistent(views, images, GRID, start, settings)
    assert (carved.bits & ~start.bits).sum() == 0
    before, after = start.indices(), carved.indices()
    assert in_hollow(before).sum() > 20000
    top = in_hollow(before) & (GRID.centers(before)[:, 2] > 0.42)
    top_after = in_hollow(after) & (GRID.centers(after)[:, 2] > 0.42)
    assert top_after.sum() < 0.35 * top.sum()
    outside_before, outside_after = (~in_hollow(before)).sum(), (~in_hollow(after)).sum()
    assert outside_after > 0.97 * outside_before


def test_a_convex_textured_body_stays(solid):
    views, images = solid
    start = hull(views, GRID)
    carved = carve_inconsistent(views, images, GRID, start, ConsistencySettings(max_passes=12, threshold=20))
    assert carved.count() > 0.985 * start.count()


def test_brightness_of_the_cameras_makes_no_difference(solid):
    views, images = solid
    factor = np.random.default_rng(0).uniform(0.75, 1.0, size=(len(views), 1, 1, 3))
    dimmed = (images * factor).astype(np.uint8)
    surface = SurfaceVoxels.of(hull(views, GRID))
    seen = observations(views, dimmed, GRID, surface, depth_buffers(views, GRID, surface))
    gains = camera_gains(seen)
    product = gains * factor[:, 0, 0]
    np.testing.assert_allclose(product / np.median(product, axis=0), 1, atol=0.1)
    even, uneven = color_deviation(seen, gains, 3), color_deviation(seen, np.ones_like(gains), 3)
    assert np.median(even[even >= 0]) < 0.5 * np.median(uneven[uneven >= 0])


def test_visibility_is_that_of_ray_casting():
    ball = o3d.geometry.TriangleMesh.create_sphere(0.2, 60).translate([0.0, 0.0, 0.3])
    plate = o3d.geometry.TriangleMesh.create_box(0.04, 0.6, 0.5).translate([0.26, -0.3, 0.0])
    scene = scene_of(*(o3d.t.geometry.TriangleMesh.from_legacy(m) for m in (ball, plate)))
    x, y, z = GRID.axes()
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    solid = (np.linalg.norm(points - [0, 0, 0.3], axis=-1) < 0.2) | (
        (np.abs(points - [0.28, 0, 0.25]) < [0.02, 0.3, 0.25]).all(axis=-1)
    )
    occupancy = Occupancy.of_dense(solid)
    surface = occupancy.surface_indices()
    P = cameras(4)
    views, images = photograph(scene, P)
    voxels = SurfaceVoxels.of(occupancy)
    seen = observations(views, images, GRID, voxels, depth_buffers(views, GRID, voxels)).seen
    n = normals(occupancy, surface)
    agree = total = 0
    for c, camera in enumerate(P):
        centers = GRID.centers(surface)
        projected = centers @ camera[:, :3].T + camera[:, 3]
        rays = rays_through(camera, projected[:, :2] / projected[:, 2:])
        ahead = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() * np.linalg.norm(rays[:, 3:], axis=1)
        distance = np.linalg.norm(centers - rays[:, :3], axis=1)
        truly = ahead > distance - 2 * GRID.voxel_size
        # where the surface turns away from the camera a voxel's edge decides: leave those out
        cosine = ((rays[:, :3] - centers) / distance[:, None] * n).sum(axis=1)
        clear = (np.abs(cosine) > 0.25) & (np.abs(ahead - distance + 2 * GRID.voxel_size) > GRID.voxel_size)
        agree += (truly == (seen[:, c] != 0))[clear].sum()
        total += clear.sum()
    assert total > 10000 and agree > 0.97 * total


def test_depth_buffers_are_those_of_drawing_cube_after_cube():
    grid = Grid(np.array([-0.5, -0.5, -0.2]), 0.05, (20, 20, 20))
    x, y, z = grid.axes()
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    voxels = SurfaceVoxels.of(Occupancy.of_dense(np.linalg.norm(points - [0, 0, 0.3], axis=-1) < 0.4))
    P = cameras(3)[[0, 1, 5]]
    P[2, 0] += 100 * P[2, 2]  # one that sees a part of it
    views = PinholeViews.of(P, [np.ones((HEIGHT, WIDTH), np.uint8)] * 3)
    expected = np.full((3, HEIGHT, WIDTH), np.inf, np.float32)
    half = 0.5 * grid.voxel_size
    for c in range(3):
        eye = -np.linalg.solve(P[c, :, :3], P[c, :, 3])
        for index, free in zip(voxels.indices, voxels.faces, strict=True):
            center = grid.origin + (index + 0.5) * grid.voxel_size
            turned = np.column_stack([eye - center < -half, eye - center > half]).ravel()
            if not (turned & [free >> f & 1 for f in range(6)]).any():
                continue
            uw, vw, w = P[c, :, :3] @ center + P[c, :, 3]
            (u, du), (v, dv) = (
                (t / w, np.abs(P[c, a, :3] - t / w * P[c, 2, :3]).sum() * half / w) for a, t in enumerate((uw, vw))
            )
            columns, rows = np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5
            across = (np.abs(columns - u) <= du) | (np.floor(u) == columns - 0.5)
            along = (np.abs(rows - v) <= dv) | (np.floor(v) == rows - 0.5)
            part = np.ix_(along, across)
            expected[c][part] = np.minimum(expected[c][part], np.float32(w))
    depth = depth_buffers(views, grid, voxels)
    assert (
        np.isfinite(expected).any(axis=(1, 2)).all() and np.isfinite(expected[2]).sum() < np.isfinite(expected[1]).sum()
    )
    np.testing.assert_array_equal(np.isfinite(depth), np.isfinite(expected))
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


def test_normals_of_a_ball_point_outwards():
    x, y, z = np.mgrid[0:50, 0:47, 0:70]
    middle = np.array([24, 23, 33])
    occupancy = Occupancy.of_dense((x - 24) ** 2 + (y - 23) ** 2 + (z - 33) ** 2 < 20**2)
    surface = occupancy.surface_indices()
    outwards = (surface - middle) / np.linalg.norm(surface - middle, axis=1, keepdims=True)
    cosine = (normals(occupancy, surface) * outwards).sum(axis=1)
    assert cosine.min() > 0.9 and cosine.mean() > 0.98


def test_normals_are_the_sum_over_the_neighbourhood():
    dense = np.random.default_rng(2).random((9, 8, 70)) < 0.6
    occupancy = Occupancy.of_dense(dense)
    surface = occupancy.surface_indices()
    expected = np.zeros((len(surface), 3))
    padded = np.pad(dense, 2)
    for n, (i, j, k) in enumerate(surface):
        expected[n] = -(np.argwhere(padded[i : i + 5, j : j + 5, k : k + 5]) - 2).sum(axis=0)
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-6)
    np.testing.assert_allclose(normals(occupancy, surface), expected, atol=1e-6)


def test_normals_are_known_from_the_surface_alone():
    x, y, z = np.mgrid[0:40, 0:40, 0:70]
    wings = (np.abs(z - 30 - np.abs(x - 20) // 2) < 2) & (y > 3) & (y < 37)  # three voxels thick
    body = (x - 20) ** 2 + (y - 20) ** 2 + (z - 28) ** 2 < 9**2
    occupancy = Occupancy.of_dense(wings | body)
    surface = occupancy.surface_indices()
    shifted = surface + np.array([5, -3, 7], np.int32)  # whatever the grid's corner
    np.testing.assert_allclose(enclosing_normals(shifted), normals(occupancy, surface), atol=1e-6)


def test_normals_are_open_where_nothing_is_enclosed():
    i, j = np.mgrid[0:9, 0:9]
    sheet = np.column_stack([i.ravel(), j.ravel(), np.full(81, 4)])
    inner = ((sheet[:, :2] > 1) & (sheet[:, :2] < 7)).all(axis=1)
    assert not enclosing_normals(sheet)[inner].any()
    assert enclosing_normals(sheet[:0]).shape == (0, 3)


def test_deviation_is_the_spread_about_the_median():
    rng = np.random.default_rng(3)
    N, C = 200, 6
    seen = (rng.random((N, C)) < 0.7).astype(np.uint8)
    colors = rng.integers(0, 255, (N, C, 3)).astype(np.float32)
    low, high = np.clip(colors - 5, 0, 255).astype(np.uint8), np.clip(colors + 8, 0, 255).astype(np.uint8)
    gains = rng.uniform(0.8, 1.2, (C, 3)).astype(np.float32)
    expected = np.full(N, -1.0)
    for n in range(N):
        c = np.flatnonzero(seen[n])
        if len(c) >= 3:
            middle = np.median(colors[n, c] * gains[c], axis=0)
            off = np.maximum(np.maximum(low[n, c] * gains[c] - middle, middle - high[n, c] * gains[c]), 0)
            expected[n] = np.sqrt((off**2).mean())
    got = color_deviation(VoxelVisibility(seen, colors, low, high), gains, 3)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-3)


def test_colors_are_those_of_the_surface(solid):
    views, images = solid
    occupancy = hull(views, GRID)
    surface = occupancy.surface_indices()
    colors = voxel_colors(views, images, GRID, occupancy)
    assert colors.shape == surface.shape and colors.dtype == np.uint8
    points = GRID.centers(surface)
    near = (points[:, 2] > 0.05) & (points[:, 2] < 0.45)
    error = np.abs(colors[near].astype(int) - texture(points[near]))
    assert np.median(error) < 16
    shuffled = np.abs(colors[near].astype(int) - texture(points[near])[::-1])
    assert np.median(error) < 0.4 * np.median(shuffled)


def test_what_a_frame_does_with_its_images(solid):
    views, images = solid
    plain = carve_frame(
        views, GRID, CarvingSettings(colors="none", consistency=ConsistencySettings(enabled=False)), images
    )
    assert (plain.colors == GREY).all()
    colored = carve_frame(views, GRID, CarvingSettings(consistency=ConsistencySettings(enabled=False)), images)
    np.testing.assert_array_equal(colored.indices, plain.indices)
    assert colored.colors.std() > 20
    again = carve_frame(views, GRID, CarvingSettings(), images)
    np.testing.assert_array_equal(again.colors, carve_frame(views, GRID, CarvingSettings(), images).colors)
    assert needs_images(CarvingSettings())
    assert not needs_images(CarvingSettings(colors="none", consistency=ConsistencySettings(enabled=False)))


def test_what_nobody_sees_takes_its_neighbour_s_colour():
    # cameras on one side only: the back is not seen
    P = ring(4, radius=2.0, target=(0, 0, 0.3), arc_deg=60, focal=330, width=WIDTH, height=HEIGHT)
    views, images = photograph(scene_of(box_mesh([-0.35, -0.35, 0], [0.35, 0.35, 0.5])), P)
    grid = Grid.of_box([-0.6, -0.6, -0.1], [0.6, 0.6, 0.6], resolution=60)
    occupancy = hull(views, grid)
    voxels = SurfaceVoxels.of(occupancy)
    seen = observations(views, images, grid, voxels, depth_buffers(views, grid, voxels)).seen.any(axis=1)
    colors = voxel_colors(views, images, grid, occupancy)
    assert 0.2 < seen.mean() < 0.9
    known = {tuple(c) for c in colors[seen]}
    assert all(tuple(c) in known for c in colors[~seen])


def test_free_faces():
    dense = np.zeros((4, 3, 40), bool)
    dense[1:3, 1, 31:33] = True
    dense[0, 0, 39] = True
    voxels = SurfaceVoxels.of(Occupancy.of_dense(dense))
    np.testing.assert_array_equal(voxels.indices, np.argwhere(dense))
    sides = [[i for i in range(6) if (f >> i) & 1] for f in voxels.faces]
    assert sides == [[0, 1, 2, 3, 4, 5], [0, 2, 3, 4], [0, 2, 3, 5], [1, 2, 3, 4], [1, 2, 3, 5]]
