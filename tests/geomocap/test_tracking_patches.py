from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from geomocap.carving.views import PinholeViews
from geomocap.errors import GeometryError
from geomocap.geometry import Voxels
from geomocap.tracking.frame_views import FrameViews
from geomocap.tracking.patch_kernel import align_patches
from geomocap.tracking.patch_motion import lift_flow
from geomocap.tracking.patch_search import renewed
from geomocap.tracking.patch_templates import inverse_diagonal
from geomocap.tracking.patch_tracking import track_surface
from geomocap.tracking.patches import Patches, align, doubted, with_templates
from geomocap.tracking.seeding import (
    image_reduction,
    patch_radius,
    patch_shape,
    seed_patches,
    seed_spacing,
    spread,
    surface_frames,
)
from geomocap.tracking.tracking_settings import TrackingSettings
from geomocap.tracking.trajectories import REASONS
from tests.geomocap.moving_ellipsoid import MovingEllipsoid

SETTINGS = TrackingSettings(n_patches=150, radius_px=4, seed_every=4)


@pytest.fixture(scope="module")
def scene():
    return MovingEllipsoid()


@pytest.fixture(scope="module")
def views(scene):
    return [scene.view(k) for k in range(6)]


@pytest.fixture(scope="module")
def seeds(views):
    spacing = seed_spacing(views[0], SETTINGS.n_patches)
    return seed_patches(views[0], np.zeros((0, 3)), spacing, SETTINGS, np.random.default_rng(0))


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


def test_points_outside_a_silhouette_are_not_the_subject(views):
    points = np.array([[0.0, 0, 0], [0.19, 0, 0], [0.3, 0, 0], [0, 0, -50.0]])
    assert views[0].may_be_subject(points).tolist() == [True, True, False, True]  # the last one nobody sees


def test_frame_views_refuse_images_of_another_size(scene):
    images, masks = scene.images(0)
    views = PinholeViews.of(scene.projections(), masks)
    with pytest.raises(GeometryError, match="silhouettes"):
        FrameViews.of(views, images[:, :-1], scene.voxels(0))
    nothing = Voxels(np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), np.zeros(3), 0.01)
    with pytest.raises(GeometryError, match="without surface"):
        FrameViews.of(views, images, nothing)


def test_reduced_frames_show_the_same_scene_in_larger_pixels(scene):
    fine = MovingEllipsoid(width=321, height=243, focal=520.0)
    images, masks = fine.images(0)
    views = PinholeViews.of(fine.projections(), masks)
    full = FrameViews.of(views, images, fine.voxels(0))
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


def test_images_are_reduced_until_patches_cover_the_surface_twice(views):
    few = TrackingSettings(n_patches=100, radius_px=2)
    spacing, pixel = seed_spacing(views[0], 100), np.median(views[0].pixel_size(views[0].surface))
    assert image_reduction(views[0], few) == round(spacing / (2 * pixel)) == 6
    assert image_reduction(views[0], few.model_copy(update={"n_patches": 20_000})) == 1


def test_patches_are_as_wide_as_their_distance_within_bounds(views):
    pixel = np.median(views[0].pixel_size(views[0].surface))
    settings = TrackingSettings(radius_px=6)
    widths = [patch_radius(views[0], px * pixel, settings) for px in (1.0, 4.2, 20.0)]
    assert widths == [3, 4, 6]
    assert patch_radius(views[0], pixel, TrackingSettings(radius_px=2)) == 2


def test_pixel_size_is_depth_by_focal_length(views):
    assert_allclose(views[0].pixel_size(np.zeros((1, 3))), np.sqrt(1 + 0.09) / 260, rtol=1e-9)


def test_spread_keeps_distance_and_covers():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (2000, 3)) * [1, 1, 0]
    taken = np.array([[0.5, 0.5, 0]])
    chosen = points[spread(points, 0.1, taken, np.random.default_rng(0))]
    gaps = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + 9 * np.eye(len(chosen))
    assert gaps.min() > 0.1
    assert np.linalg.norm(chosen - taken, axis=1).min() > 0.09
    everything = np.concatenate([chosen, taken])
    assert np.linalg.norm(points[:, None] - everything[None], axis=2).min(axis=1).max() <= 0.1


def test_surface_frames_follow_a_curved_surface(scene, views):
    view = views[0]
    chosen = view.surface[::97]
    positions, frames, curvature = surface_frames(view, chosen)
    body = positions / np.array([0.2, 0.16, 0.25]) ** 2
    normals = body / np.linalg.norm(body, axis=1, keepdims=True)
    seen = normals[:, 2] > -0.8  # nobody looks from below
    angle = np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", normals, frames[:, :, 2]), -1, 1)))[seen]
    assert np.median(angle) < 4 and np.percentile(angle, 95) < 12
    assert_allclose(np.linalg.det(frames), 1)
    assert (curvature[:, 0] + curvature[:, 2])[seen].mean() < -2  # convex: about −1/r


def test_shape_and_slopes_belong_together():
    shape = patch_shape(np.array([[-3.0, 1.0, -2.0]]), np.array([0.002]), 3)[0]
    grid = shape.reshape(7, 7, 5)
    assert_allclose(np.gradient(grid[:, :, 2], 0.002, axis=1)[:, 1:-1], grid[:, 1:-1, 3], atol=1e-12)
    assert_allclose(np.gradient(grid[:, :, 2], 0.002, axis=0)[1:-1], grid[1:-1, :, 4], atol=1e-12)


def test_seeds_lie_on_the_surface_with_two_cameras_each(scene, seeds):
    assert len(seeds) > 90
    assert (seeds.has.sum(axis=1) >= 2).all()
    away = scene.surface_distance(seeds.positions, 0)
    # a pixel is 4 mm; voxels alone are 5 mm off
    assert np.median(away) < 0.0006 and np.percentile(away, 90) < 0.002


def test_templates_have_the_slopes_of_the_surface(scene, views, seeds):
    """The stored slopes are what grey levels change by along the patch."""
    n, c = 0, int(np.flatnonzero(seeds.has[0])[0])
    template = seeds.templates[n, c, 0].reshape(9, 9, 3)
    step = seeds.size[n]
    along = (template[1:-1, 2:, 0] - template[1:-1, :-2, 0]) / (2 * step)
    assert np.corrcoef(along.ravel(), template[1:-1, 1:-1, 1].ravel())[0, 1] > 0.98


def moved(scene, seeds, frame):
    turn, place = scene.pose(frame)
    return seeds.positions @ turn.T + place, turn @ seeds.frames


def test_alignment_finds_the_true_motion_from_a_wrong_start(scene, views, seeds):
    X, Q = moved(scene, seeds, 1)
    rng = np.random.default_rng(0)
    start = X + rng.normal(0, 0.004, X.shape)
    wrong = Rotation.from_rotvec(rng.normal(0, 0.03, X.shape)).as_matrix() @ Q
    every = np.arange(len(seeds))
    found = align(seeds, every, start, wrong, seeds.has, views[1], iterations=(8, 12), least_correlation=0.6)
    good = (found.n_views >= 2) & (found.correlation > 0.9)
    assert good.mean() > 0.8
    away = np.linalg.norm(found.positions - X, axis=1)[good]
    assert np.median(away) < 0.0006 and np.percentile(away, 95) < 0.003
    turned = np.degrees(Rotation.from_matrix(found.frames[good] @ np.swapaxes(Q[good], 1, 2)).magnitude())
    assert np.median(turned) < 1.5
    # the stated precision is that of the measurement: not out by more than a factor of three
    assert 0.3 < np.median(away) / np.median(found.sigma[good] * 1.54) < 3


def test_alignment_keeps_to_its_expectation_where_nothing_is_seen(scene, views, seeds):
    none = np.zeros_like(seeds.has)
    every = np.arange(len(seeds))
    found = align(seeds, every, seeds.positions, seeds.frames, none, views[0], iterations=(3, 3), least_correlation=0.6)
    assert_allclose(found.positions, seeds.positions)
    assert (found.correlation == -1).all() and np.isinf(found.sigma).all() and (found.n_views == 0).all()


def reference_step(patches, n, X, Q, view, level, size):
    """One Gauss–Newton step by numerical differentiation of the images themselves, offset and gain as unknowns."""

    def sample(x, q, c):
        p = patches.shape[n, patches.usable[n, c] > 0, :3] @ q.T + x
        h = np.c_[p, np.ones(len(p))] @ view.projections[c].T
        u, v = h[:, 0] / h[:, 2], h[:, 1] / h[:, 2]
        i, j = u.astype(int), v.astype(int)
        a, b = u - i, v - j
        image = view.levels[level, c].astype(float)
        return (image[j, i] * (1 - a) + image[j, i + 1] * a) * (1 - b) + (
            image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a
        ) * b

    N, b = np.zeros((6, 6)), np.zeros(6)
    for c in np.flatnonzero(patches.has[n]):
        T = patches.templates[n, c, level, patches.usable[n, c] > 0, 0].astype(float)
        grey = sample(X, Q, c)
        J = np.empty((len(T), 6))
        for r in range(6):
            e = np.zeros(3)
            e[r % 3] = 0.25 * size if r < 3 else 0.02
            if r < 3:
                high, low = sample(X + Q @ e, Q, c), sample(X - Q @ e, Q, c)
            else:
                turn = Rotation.from_rotvec(e).as_matrix()
                high, low = sample(X, Q @ turn, c), sample(X, Q @ turn.T, c)
            J[:, r] = (high - low) / (2 * e[r % 3])
        gain = np.cov(T, grey)[0, 1] / np.var(grey, ddof=1)
        A = np.c_[gain * J, np.ones(len(T)), T - T.mean()]
        residual = T - gain * grey
        misfit = np.var((T - T.mean()) - gain * (grey - grey.mean())) * len(T) / (len(T) - 8)
        s2 = misfit * 0.15 * len(T) + 4
        full, right = A.T @ A / s2, A.T @ residual / s2
        schur = full[:6, 6:] @ np.linalg.inv(full[6:, 6:])
        N += full[:6, :6] - schur @ full[6:, :6]
        b += right[:6] - schur @ right[6:]
    return np.linalg.solve(N, b), N


def test_a_step_is_that_of_plain_gauss_newton(scene, views, seeds):
    """The kernel's slopes come from the templates, the reference's from the shifted images: nearly the same step."""
    X, Q = moved(scene, seeds, 1)
    offset = np.array([0.0008, -0.0006, 0.0005])
    ratios = []
    for n in range(0, len(seeds), 6):
        step, N = reference_step(seeds, n, X[n] + offset, Q[n], views[1], 1, seeds.size[n])
        found = align(
            seeds,
            np.array([n]),
            X + offset,
            Q,
            seeds.has,
            views[1],
            iterations=(-1, 1),
            least_correlation=-1.0,
            prior_shift_px=1e4,
            prior_turn=1e3,
        )
        shift = Q[n].T @ (found.positions[n] - X[n] - offset)
        turn = Rotation.from_matrix(Q[n].T @ found.frames[n]).as_rotvec()
        difference = np.concatenate([shift, turn]) - step
        # in the metric of the observations, so that what they hardly determine counts little
        ratios.append(np.sqrt((difference @ N @ difference) / (step @ N @ step)))
    assert np.median(ratios) < 0.15


def test_kernel_is_the_same_for_any_number_of_threads(views, seeds, scene):
    import numba

    X, Q = moved(scene, seeds, 1)
    every = np.arange(len(seeds))
    results = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(threads)
        found = align(seeds, every, X, Q, seeds.has, views[1], iterations=(4, 4), least_correlation=0.6)
        results.append(found)
    assert np.array_equal(results[0].positions, results[1].positions)
    assert np.array_equal(results[0].sigma, results[1].sigma)


def test_tracks_follow_the_true_surface(scene, views):
    tracks = track_surface(lambda k: views[k], 6, SETTINGS)
    assert tracks.measured.sum(axis=0).min() > 80
    start = tracks.start
    error = []
    for n in range(len(tracks)):
        turn, place = scene.pose(int(start[n]))
        body = (tracks.positions[n, start[n]] - place) @ turn
        truth = np.array([scene.pose(k)[0] @ body + scene.pose(k)[1] for k in range(6)])
        error.append(np.linalg.norm(tracks.positions[n] - truth, axis=1))
    error = np.array(error)
    late = error[(np.arange(6) > start[:, None]) & tracks.measured]
    assert np.median(late) < 0.0012 and np.percentile(late, 95) < 0.005
    rows = np.flatnonzero(tracks.measured[:, 0] & tracks.measured[:, 5] & (tracks.placed == 0))
    relative = scene.pose(5)[0]
    turned = Rotation.from_matrix(tracks.rotations[rows, 5] @ relative.T).magnitude()
    assert np.degrees(np.median(turned)) < 5  # a patch is nine pixels wide
    assert (tracks.n_views[tracks.measured] >= 2).all()
    assert set(tracks.reasons()) <= set(REASONS)


@pytest.mark.parametrize(("templates", "share"), [("first", 0.0), ("updated", 0.5), ("previous", 1.0)])
def test_templates_are_taken_again_as_asked(scene, views, seeds, templates, share):
    X, Q = moved(scene, seeds, 1)
    every = np.arange(len(seeds))
    found = align(seeds, every, X, Q, seeds.has, views[1], iterations=(4, 8), least_correlation=0.6)
    fit = np.where(every[:, None] % 2, 0.8, 0.99)
    found = replace(found, by_camera=np.where(found.by_camera > -1, fit, -1.0))
    copy = replace(seeds, templates=seeds.templates.copy(), usable=seeds.usable.copy())
    good = every % 5 > 0
    again = renewed(copy.moved(X, Q), found, good, views[1], templates)
    changed = (again.templates != seeds.templates).any(axis=(2, 3, 4)) & seeds.has
    taken = changed.any(axis=1)
    assert not taken[~good].any()
    if templates == "updated":
        assert not taken[every % 2 == 0].any()
    assert abs(taken[good].mean() - share) < 0.1


def test_a_patch_is_known_no_better_than_when_its_templates_were_taken(scene, views, seeds):
    X, Q = moved(scene, seeds, 1)
    every = np.arange(len(seeds))
    found = align(seeds, every, X, Q, seeds.has, views[1], iterations=(4, 4), least_correlation=0.6)
    good = np.isfinite(found.sigma) & seeds.has.any(axis=1)
    assert np.array_equal(doubted(seeds, found).sigma, found.sigma)  # new patches are where they are
    copy = seeds.select(every).join(Patches.empty(81, 6, 2))
    later = renewed(copy.moved(found.positions, found.frames), found, good, views[1], "previous")
    again = align(later, every, X, Q, later.has, views[1], iterations=(4, 4), least_correlation=0.6)
    both = doubted(later, again)
    fresh = good & ((later.doubt > 0) == (again.by_camera > -1)).all(axis=1)
    assert fresh.sum() > 50
    assert_allclose(both.sigma[fresh], np.hypot(again.sigma, found.sigma)[fresh])


def test_surface_without_patches_gets_some_in_the_last_frame_too(views):
    first = views[0].surface[:, 0] < np.median(views[0].surface[:, 0])  # the rest of the surface is not there yet
    half = replace(views[0], surface=views[0].surface[first])
    tracks = track_surface(lambda k: views[k] if k else half, 3, SETTINGS)
    late = tracks.placed == 2
    assert late.sum() > 20
    assert tracks.measured[late, 1].mean() > 0.5


def test_tracking_repeats_bit_for_bit(views):
    few = SETTINGS.model_copy(update={"n_patches": 40})
    first, second = (track_surface(lambda k: views[k], 3, few) for _ in range(2))
    assert np.array_equal(first.positions, second.positions, equal_nan=True)


def test_patches_can_be_selected_and_joined(seeds):
    both = seeds.select(np.arange(3)).join(seeds.select(np.arange(3, 5)))
    assert_allclose(both.positions, seeds.positions[:5])
    empty = Patches.empty(81, 6, 2)
    assert len(empty) == 0 and len(empty.join(seeds)) == len(seeds)
    assert with_templates(empty, np.zeros((0, 6), bool), MovingEllipsoid().view(0)).has.shape == (0, 6)


def test_kernel_is_compiled_once_for_all(seeds):
    assert len(align_patches.signatures) == 1


def test_variances_are_the_diagonal_of_the_inverse():
    design = np.random.default_rng(5).normal(size=(20, 6))
    normal = design.T @ design
    variances = np.empty(6)
    inverse_diagonal(np.linalg.cholesky(normal), variances)
    assert_allclose(variances, np.diag(np.linalg.inv(normal)), rtol=1e-12)


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
