"""Least squares matching: known warps, the noise limit, the geometric condition, and slow references."""

from __future__ import annotations

import numba
import numpy as np
import pycolmap
import pytest
from scipy import ndimage, optimize

from geomocap.errors import CalibrationError
from geomocap.matching.epipolar import transfers
from geomocap.matching.lsm import REASONS, count_reasons, match_multi
from geomocap.matching.matching_settings import KernelSettings
from geomocap.matching.spline import NOISE_SLOPE, NOISE_VALUE, ImageStack
from geomocap.model.rig import Rig
from tests.geomocap.image_pairs import deviations, match_pairs, pair, plane_affine, seen_at
from tests.geomocap.speckle import Speckle, recorded

HEIGHT, WIDTH = 240, 320
CENTER = np.array([WIDTH / 2, HEIGHT / 2])
AFFINE = np.array([[1.05, 0.02], [-0.03, 0.95]])
SHIFT = np.array([0.37, -0.21])
SPECKLE = Speckle.random(HEIGHT, WIDTH, contrast=48)


def grid(margin: int = 24, step: float = 5.3) -> np.ndarray:
    """Template points, most of them between the pixels."""
    x, y = np.meshgrid(np.arange(margin, WIDTH - margin, step), np.arange(margin, HEIGHT - margin, step))
    return np.column_stack([x.ravel(), y.ravel()])


def warped(points: np.ndarray, affine: np.ndarray = AFFINE) -> np.ndarray:
    """Where the template points are in the warped image."""
    return (points - CENTER) @ affine.T + CENTER + SHIFT


@pytest.fixture(scope="module")
def images() -> tuple[np.ndarray, np.ndarray]:
    """Template and affinely warped image, exact."""
    return SPECKLE.render(HEIGHT, WIDTH), SPECKLE.render(HEIGHT, WIDTH, AFFINE, SHIFT, CENTER)


@pytest.mark.parametrize("order", [3, 5])
def test_spline_runs_through_the_pixels_and_agrees_with_scipy(order: int) -> None:
    image = np.random.default_rng(0).uniform(0, 255, (40, 50))
    stack = ImageStack.of([np.zeros((20, 20)), image], order)
    y, x = np.mgrid[:40, :50] + 0.5
    np.testing.assert_allclose(stack.sample(1, np.column_stack([x.ravel(), y.ravel()])), image.ravel(), atol=1e-3)
    pixels = np.random.default_rng(1).uniform([6, 6], [44, 34], (200, 2))
    expected = ndimage.map_coordinates(image, pixels[:, ::-1].T - 0.5, order=order, mode="mirror")
    np.testing.assert_allclose(stack.sample(1, pixels), expected, atol=2e-2)
    assert np.isnan(stack.sample(1, np.array([[0.4, 3.0], [50.0, 3.0], [np.nan, 1.0]]))).all()


@pytest.mark.parametrize("order", [3, 5])
def test_fraction_of_noise_that_a_spline_keeps(order: int) -> None:
    impulse = np.zeros(101)
    impulse[50] = 1
    row = order // 4
    for t in (0.0, 0.25, 0.5, 0.8):
        kept = np.sum(ndimage.map_coordinates(impulse, [np.arange(10, 90) + t], order=order, mode="mirror") ** 2)
        assert kept == pytest.approx(NOISE_VALUE[row] @ [1, np.cos(2 * np.pi * t)], abs=0.01)
    h = 1e-4
    ahead, behind = (ndimage.map_coordinates(impulse, [np.arange(10, 90) + s], order=order) for s in (h, -h))
    assert np.sum(((ahead - behind) / (2 * h)) ** 2) == pytest.approx(NOISE_SLOPE[row], rel=1e-4)


@pytest.mark.parametrize("order", [3, 5])
def test_no_bias_without_noise(images, order: int) -> None:
    points = grid()
    m = match_pairs(pair(*images, order), points, np.rint(warped(points)), KernelSettings(order=order))
    error = m.positions - warped(points)
    assert m.matched.all()
    assert np.abs(error.mean(axis=0)).max() < 1e-4
    assert np.abs(error).max() < 2e-3
    np.testing.assert_allclose(m.affine, np.broadcast_to(AFFINE, m.affine.shape), atol=2e-3)


@pytest.mark.parametrize("order", [3, 5])
@pytest.mark.parametrize("affine", [np.eye(2), AFFINE], ids=["shift", "affine"])
def test_noise_limit_and_predicted_precision(order: int, affine: np.ndarray) -> None:
    template = recorded(SPECKLE.render(HEIGHT, WIDTH), 2.0, 1)
    search = recorded(SPECKLE.render(HEIGHT, WIDTH, affine, SHIFT, CENTER), 2.0, 2)
    points = grid(step=3.1)
    true = warped(points, affine)
    settings = KernelSettings(order=order)
    m = match_pairs(pair(template, search, order), points, np.rint(true), settings)
    ok = m.matched
    error = m.positions[ok] - true[ok]
    assert ok.mean() > 0.99
    # Overlapping patches share their noise: only so many means are independent.
    independent = WIDTH * HEIGHT / 21**2
    assert np.abs(error.mean(axis=0)).max() <= 3 * error.std() / np.sqrt(independent)
    assert error.std(axis=0).max() <= 0.012
    assert (error / deviations(m)[ok]).std(axis=0) == pytest.approx([1, 1], abs=0.1)


def test_noise_in_the_slopes_is_counted_where_texture_is_weak() -> None:
    weak = Speckle.random(HEIGHT, WIDTH, contrast=9)
    template = recorded(weak.render(HEIGHT, WIDTH), 2.0, 1)
    search = recorded(weak.render(HEIGHT, WIDTH, None, SHIFT), 2.0, 2)
    points = grid(step=3.1)
    m = match_pairs(pair(template, search), points, points)
    ok = m.matched & (m.correlation > 0.7)
    ratio = (m.positions - points - SHIFT)[ok] / deviations(m)[ok]
    assert ok.mean() > 0.95
    assert ratio.std(axis=0) == pytest.approx([1, 1], abs=0.1)


def test_exposure_is_taken_by_gain_and_offset(images) -> None:
    points = grid(step=20)
    m = match_pairs(pair(images[0], (images[1] - 20) / 1.6), points, np.rint(warped(points)))
    assert np.abs(m.positions - warped(points)).max() < 2e-3
    np.testing.assert_allclose(m.gain, 1.6, rtol=1e-3)
    np.testing.assert_allclose(m.offset, 20, atol=0.2)


def reference(f_image, g_image, point, start, radius: int, order: int) -> np.ndarray:
    """Match one patch by a general least squares solver on the untransformed observation equations."""
    d = np.arange(-radius, radius + 1)
    dx, dy = (v.ravel() for v in np.meshgrid(d, d))
    base = np.rint(point - 0.5)
    f = f_image[(dy + base[1]).astype(int), (dx + base[0]).astype(int)].astype(float)
    spline = ndimage.spline_filter(np.pad(g_image.astype(float), 8, mode="reflect"), order=order, mode="mirror")

    def residuals(p):
        x = p[0] + p[2] * dx + p[3] * dy + 8
        y = p[1] + p[4] * dx + p[5] * dy + 8
        g = ndimage.map_coordinates(spline, [y, x], order=order, prefilter=False)
        return p[6] * 50 * g + p[7] * 50 - f

    p = optimize.least_squares(residuals, [*(start - 0.5 - (point - 0.5 - base)), 1, 0, 0, 1, 0.02, 0], xtol=1e-12).x
    return p[:2] + 0.5 + p[2:6].reshape(2, 2) @ (point - 0.5 - base)


@pytest.mark.parametrize("order", [3, 5])
def test_agrees_with_a_slow_solver(images, order: int) -> None:
    f, g = (recorded(image, 0.5, i) for i, image in enumerate(images))
    points = grid(step=61.3)
    start = np.rint(warped(points))
    settings = KernelSettings(radius=6, order=order, tolerance=1e-5, iterations=60)
    m = match_pairs(pair(f, g, order), points, start, settings)
    slow = np.array([reference(f, g, p, s, 6, order) for p, s in zip(points, start, strict=True)])
    # The two linearise the same noise at different ends of the warp, hence not to the last digit.
    np.testing.assert_allclose(m.positions, slow, atol=0.004)


def test_masked_patches_ignore_what_lies_outside() -> None:
    template = SPECKLE.render(HEIGHT, WIDTH)
    search = SPECKLE.render(HEIGHT, WIDTH, None, SHIFT)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :157] = True
    # Another surface that moves otherwise lies behind the contour at x = 160; the mask stays clear of the spline's
    # reach across it.
    other = Speckle.random(HEIGHT, WIDTH, seed=5, contrast=48)
    template[:, 160:] = other.render(HEIGHT, WIDTH)[:, 160:]
    search[:, 161:] = other.render(HEIGHT, WIDTH, None, (4.0, 3.0))[:, 161:]
    points = np.column_stack([np.full(60, 153.5), np.linspace(30, 210, 60)])
    bare = match_pairs(pair(template, search), points, points)
    masked = match_pairs(pair(template, search, mask=mask), points, points)
    error = np.abs(masked.positions - points - SHIFT)[masked.matched]
    assert masked.matched.mean() > 0.95
    assert np.median(error) < 0.005
    assert np.median(np.abs(bare.positions - points - SHIFT)) > 5 * np.median(error)


def plane_rig() -> Rig:
    """Three cameras 2 m in front of the plane z = 0, baseline ±0.5 m, all looking at the origin."""
    camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[400, 400, WIDTH / 2, HEIGHT / 2])
    poses = []
    for x, y in ((0.0, 0.0), (-0.5, 0.05), (0.5, 0.1)):
        center = np.array([x, y, -2.0])
        z = -center / np.linalg.norm(center)
        right = np.cross([0, 1, 0], z)
        right /= np.linalg.norm(right)
        R = np.array([right, np.cross(z, right), z])
        poses.append(np.column_stack([R, -R @ center]))
    return Rig(("a", "b", "c"), (camera,) * 3, np.array(poses))


def plane_triplet(noise: float) -> tuple[Rig, ImageStack]:
    """Images of a speckled plane: each is the template's speckle under its homography."""
    rig = plane_rig()
    T = transfers(rig, 0, [0, 1, 2])
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    fine = ImageStack.of([SPECKLE.render(HEIGHT, WIDTH)], 5)
    stack = [SPECKLE.render(HEIGHT, WIDTH)]
    for k in (1, 2):
        # On the plane z = 0 the inverse depth in the template is 1/2 everywhere: the warp is one homography.
        H = T[k, :9].reshape(3, 3) + 0.5 * np.outer(T[k, 9:], [0, 0, 1])
        p = np.linalg.inv(H) @ np.stack([x.ravel() - 0.5, y.ravel() - 0.5, np.ones(x.size)])
        image = fine.sample(0, (p[:2] / p[2]).T + 0.5).reshape(HEIGHT, WIDTH)
        stack.append(np.nan_to_num(image, nan=128.0))
    return rig, ImageStack.of([recorded(s, noise, i) if noise else s for i, s in enumerate(stack)])


def test_transfer_is_projection() -> None:
    rig = plane_rig()
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.3, 0.3, (20, 3))
    pixels = rig.project(points)
    depth = rig.to_camera(points)[0, :, 2]
    np.testing.assert_allclose(
        seen_at(transfers(rig, 0, [1, 2]), pixels[0], 1 / depth), pixels[1:].transpose(1, 0, 2), atol=1e-9
    )


def test_distorted_cameras_have_no_epipolar_lines() -> None:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=64, height=48, params=[50, 32, 24, 0.1])
    rig = Rig(("a", "b"), (camera,) * 2, np.tile(np.eye(3, 4), (2, 1, 1)))
    with pytest.raises(CalibrationError, match="undistorted"):
        transfers(rig, 0, [1])


def test_multi_photo_matching_finds_the_plane_better_than_pairs() -> None:
    rig, stack = plane_triplet(3.0)
    T = transfers(rig, 0, [1, 2])
    points = grid(margin=70, step=4.3)
    true = seen_at(T, points, np.full(len(points), 0.5))
    affine = plane_affine(T, points, np.full(len(points), 0.5), np.zeros((len(points), 2)))
    start = np.concatenate([true + 0.7, affine.reshape(*affine.shape[:2], 4)], axis=-1)
    alone = match_multi(stack, 0, [1, 2], points, start, None, KernelSettings(radius=6))
    settings = KernelSettings(radius=6, sigma_condition=0.02)
    together = match_multi(stack, 0, [1, 2], points, start, T, settings)
    assert together.matched.all(axis=1).mean() > 0.98
    ok = together.matched.all(axis=1) & alone.matched.all(axis=1)
    assert together.epipolar_distance[ok].max() < 0.1
    error = [np.linalg.norm(m.positions - true, axis=-1)[ok].mean() for m in (alone, together)]
    assert error[1] < 0.85 * error[0]
    assert together.inverse_depth[ok, 0] == pytest.approx(0.5, abs=2e-3)
    assert abs(together.inverse_depth[ok, 0].mean() - 0.5) < 1e-4


def test_condition_agrees_with_the_full_system() -> None:
    """The scalar elimination of the inverse depth solves the same system as all observation equations together."""
    rig, stack = plane_triplet(2.0)
    T = transfers(rig, 0, [1, 2])
    point = np.array([[150.5, 110.5]])
    start = seen_at(T, point, np.array([0.5])) + 0.4
    settings = KernelSettings(radius=6, sigma_condition=0.05, tolerance=1e-3, iterations=100)
    m = match_multi(stack, 0, [1, 2], point, start, T, settings)
    images = [recorded_pixels(stack, k) for k in range(3)]
    d = np.arange(-6, 7)
    dx, dy = (v.ravel() for v in np.meshgrid(d, d))
    f = images[0][dy + 110, dx + 150]

    def residuals(p):
        parts = []
        for k in (0, 1):
            q = p[8 * k : 8 * k + 8]
            x = q[0] - 0.5 + q[2] * dx + q[3] * dy
            y = q[1] - 0.5 + q[4] * dx + q[5] * dy
            g = ndimage.map_coordinates(images[k + 1], [y, x], order=3, mode="mirror")
            parts.append((q[6] * 50 * g + q[7] * 50 - f) / m.sigma0[0, k])
        seen = seen_at(T, point, p[16:17])[0]
        return np.concatenate([*parts, (p[[0, 1, 8, 9]] - seen.ravel()) / 0.05])

    guess = [*start[0, 0], 1, 0, 0, 1, 0.02, 0, *start[0, 1], 1, 0, 0, 1, 0.02, 0, 0.5]
    p = optimize.least_squares(residuals, guess, x_scale="jac", xtol=1e-12).x
    np.testing.assert_allclose(m.positions[0], [p[0:2], p[8:10]], atol=0.01)


def recorded_pixels(stack: ImageStack, image: int) -> np.ndarray:
    """Grey levels of an image of the stack at its pixel centres."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return stack.sample(image, np.column_stack([x.ravel(), y.ravel()])).reshape(HEIGHT, WIDTH).astype(float)


def test_reasons_for_failure_are_told() -> None:
    speckle, flat = SPECKLE.render(HEIGHT, WIDTH), np.full((HEIGHT, WIDTH), 90.0)
    same = pair(speckle, speckle)
    points = np.array([[160.0, 120.0], [3.0, 3.0], [np.nan, 5.0]])
    start = points.copy()
    reasons = match_pairs(pair(flat, speckle), points, start).status
    assert [REASONS[r] for r in reasons] == ["low texture", *["outside the template image or its mask"] * 2]
    start[0] = [-50.0, 500.0]
    assert REASONS[match_pairs(same, points[:1], start[:1]).status[0]] == "outside the search image"
    away = KernelSettings(max_shift=0.3)
    found = match_pairs(same, points[:1], points[:1] + 0.9, away)
    assert count_reasons(found.status) == {"far from the start": 1}
    unlike = pair(speckle, flat)
    assert count_reasons(match_pairs(unlike, points[:1], points[:1]).status) == {"low correlation": 1}
    assert len(match_pairs(unlike, np.zeros((0, 2)), np.zeros((0, 2))).status) == 0


def test_shapes_are_checked() -> None:
    stack = ImageStack.of([np.zeros((30, 30))] * 2)
    with pytest.raises(ValueError, match="start has shape"):
        match_multi(stack, 0, [1], np.zeros((2, 2)), np.zeros((2, 2, 2)))
    with pytest.raises(ValueError, match="transfers"):
        match_multi(stack, 0, [1], np.zeros((2, 2)), np.zeros((2, 1, 2)), np.zeros((3, 12)))
    with pytest.raises(ValueError, match="order"):
        ImageStack.of([np.zeros((30, 30))], 4)


def test_same_result_with_any_number_of_threads(images) -> None:
    both = pair(*(recorded(image, 2, i) for i, image in enumerate(images)))
    points = grid(step=9.7)
    results = []
    before = numba.get_num_threads()
    for threads in (1, before):
        numba.set_num_threads(threads)
        results.append(match_pairs(both, points, np.rint(warped(points))))
    numba.set_num_threads(before)
    np.testing.assert_array_equal(results[0].positions, results[1].positions)
    np.testing.assert_array_equal(results[0].covariance, results[1].covariance)
