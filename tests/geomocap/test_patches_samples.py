import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from geomocap.patches.patch_samples import choose_samples, compare, normal_matrix
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.patch_templates import LANES, fill_samples, local_camera
from geomocap.patches.seeding import seed_patches, seed_spacing
from geomocap.patches.template_store import TemplateStore
from tests.geomocap.moving_ellipsoid import MovingEllipsoid
from tests.geomocap.patch_samples import samples_of

SETTINGS = TrackingSettings(n_patches=150, radius_px=4)


@pytest.fixture(scope="module")
def views():
    scene = MovingEllipsoid()
    return [scene.view(k) for k in range(2)]


@pytest.fixture(scope="module")
def seeds(views):
    spacing = seed_spacing(views[0], SETTINGS.n_patches)
    return seed_patches(views[0], np.zeros((0, 3)), spacing, SETTINGS, np.random.default_rng(0))


def test_narrow_patches_have_the_middle_samples_of_wide_ones():
    curvature, size = [-3.0, 1.0, -2.0], 0.002
    (wide, place), (narrow, own), (full, every) = (samples_of(curvature, size, *r) for r in ((2, 4), (2, 2), (4, 4)))
    assert_array_equal(wide, narrow)
    assert_array_equal(own, np.arange(25))
    assert_array_equal(every, np.arange(81))
    assert_array_equal(place, np.arange(81).reshape(9, 9)[2:-2, 2:-2].ravel())
    assert_array_equal(wide, full[place])


@pytest.mark.parametrize("radius", [2, 3, 4])
def test_every_second_sample_is_that_of_a_chequerboard(radius):
    samples, place = samples_of([-3.0, 1.0, -2.0], 0.002, radius, 4, stride=2)
    i, j = np.rint(samples[:, :2].T / 0.002).astype(int)
    assert not ((i + j) % 2).any() and len(samples) == ((2 * radius + 1) ** 2 + 1) // 2
    assert_array_equal(place, 9 * (j + 4) + i + 4)


def test_samples_lie_on_a_paraboloid_row_by_row():
    (a, b, c), size = (-3.0, 1.0, -2.0), 0.002
    s, t = (size * g.ravel() for g in np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)))
    expected = [s, t, a * s * s + b * s * t + c * t * t, 2 * a * s + b * t, b * s + 2 * c * t]
    assert_array_equal(samples_of((a, b, c), size, 3, 3)[0], np.stack(expected, axis=1))


def test_shape_and_slopes_belong_together():
    grid = samples_of([-3.0, 1.0, -2.0], 0.002, 3, 3)[0].reshape(7, 7, 5)
    assert_allclose(np.gradient(grid[:, :, 2], 0.002, axis=1)[:, 1:-1], grid[:, 1:-1, 3], atol=1e-12)
    assert_allclose(np.gradient(grid[:, :, 2], 0.002, axis=0)[1:-1], grid[1:-1, :, 4], atol=1e-12)


def reference_sums(seeds, n, c, view, level, stride):
    """What a step needs of one camera, in double precision: count, J̃ᵀJ̃, J̃ᵀI, cov(T, I), variances of T and of I."""
    X, Q, slot = seeds.positions[n], seeds.frames[n], seeds.slots[n, c]
    grid, place = samples_of(seeds.curvature[n], seeds.size[n], seeds.radius[n], 4, stride)
    P = view.projections[c] @ np.vstack([np.c_[Q, X], [0, 0, 0, 1]])
    arm = grid[:, :3] - Q.T @ (view.centers[c] - X)
    facing = grid[:, 3] * arm[:, 0] + grid[:, 4] * arm[:, 1] - arm[:, 2]
    steep = facing < 0.2 * np.linalg.norm(arm, axis=1) * np.sqrt(1 + (grid[:, 3:] ** 2).sum(axis=1))
    h = np.c_[grid[:, :3], np.ones(len(grid))] @ P.T
    x, y = h[:, 0] / h[:, 2], h[:, 1] / h[:, 2]
    inside = view.masks[c, (y + 0.5).astype(int), (x + 0.5).astype(int)] != 0
    good = (seeds.store.usable[slot, place] > 0) & ~steep & inside
    grid, arm, facing, x, y, place = (a[good] for a in (grid, arm, facing, x, y, place))
    T, Ts, Tt = seeds.store.templates[slot, level, place].astype(float).T
    g2 = (Ts * arm[:, 0] + Tt * arm[:, 1]) / facing
    g = np.stack([Ts - grid[:, 3] * g2, Tt - grid[:, 4] * g2, g2], axis=1)
    J = np.c_[g, np.cross(grid[:, :3], g)]
    T = T - T.mean()
    J = J - J.mean(axis=0)
    J -= np.outer(T, T @ J / (T @ T))
    i, j = x.astype(int), y.astype(int)
    a, b, image = x - i, y - j, view.levels[level, c].astype(float)
    top, low = (image[r, i] * (1 - a) + image[r, i + 1] * a for r in (j, j + 1))
    grey = top * (1 - b) + low * b
    return len(T), J.T @ J, J.T @ grey, T @ grey / len(T), T.var(), grey.var()


@pytest.mark.parametrize(("level", "stride"), [(0, 1), (0, 2), (1, 1), (1, 2)])
def test_sums_of_a_camera_are_those_in_double_precision(views, seeds, level, stride):
    view, room, compared = views[1], 81 + LANES, 0
    for n in range(0, len(seeds), 5):
        samples, index = np.empty((5, room)), np.empty(room, int)
        N = fill_samples(seeds.curvature[n], seeds.size[n], seeds.radius[n], 9, stride, samples, index)
        shape, free, seen, T = (np.empty(s, np.float32) for s in ((5, room), (5, room), room, room))
        shape[:, :N] = samples[:, :N]
        J, moments, H, b = np.empty((6, room), np.float32), np.empty(14), np.zeros((6, 6)), np.empty(6)
        A = np.empty((3, 4))
        for c in np.flatnonzero(seeds.has[n]):
            local_camera(view.projections[c], seeds.positions[n], seeds.frames[n], A)
            center = (view.centers[c] - seeds.positions[n]) @ seeds.frames[n]
            placed = N, A.astype(np.float32), center.astype(np.float32), shape, index
            slot = seeds.slots[n, c]
            known = seeds.store.templates[slot, level], seeds.store.usable[slot], view.masks[c], True, True
            count = choose_samples(*placed, *known, free, seen, J, T, moments)
            if count == 0:
                continue
            compared += 1
            normal_matrix(N, J, moments, count, H)
            image = N, placed[1], shape, seen, view.levels[level, c], count, True, J, T, moments
            product, variance = compare(*image, b, np.empty(room, np.int32), free)
            number, normal, right, covariance, of_template, of_image = reference_sums(seeds, n, c, view, level, stride)
            assert count == number
            # sums of up to 81 products in single precision, of which means are taken away
            scale = np.sqrt(np.diag(normal))
            assert_allclose((H + np.tril(H, -1).T) / np.outer(scale, scale), normal / np.outer(scale, scale), atol=1e-4)
            assert_allclose(b / scale, right / scale, atol=1e-4 * np.sqrt(number * of_image))
            assert_allclose([moments[0], variance], [of_template, of_image], rtol=1e-5)
            assert_allclose(product, covariance, atol=1e-5 * np.sqrt(of_template * of_image))
    assert compared > 20


def test_templates_are_put_into_the_same_store_while_there_is_room():
    numbers = np.arange(20.0, dtype=np.float32)[:, None, None, None] * np.ones((1, 4, 3), np.float32)
    parts = [TemplateStore(numbers[k : k + 2].copy(), np.full((2, 4), k, np.uint8), 2) for k in range(0, 8, 2)]
    store, slots, stores = parts[0], np.array([[0, -1], [-1, 1]]), []
    for part in parts[1:]:
        store, old, new = store.join(slots, part, np.array([[-1, 0], [1, -1]]))
        slots = np.concatenate([old, new[:1]])  # the second one leaves
        stores.append(store)
        assert_array_equal(slots >= 0, [[True, False], [False, True], *[[False, True]] * (len(slots) - 2)])
        there = slots[slots >= 0]
        assert_array_equal(store.templates[there, 0, 0, 0], [0, 1, 2, 4, 6][: len(there)])
        assert_array_equal(store.usable[there, 0], [0, 0, 2, 4, 6][: len(there)])
    assert stores[1] is stores[0] and stores[2] is not stores[1]
    assert store.used == 6 and len(store.templates) == 9
