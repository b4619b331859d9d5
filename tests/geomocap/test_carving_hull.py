"""Visual hull: identical to testing every voxel, and right for known shapes."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_erosion

from geomocap.carving.block_kernels import summed
from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.hull import hull
from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import GeometryError
from tests.geomocap.carving_scenes import FIGURE, look_at, ring, silhouettes
from tests.geomocap.hull_reference import visual_hull_brute, visual_hull_numpy


def blobs(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Random mask: all, nothing, noise, or rectangles."""
    kind = rng.integers(5)
    if kind == 0:
        return np.full((height, width), 255, np.uint8)
    if kind == 1:
        return np.zeros((height, width), np.uint8)
    if kind == 2:
        return (rng.random((height, width)) < rng.random()).astype(np.uint8)
    mask = np.zeros((height, width), np.uint8)
    for _ in range(6):
        v, u = rng.integers(height), rng.integers(width)
        mask[v : v + rng.integers(1, height), u : u + rng.integers(1, width)] = 1
    return mask


def random_views(rng: np.random.Generator) -> PinholeViews:
    """Cameras anywhere: round the volume, inside it, looking away; masks of different sizes with unseen regions."""
    P, masks, valid = [], [], []
    for _ in range(rng.integers(1, 7)):
        height, width = rng.integers(5, 60, size=2)
        center = rng.normal(size=3) * rng.choice([0.2, 1.0, 4.0])
        target = rng.normal(size=3) * rng.choice([0.2, 3.0])
        P.append(look_at(center, target, rng.uniform(10, 80), int(width), int(height)) * rng.choice([1.0, 0.01, 50.0]))
        masks.append(blobs(rng, height, width))
        seen = np.ones((height, width), np.uint8)
        if rng.random() < 0.5:
            seen[:, : rng.integers(width)] = 0
        valid.append(seen)
    return PinholeViews.of(np.array(P), masks, valid)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    outside=st.sampled_from(["auto", "empty", "unseen"]),
    min_views=st.integers(1, 4),
    tolerance=st.integers(0, 2),
)
@example(seed=3, outside="auto", min_views=2, tolerance=0)  # specks in a camera that has no say
def test_octree_is_brute_force_bit_for_bit(seed, outside, min_views, tolerance):
    rng = np.random.default_rng(seed)
    views = random_views(rng)
    shape = tuple(int(n) for n in rng.integers(1, 71, size=3))
    grid = Grid(rng.normal(size=3) - 1, 2.0 / max(shape) * rng.uniform(0.3, 2), shape)
    options = HullSettings(outside=outside, min_views=min_views, tolerance=tolerance)
    expected = visual_hull_numpy(views, grid, options)
    np.testing.assert_array_equal(hull(views, grid, options).dense(), expected)
    if outside == "empty" and tolerance == 0:
        np.testing.assert_array_equal(visual_hull_brute(views, grid), expected)


@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_far_from_the_origin_it_is_still_exact(offset):
    move = np.array([offset, -offset, offset / 2])
    P = ring(5, width=64, height=48, focal=60)
    views = PinholeViews.of(
        np.array([np.column_stack([p[:, :3], p[:, 3] - p[:, :3] @ move]) for p in P]), silhouettes(P, FIGURE, 64, 48)
    )
    grid = Grid(move - np.array([0.6, 0.6, 0.1]), 2 / 64, (40, 40, 64))
    expected = visual_hull_numpy(views, grid)
    assert expected.sum() > 500
    np.testing.assert_array_equal(hull(views, grid).dense(), expected)


def test_result_does_not_depend_on_the_number_of_threads_or_the_buffer():
    P = ring(6)
    views = PinholeViews.of(P, silhouettes(P, FIGURE))
    grid = Grid(np.array([-0.6, -0.6, -0.1]), 2 / 96, (60, 57, 96))
    out = np.full(grid.shape, 7, np.uint8)
    assert hull(views, grid).dense(out) is out
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = hull(views, grid).dense()
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(out, alone)


def test_hull_of_a_sphere_encloses_it_closely():
    radius, P = 0.4, ring(24, target=(0.1, 0.2, 0.5))
    views = PinholeViews.of(P, silhouettes(P, np.array([[0.1, 0.2, 0.5, radius, radius, radius]])))
    grid = Grid.of_box(np.array([-0.5, -0.4, -0.1]), np.array([0.7, 0.8, 1.1]), resolution=96)
    occupied = hull(views, grid).dense()
    # 24 cones round a sphere leave little more than it; at its outline the pixels' centres decide
    assert 0.98 < occupied.sum() * grid.voxel_size**3 / (4 / 3 * np.pi * radius**3) < 1.1
    x, y, z = grid.axes()
    depth = radius - np.sqrt((x[:, None, None] - 0.1) ** 2 + (y[:, None] - 0.2) ** 2 + (z - 0.5) ** 2)
    pixel = 3.4 / 300  # metres at the subject's distance
    assert occupied[depth > pixel].all()
    surface = np.linalg.norm(grid.centers(hull(views, grid).surface_indices()) - [0.1, 0.2, 0.5], axis=1)
    assert abs(np.median(surface) - radius) < grid.voxel_size


def test_surface_is_what_erosion_takes_away():
    rng = np.random.default_rng(4)
    for shape in [(40, 33, 70), (5, 1, 64), (1, 1, 1), (3, 4, 31)]:
        dense = (rng.random(shape) < 0.93).astype(np.uint8)
        occupancy = Occupancy.of_dense(dense)
        np.testing.assert_array_equal(occupancy.dense(), dense)
        np.testing.assert_array_equal(occupancy.indices(), np.argwhere(dense))
        assert occupancy.count() == dense.sum()
        surface = dense.astype(bool) & ~binary_erosion(dense)
        np.testing.assert_array_equal(occupancy.surface_indices(), np.argwhere(surface))
        np.testing.assert_array_equal(occupancy.surface().dense(), surface)


def test_integral_images():
    masks = (np.random.default_rng(0).random((3, 11, 17)) < 0.4).astype(np.uint8)
    table = summed(masks)
    assert not table[:, 0].any() and not table[:, :, 0].any()
    np.testing.assert_array_equal(table[:, 1:, 1:], masks.astype(int).cumsum(1).cumsum(2))


def test_outside_a_view_is_an_explicit_choice():
    # two cameras see the whole subject, the third only its left half
    P = ring(3)
    masks = silhouettes(P, FIGURE)
    seen = [np.ones_like(m) for m in masks]
    seen[2][:, :160] = 0
    views = PinholeViews.of(P, masks, seen)
    grid = Grid(np.array([-0.6, -0.6, -0.1]), 2 / 64, (40, 40, 64))
    empty = hull(views, grid, HullSettings(outside="empty")).dense()
    unseen = hull(views, grid, HullSettings(outside="unseen", min_views=2)).dense()
    whole = hull(PinholeViews.of(P, masks), grid).dense()
    pair = hull(views.without(2), grid).dense()
    assert empty.sum() < whole.sum() < unseen.sum() < pair.sum()
    assert (empty <= whole).all() and (whole <= unseen).all() and (unseen <= pair).all()


def test_tolerance_closes_a_hole_of_one_silhouette():
    P = ring(8)
    masks = silhouettes(P, FIGURE)
    whole = PinholeViews.of(P, masks)
    masks = [m.copy() for m in masks]
    masks[0][110:130, :] = 0
    holed = PinholeViews.of(P, masks)
    grid = Grid(np.array([-0.6, -0.6, -0.1]), 2 / 64, (40, 40, 64))
    expected = hull(whole, grid).dense()
    assert (hull(holed, grid).dense() < expected).sum() > 50
    assert (hull(holed, grid, HullSettings(tolerance=1)).dense() >= expected).all()


def test_grids_cover_their_box_with_cubes():
    grid = Grid.of_box(np.array([0.0, 0, 0]), np.array([1.0, 0.51, 2.0]), resolution=100)
    assert grid.voxel_size == 0.02 and grid.shape == (50, 26, 100)
    assert (grid.low <= [0, 0, 0]).all() and (grid.high >= [1, 0.51, 2]).all()
    np.testing.assert_allclose(grid.centers(np.array([49, 0, 0])), [0.99, 0.005, 0.01])
    np.testing.assert_allclose(grid.axes()[2][[0, -1]], [0.01, 1.99])
    with pytest.raises(GeometryError, match="is empty"):
        Grid.of_box(np.zeros(3), np.array([1.0, 0.0, 1.0]))
    with pytest.raises(GeometryError, match="voxel size"):
        Grid(np.zeros(3), 0.0, (1, 1, 1))
