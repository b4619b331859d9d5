from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from geomocap.carving.silhouette_views import PinholeViews
from geomocap.model.small_systems import inverse_diagonal
from geomocap.model.trajectories import REASONS
from geomocap.patches.alignment_kernel import align_patches
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.patch_search import renewed
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.patch_tracking import track_surface
from geomocap.patches.seeding import (
    image_reduction,
    patch_radii,
    seed_patches,
    seed_spacing,
    spaced,
    surface_frames,
    template_room,
)
from geomocap.patches.surface_patches import Patches, align, as_one_camera, doubted, with_templates
from tests.geomocap.moving_ellipsoid import MovingEllipsoid
from tests.geomocap.patch_samples import samples_of

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


def test_images_are_reduced_until_patches_cover_the_surface_twice(views):
    few = TrackingSettings(n_patches=100, radius_px=2)
    spacing, pixel = seed_spacing(views[0], 100), np.median(views[0].pixel_size(views[0].surface))
    assert image_reduction(views[0], few) == round(spacing / (2 * pixel)) == 6
    assert image_reduction(views[0], few.model_copy(update={"n_patches": 20_000})) == 1


def test_patches_are_as_wide_as_their_distance_within_bounds(views):
    pixel = np.median(views[0].pixel_size(views[0].surface))
    settings = TrackingSettings(radius_px=6)
    widths = [patch_radii(views[0], px * pixel, settings) for px in (1.0, 2.2, 4.2, 20.0)]
    assert widths == [(3, 3), (4, 3), (6, 4), (6, 6)]
    assert patch_radii(views[0], pixel, TrackingSettings(radius_px=2)) == (2, 2)


def test_spaced_points_keep_distance_and_covers():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (2000, 3)) * [1, 1, 0]
    taken = np.array([[0.5, 0.5, 0]])
    chosen = points[spaced(points, 0.1, taken, np.random.default_rng(0))]
    gaps = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + 9 * np.eye(len(chosen))
    assert gaps.min() > 0.1
    assert np.linalg.norm(chosen - taken, axis=1).min() > 0.09
    everything = np.concatenate([chosen, taken])
    assert np.linalg.norm(points[:, None] - everything[None], axis=2).min(axis=1).max() <= 0.1


def test_points_are_kept_apart_as_one_after_the_other():
    points = np.round(np.random.default_rng(2).uniform(0, 1, (3000, 3)) * [1, 1, 0.1], 2)  # many exactly as far apart
    order, left, kept = np.random.default_rng(3).permutation(len(points)), np.ones(len(points), bool), []
    for n in order:
        if left[n]:
            kept.append(n)
            left &= ((points - points[n]) ** 2).sum(axis=1) > 0.05 * 0.05
    assert_array_equal(spaced(points, 0.05, points[:0], np.random.default_rng(3)), np.sort(kept))


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


def test_seeds_lie_on_the_surface_with_two_cameras_each(scene, seeds):
    assert len(seeds) > 90
    assert (seeds.has.sum(axis=1) >= 2).all()
    away = scene.surface_distance(seeds.positions, 0)
    # a pixel is 4 mm; voxels alone are 5 mm off
    assert np.median(away) < 0.0008 and np.percentile(away, 90) < 0.002


def test_templates_have_the_slopes_of_the_surface(scene, views, seeds):
    """The stored slopes are what grey levels change by along the patch."""
    n, c = 0, int(np.flatnonzero(seeds.has[0])[0])
    template = seeds.store.templates[seeds.slots[n, c], 0].reshape(9, 9, 3)
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


def test_noise_of_the_images_does_not_lower_a_correlation(scene, views, seeds):
    images, masks = scene.images(0)
    rng, every = np.random.default_rng(2), np.arange(len(seeds))
    noisy = [
        FrameViews.of(
            PinholeViews.of(scene.projections(), masks),
            np.clip(np.rint(0.1 * images + 100 + rng.normal(0, 3, (*images.shape[:3], 1))), 0, 255).astype(np.uint8),
            scene.voxels(0),
        )
        for _ in range(2)
    ]
    plain = with_templates(seeds.cleared(template_room(noisy[0], TrackingSettings(radius_px=4))), seeds.has, noisy[0])
    places = plain.positions, plain.frames, plain.has
    asked = {"iterations": (-1, 0), "least_correlation": 0.0}
    corrected = align(plain, every, *places, noisy[1], **asked).correlation
    without = replace(noisy[1], noise=np.zeros_like(noisy[1].noise))
    lowered = align(plain, every, *places, without, **asked).correlation
    # the same picture twice, each with noise of its own: without noise it would be 1
    assert np.median(lowered) < 0.8 < 0.93 < np.median(corrected)
    assert (corrected >= lowered).all()


def test_alignment_keeps_to_its_expectation_where_nothing_is_seen(scene, views, seeds):
    none = np.zeros_like(seeds.has)
    every = np.arange(len(seeds))
    found = align(seeds, every, seeds.positions, seeds.frames, none, views[0], iterations=(3, 3), least_correlation=0.6)
    assert_allclose(found.positions, seeds.positions)
    assert (found.correlation == -1).all() and np.isinf(found.sigma).all() and (found.n_views == 0).all()


def reference_step(patches, n, X, Q, view, level, size):
    """One Gauss–Newton step by numerical differentiation of the images themselves, offset and gain as unknowns."""
    grid, place = samples_of(patches.curvature[n], patches.size[n], patches.radius[n], 4)
    usable = patches.store.usable[:, place] > 0

    def sample(x, q, c):
        p = grid[usable[patches.slots[n, c]], :3] @ q.T + x
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
        slot = patches.slots[n, c]
        T = patches.store.templates[slot, level, place[usable[slot]], 0].astype(float)
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


def seen_by(patches):
    """Grey levels (N, C, M) on the blurred level; what isn't usable, or without a template, is 0."""
    usable = (patches.store.usable[patches.slots] > 0) & patches.has[:, :, None]
    return np.where(usable, patches.store.templates[patches.slots, 0, :, 0], 0.0)


@pytest.mark.parametrize(("templates", "fraction"), [("first", 0.0), ("updated", 0.5), ("previous", 1.0)])
def test_templates_are_taken_again_as_asked(scene, views, seeds, templates, fraction):
    X, Q = moved(scene, seeds, 1)
    every = np.arange(len(seeds))
    found = align(seeds, every, X, Q, seeds.has, views[1], iterations=(4, 8), least_correlation=0.6)
    fit = np.where(every[:, None] % 2, 0.8, 0.99)
    found = replace(found, by_camera=np.where(found.by_camera > -1, fit, -1.0))
    good = every % 5 > 0
    again = renewed(deepcopy(seeds).moved(X, Q), found, good, views[1], templates)
    assert_array_equal(again.has, seeds.has)
    before, after = (seen_by(p) for p in (seeds, again))
    changed = (before != after).any(axis=2) & seeds.has
    taken = changed.any(axis=1)
    assert not taken[~good].any()
    if templates == "updated":
        assert not taken[every % 2 == 0].any()
    assert abs(taken[good].mean() - fraction) < 0.1


def test_a_patch_is_known_no_better_than_when_its_templates_were_taken(scene, views, seeds):
    X, Q = moved(scene, seeds, 1)
    every = np.arange(len(seeds))
    found = align(seeds, every, X, Q, seeds.has, views[1], iterations=(4, 4), least_correlation=0.6)
    good = np.isfinite(found.sigma) & seeds.has.any(axis=1)
    assert np.array_equal(doubted(seeds, found).sigma, found.sigma)  # new patches are where they are
    copy = deepcopy(seeds)
    later = renewed(copy.moved(found.positions, found.frames), found, good, views[1], "previous")
    again = align(later, every, X, Q, later.has, views[1], iterations=(4, 4), least_correlation=0.6)
    both = doubted(later, again)
    fresh = good & ((later.doubt > 0) == (again.by_camera > -1)).all(axis=1)
    assert fresh.sum() > 50
    assert_allclose(both.sigma[fresh], np.hypot(again.sigma, found.sigma)[fresh])


def test_cameras_whose_templates_are_in_doubt_move_a_patch_less(scene, views, seeds):
    """One of two cameras has a template of a place beside: if that is doubted, the patch stays with the other."""
    X, Q = moved(scene, seeds, 1)
    rows = np.flatnonzero(seeds.has.sum(axis=1) == 2)
    beside = 0.002 * Q[:, :, 0]
    astray = seeds.has & (np.arange(seeds.has.shape[1]) == seeds.has.argmax(axis=1)[:, None])
    copy = deepcopy(seeds)
    away = {}
    for doubt in (0.0, 0.01):
        later = with_templates(
            replace(copy, slots=np.where(astray, -1, copy.slots)).moved(X + beside, Q),
            astray,
            views[1],
            np.full(len(X), doubt),
        )
        found = align(later, rows, X, Q, later.has, views[1], iterations=(4, 10), least_correlation=0.0)
        along = np.einsum("ni,ni->n", found.positions - X, Q[:, :, 0])[rows]
        away[doubt] = np.median(along)  # the astray template puts it at 2 mm
    assert away[0.0] > 0.0006
    assert away[0.01] < 0.5 * away[0.0]  # the other camera alone doesn't see along its own ray


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
    empty = Patches.empty((81, 6, 2))
    assert len(empty) == 0 and len(empty.join(seeds)) == len(seeds)
    assert with_templates(empty, np.zeros((0, 6), bool), MovingEllipsoid().view(0)).has.shape == (0, 6)


def test_patches_of_one_store_take_further_templates_without_harm_to_each_other(views, seeds):
    nobody = replace(seeds, slots=np.full_like(seeds.slots, -1))
    before = seen_by(seeds)
    first, second = (with_templates(nobody.select(some), seeds.has[some], views[0]) for some in (slice(5), slice(5, 9)))
    for patches, some in ((first, slice(5)), (second, slice(5, 9))):
        assert_array_equal(seen_by(patches), before[some])
    assert_array_equal(seen_by(seeds), before)


def test_one_cameras_templates_serve_all_without_a_copy(views, seeds):
    camera = seeds.has.argmax(axis=1)
    shared = as_one_camera(seeds, camera, np.ones_like(seeds.has))
    assert shared.store is seeds.store
    assert_array_equal(shared.slots, np.repeat(seeds.slots[np.arange(len(seeds)), camera][:, None], 6, axis=1))
    every, only = np.arange(len(seeds)), np.arange(seeds.has.shape[1]) == camera[:, None]
    places = seeds.positions + 0.002, seeds.frames
    one, own = (
        align(p, every, *places, only, views[0], iterations=(4, 8), least_correlation=0.5) for p in (shared, seeds)
    )
    assert_array_equal(one.positions, own.positions)


def test_kernel_is_compiled_once_for_all(seeds):
    assert len(align_patches.signatures) == 1


def test_variances_are_the_diagonal_of_the_inverse():
    design = np.random.default_rng(5).normal(size=(20, 6))
    normal = design.T @ design
    variances = np.empty(6)
    inverse_diagonal(np.linalg.cholesky(normal), variances)
    assert_allclose(variances, np.diag(np.linalg.inv(normal)), rtol=1e-12)


def test_bare_surface_is_looked_for_in_every_third_frame(views):
    settings = SETTINGS.model_copy(update={"seed_every": None, "backward": False})
    blind = views[0].surface.mean(axis=0)[0] > views[0].surface[:, 0]
    half = replace(views[0], surface=views[0].surface[blind])  # the rest shows later
    tracks = track_surface([half, *views[1:]].__getitem__, 6, settings)
    assert set(np.unique(tracks.placed)) == {0, 3, 5}
