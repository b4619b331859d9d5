"""Frames as the cameras see them, and the compiled projections against NumPy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from geomocap.carving.silhouette_views import PinholeViews
from geomocap.errors import GeometryError
from geomocap.model.frame_geometry import Voxels
from geomocap.patches.frame_views import FrameViews, image_noise
from geomocap.patches.patch_prediction import lift_flow
from geomocap.patches.surface_patches import facings, visible
from tests.geomocap.moving_ellipsoid import MovingEllipsoid


@pytest.fixture(scope="module")
def scene():
    return MovingEllipsoid()


@pytest.fixture(scope="module")
def views(scene):
    return [scene.view(k) for k in range(6)]


def test_frame_views_have_depth_in_front_of_the_surface_and_no_background(scene, views):
    view = views[0]
    assert view.levels.shape == (2, 6, 120, 160)
    assert_allclose(np.linalg.norm(view.projections[:, 2, :3], axis=1), 1)
    top = np.array([[0.2, 0, 0]])  # faces camera 0
    depth = view.project(top)[1]
    assert_allclose(view.depths(top)[1][0, 0], depth[0, 0], atol=0.015)
    assert np.isnan(view.depths(np.array([[0.0, 0, 3]]))[1]).all()
    # the dark background (40) doesn't bleed into the rim
    rim = (view.masks > 0) & ~np.stack([binary_erosion(m) for m in view.masks])
    inside = (view.masks > 0) & ~rim
    assert abs(view.levels[0][rim].mean() - view.levels[0][inside].mean()) < 8


@pytest.mark.parametrize("deviation", [0.7, 2.0, 6.0])
def test_the_noise_of_the_levels_is_told_from_their_texture(deviation):
    scene = MovingEllipsoid(texture=20.0)
    images, masks = scene.images(0)
    noisy = images + np.random.default_rng(1).normal(0, deviation, images.shape[:3])[..., None]
    noisy = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    clean, view = (
        FrameViews.of(PinholeViews.of(scene.projections(), masks), i, scene.voxels(0)) for i in (images, noisy)
    )
    inside = np.stack([binary_erosion(m, iterations=6) for m in masks])
    for c in range(view.count):
        added = (view.levels - clean.levels)[:, c, inside[c]].var(axis=1)
        # of a few thousand pixels, which rounding and the rest of the texture make rougher: 16 % at most
        assert_allclose(np.sqrt(view.noise[1, c]), np.sqrt(added[1]), rtol=0.2)
        assert view.noise[0, c] < 0.2 * view.noise[1, c]  # wider blur, less noise
    assert (view.noise > clean.noise).all()


def test_an_image_without_a_subject_has_no_noise():
    assert image_noise(np.full((9, 9), 7, np.uint8), np.zeros((9, 9), np.uint8)) == 0


def test_cameras_that_see_patches_are_those_of_the_depths_and_cosines(views):
    view, rng = views[0], np.random.default_rng(4)
    positions = rng.uniform(-0.4, 0.4, (500, 3))
    frames = Rotation.random(500, random_state=5).as_matrix()
    hidden = np.where(rng.random((500, view.count)) < 0.3, np.nan, rng.normal(0, 0.1, (500, view.count)))
    depth, surface = view.depths(positions)
    behind = depth - surface - np.nan_to_num(np.maximum(hidden, 0.0))
    slack = np.full((500, 1), 0.02)
    expected = (facings(positions, frames[:, :, 2], view) > 0.2) & (behind < slack)
    assert_array_equal(visible(positions, frames, hidden, view, slack, 0.2), expected)
    assert 0 < expected.sum() < expected.size


def test_points_outside_a_silhouette_are_not_the_subject(views):
    points = np.array([[0.0, 0, 0], [0.19, 0, 0], [0.3, 0, 0], [0, 0, -50.0]])
    assert views[0].may_be_subject(points).tolist() == [True, True, False, True]  # the last one nobody sees
    asked = np.zeros((len(points), views[0].count), bool)
    assert views[0].may_be_subject(points, asked).all()
    asked[1:3, 0] = True  # camera 0 looks along the axis on which these lie
    assert views[0].may_be_subject(points, asked).tolist() == [True] * 4
    asked[1:3] = True
    assert views[0].may_be_subject(points, asked).tolist() == [True, True, False, True]


def test_an_empty_silhouette_allows_all_points(scene):
    """A camera that doesn't see the subject, or lost a frame, says of no point that it isn't the subject's."""
    images, masks = scene.images(0)
    masks[0][:] = 0
    view = FrameViews.of(PinholeViews.of(scene.projections(), masks), images, scene.voxels(0))
    assert view.may_be_subject(np.array([[0.0, 0, 0], [0.3, 0, 0]])).tolist() == [True, False]


def test_frame_views_refuse_images_of_another_size(scene):
    images, masks = scene.images(0)
    views = PinholeViews.of(scene.projections(), masks)
    with pytest.raises(GeometryError, match="silhouettes"):
        FrameViews.of(views, images[:, :-1], scene.voxels(0))
    nothing = Voxels(np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), np.zeros(3), 0.01)
    with pytest.raises(GeometryError, match="without surface"):
        FrameViews.of(views, images, nothing)


def test_light_and_shade_do_not_count(scene):
    """Brightness that changes over more of the image than a patch leaves no more than a trace."""
    images, masks = scene.images(0)
    views = PinholeViews.of(scene.projections(), masks)
    across = np.linspace(-40, 40, images.shape[2])
    lit = np.clip(images.astype(float) + across[None, None, :, None], 0, 255).astype(np.uint8)
    plain, shaded = (FrameViews.of(views, i, scene.voxels(0)).levels[1] for i in (images, lit))
    clipped = (lit == 0).any(axis=3) | (lit == 255).any(axis=3)
    inside = np.stack([binary_erosion(m & ~c, iterations=8) for m, c in zip(masks != 0, clipped, strict=True)])
    assert inside.sum() > 1000
    change = (shaded - plain)[inside]
    assert np.abs(change).max() < 0.1 * np.ptp(np.broadcast_to(across, inside.shape)[inside])
    assert plain[inside].std() > 10 * change.std()


def test_reduced_frames_show_the_same_scene_in_larger_pixels(scene):
    fine = MovingEllipsoid(width=321, height=243, focal=520.0)
    images, masks = fine.images(0)
    views = PinholeViews.of(fine.projections(), masks)
    full = FrameViews.of(views, images, fine.voxels(0), (5.0, 1.6))  # the same blurs in metres
    half = FrameViews.of(views, images, fine.voxels(0), reduction=2)
    assert half.levels.shape == (2, 6, 121, 160)
    points = np.array([[0.1, 0.05, 0.1], [-0.1, 0, 0]])
    # COLMAP pixels halve; array indices are half a pixel less
    assert_allclose(half.project(points)[0] + 0.5, (full.project(points)[0] + 0.5) / 2)
    assert_allclose(half.project(points)[1], full.project(points)[1])
    mean = full.levels[1, 0, :242, :320].reshape(121, 2, 160, 2).mean(axis=(1, 3))
    inside = np.stack([binary_erosion(half.masks[0], iterations=4)])[0]
    assert np.corrcoef(mean[inside], half.levels[1, 0][inside])[0, 1] > 0.98
    assert abs(half.masks.sum() * 4 / full.masks.sum() - 1) < 0.01


def test_pixel_size_is_depth_by_focal_length(views):
    assert_allclose(views[0].pixel_size(np.zeros((1, 3))), np.sqrt(1 + 0.09) / 260, rtol=1e-9)


def test_projections_and_surface_depths_are_those_of_numpy(views):
    view = views[0]
    rng = np.random.default_rng(7)
    points = np.concatenate([view.surface[::5], rng.normal(scale=4.0, size=(200, 3))])  # behind and beside cameras too
    image = np.einsum("cij,nj->nci", view.projections[:, :, :3], points) + view.projections[:, :, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        true = np.where(image[:, :, 2:] > 0, image[:, :, :2] / image[:, :, 2:], np.nan)
    pixel, depth = view.project(points)
    assert_allclose(pixel, true, rtol=1e-9, atol=1e-9)
    assert_allclose(depth, image[:, :, 2], atol=1e-12)
    _, H, W = view.masks.shape
    surface = np.full(depth.shape, np.nan)
    allowed = np.ones(len(points), bool)
    for n, c in np.ndindex(depth.shape):
        if np.isfinite(true[n, c]).all():
            x, y = np.rint(true[n, c]).astype(int)
            if 0 <= x < W and 0 <= y < H:
                surface[n, c] = view.depth[c, y, x]
                allowed[n] &= view.allowed[c, y, x] != 0
    assert np.isfinite(surface).any() and not allowed.all() and np.isnan(true).any()
    assert_allclose(view.depths(points)[1], np.where(np.isfinite(surface), surface, np.nan))
    assert np.array_equal(view.may_be_subject(points), allowed)


def _lifted_by_numpy(view, positions, flow):
    P = view.projections
    pixel, depth = view.project(positions)
    slope = (P[None, :, :2, :3] - pixel[..., None] * P[None, :, 2:, :3]) / depth[:, :, None, None]
    known = np.isfinite(flow).all(axis=2)
    weight, flow, shifts = known.astype(float), np.where(known[..., None], flow, 0.0), []
    for n in range(len(positions)):
        rows, values = slope[n].reshape(-1, 3), flow[n].reshape(-1)
        for _ in range(4):
            weights = np.repeat(weight[n], 2)
            shift = np.linalg.solve(
                (rows * weights[:, None]).T @ rows + np.eye(3) / 0.3**2, (rows * weights[:, None]).T @ values
            )
            miss = np.linalg.norm((values - rows @ shift).reshape(-1, 2), axis=1)
            weight[n] = known[n] / (1 + (miss / 1.5) ** 2)
        shifts.append(shift)
    return np.array(shifts)


def test_lifted_flow_is_that_of_numpy(views):
    view = views[0]
    rng = np.random.default_rng(6)
    positions = view.surface[rng.choice(len(view.surface), 40, replace=False)]
    true = 0.02 * rng.normal(size=positions.shape)
    flow = view.project(positions + true)[0] - view.project(positions)[0]
    flow[rng.random(flow.shape[:2]) < 0.2] = np.nan
    flow[8, 0] += 20.0  # a camera that follows something else
    # the median over the patches that follow is that of each patch alone if all have the same place
    for n in range(0, 40, 8):
        found = lift_flow(view, np.repeat(positions[n : n + 1], 9, axis=0), np.repeat(flow[n : n + 1], 9, axis=0))
        assert_allclose(found[0], _lifted_by_numpy(view, positions[n : n + 1], flow[n : n + 1])[0], atol=1e-9)
