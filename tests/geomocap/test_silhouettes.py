from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from geomocap.errors import CaptureError, SettingsError
from geomocap.silhouettes.background import (
    BackgroundModel,
    add_agreeing,
    model_from_frames,
    model_from_plate,
)
from geomocap.silhouettes.evidence import background_misfit, smooth_evidence
from geomocap.silhouettes.joint_decision import coverage, silhouette
from geomocap.silhouettes.light import light_change
from geomocap.silhouettes.region import region_of_points
from geomocap.silhouettes.shadows import shadow_misfit
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

W, H = 320, 240
FINE = 4  # supersampling of the scene


@dataclass(frozen=True)
class Scene:
    """A painted walker before a textured wall: frames, exact half-coverage masks, the plate."""

    plate: np.ndarray
    frames: list[np.ndarray]
    masks: list[np.ndarray]


def texture(shape: tuple[int, int], scale: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth colour noise of about unit variance: (h, w, 3)."""
    noise = rng.normal(size=(*shape, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), scale)
    return noise / noise.std()


def walker(t: float, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Coverage and body part (0 trousers, 1 shirt, 2 skin) of a figure at FINE times the size."""
    part = np.full((H * FINE, W * FINE), -1, np.int8)

    def limb(a: tuple[float, float], b: tuple[float, float], r: float, kind: int) -> None:
        layer = np.zeros(part.shape, np.uint8)
        p, q = ((int((x + shift) * FINE * 16), int(y * FINE * 16)) for x, y in (a, b))
        cv2.line(layer, p, q, 1, int(2 * r * FINE), shift=4)
        part[layer > 0] = kind

    s = np.sin(t)
    for sign in (1, -1):
        knee, foot = (160 + 14 * s * sign, 168.0), (160 + 24 * s * sign, 208.0)
        limb((160, 130), knee, 8, 0)
        limb(knee, foot, 6, 0)
        limb(foot, (foot[0] + 8, 210), 4, 2)
        elbow, hand = (160 - 22 * s * sign - 8 * sign, 96.0), (160 - 36 * s * sign - 12 * sign, 118.0)
        limb((160, 72), elbow, 5, 1)
        limb(elbow, hand, 3.5, 2)
    limb((160, 74), (160, 128), 13, 1)
    limb((160, 44), (160, 50), 10, 2)
    return part >= 0, part


def scene(n: int = 12, noise: float = 1.5, shadow: float = 0.6, drift: float = 0.06, travel: float = 120) -> Scene:
    rng = np.random.default_rng(7)
    size = (H * FINE, W * FINE)
    wall = 128 + 24 * texture(size, 5.0 * FINE, rng) + 14 * texture(size, 0.8 * FINE, rng)
    wall[150 * FINE :] = 90 + 0.6 * (wall[150 * FINE :] - 128)
    cloth = 8 * texture(size, 0.7 * FINE, rng)
    colors = np.array([[32, 34, 42], [170, 60, 50], [205, 160, 130]], np.float32)

    def small(a: np.ndarray) -> np.ndarray:
        return cv2.resize(a, (W, H), interpolation=cv2.INTER_AREA)

    frames, masks = [], []
    for k in range(n):
        t = 2 * np.pi * k / n
        shift = travel * (k / max(1, n - 1) - 0.5)
        cover, part = walker(t, shift)
        image = wall.copy()
        if shadow < 1:
            soft = np.zeros(size, np.float32)
            cv2.ellipse(soft, (int((195 + shift) * FINE), 212 * FINE), (55 * FINE, 9 * FINE), 0, 0, 360, 1, -1)
            cv2.ellipse(soft, (int((215 + shift) * FINE), 95 * FINE), (16 * FINE, 50 * FINE), 0, 0, 360, 1, -1)
            soft = cv2.GaussianBlur(soft, (0, 0), 3.0 * FINE)
            image *= (1 - (1 - shadow) * soft)[..., None]
        moved = np.roll(cloth, int(shift * FINE), axis=1)
        shade = (1 + 0.2 * np.cos(np.arange(size[1]) / (9 * FINE)))[None, :, None]
        body = colors[np.maximum(part, 0)] * shade + moved
        image = np.where(cover[..., None], body, image)
        light = 1 + drift * np.sin(t + np.arange(3))
        image = small(image) * light + rng.normal(0, noise, (H, W, 3))
        frames.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
        masks.append(small(cover.astype(np.float32)) >= 0.5)
    plate = np.clip(np.rint(small(wall) + rng.normal(0, noise, (H, W, 3))), 0, 255).astype(np.uint8)
    return Scene(plate, frames, masks)


def overlap(mask: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union."""
    mask, truth = mask > 0, truth > 0
    return np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth)


@pytest.fixture(scope="module")
def walk() -> Scene:
    return scene()


@pytest.fixture(scope="module")
def model(walk: Scene) -> BackgroundModel:
    return model_from_plate(walk.plate, walk.frames, camera="left")


def test_true_masks_are_met_under_shadow_noise_and_light_drift(walk: Scene, model: BackgroundModel) -> None:
    ious = [overlap(silhouette(f, model), m) for f, m in zip(walk.frames, walk.masks, strict=True)]
    assert min(ious) > 0.97


def test_without_shadow_handling_the_shadow_counts_as_subject(walk: Scene, model: BackgroundModel) -> None:
    settings = SilhouetteSettings(shadows=False)
    assert overlap(silhouette(walk.frames[2], model, settings), walk.masks[2]) < 0.8


def test_without_gain_the_light_change_counts_as_subject(walk: Scene, model: BackgroundModel) -> None:
    settings = SilhouetteSettings(gain=False, shadows=False)
    assert overlap(silhouette(walk.frames[3], model, settings), walk.masks[3]) < 0.7


def test_light_change_is_found_with_the_subject_in_view(walk: Scene, model: BackgroundModel) -> None:
    gain, offset = light_change(walk.frames[3], model.mean, model.sigma, model.known)
    grey = model.mean.mean(axis=(0, 1))
    expected = 1 + 0.06 * np.sin(2 * np.pi * 3 / 12 + np.arange(3))
    np.testing.assert_allclose(gain * grey + offset, expected * grey, atol=0.6)


def test_frames_that_agree_with_the_plate_are_added_as_in_numpy() -> None:
    rng = np.random.default_rng(3)
    plate = rng.uniform(60, 200, (20, 30, 3)).astype(np.float32)
    sigma = rng.uniform(1, 6, (20, 30)).astype(np.float32)
    image = np.clip(0.9 * plate + 7 + rng.normal(0, 8, plate.shape), 0, 255).astype(np.uint8)
    gain, offset = np.array([0.9, 0.88, 0.93]), np.array([7.0, 6.0, 8.0])
    relit = ((np.arange(256)[:, None] - offset) / gain).astype(np.float32)
    total, count = plate.copy(), np.ones(sigma.shape, np.float32)
    add_agreeing(image, relit, plate, sigma, total, count)

    value = ((image - offset) / gain).astype(np.float32)
    agrees = np.abs(value - plate).max(axis=-1) < 3.0 * sigma
    assert 0.2 < agrees.mean() < 0.8
    np.testing.assert_array_equal(count, 1 + agrees)
    np.testing.assert_array_equal(total, plate + value * agrees[..., None])


def test_noise_is_measured(model: BackgroundModel) -> None:
    assert 1.4 < np.median(model.sigma) < 1.9


def test_background_over_time(walk: Scene) -> None:
    model = model_from_frames(walk.frames)
    error = np.abs(model.mean / model.mean.mean(axis=(0, 1)) - walk.plate / walk.plate.mean(axis=(0, 1))).max(axis=-1)
    assert np.quantile(error[model.known], 0.95) < 0.06
    assert np.mean([overlap(silhouette(f, model), m) for f, m in zip(walk.frames, walk.masks, strict=True)]) > 0.85


def test_frames_come_out_the_same_in_any_order_and_process(walk: Scene, model: BackgroundModel) -> None:
    copy = pickle.loads(pickle.dumps(model))
    with ThreadPoolExecutor(4) as pool:
        backwards = list(pool.map(lambda f: silhouette(f, copy), walk.frames[::-1]))[::-1]
    for frame, mask in zip(walk.frames, backwards, strict=True):
        np.testing.assert_array_equal(silhouette(frame, model), mask)


def test_an_empty_scene_gives_an_empty_mask_and_another_scene_a_full_one(model: BackgroundModel, walk: Scene) -> None:
    assert coverage(silhouette(walk.plate, model)) == 0
    inverse = (255 - walk.plate)[::-1].copy()
    assert coverage(silhouette(inverse, model)) > 0.8


def test_region_limits_the_silhouette(walk: Scene, model: BackgroundModel) -> None:
    region = region_of_points(np.array([[0, 0], [W, 0], [W, 100], [0, 100]]), (W, H))
    assert region[:100].all() and not region[100:].any()
    mask = silhouette(walk.frames[2], model, region=region)
    assert mask[:100].any() and not mask[100:].any()
    assert coverage(mask, region) == pytest.approx(coverage(mask) * H / 100)


def test_region_of_points_is_their_hull() -> None:
    corners = np.array([[10.0, 10], [30, 10], [30, 40], [10, 40], [20, 25], [np.nan, 3]])
    region = region_of_points(corners, (64, 48))
    expected = np.zeros((48, 64), bool)
    expected[10:40, 10:30] = True
    np.testing.assert_array_equal(region, expected)
    triangle = region_of_points(np.array([[0, 0], [40, 0], [0, 40]]), (64, 48))
    assert triangle[10, 10] and triangle[0, 38] and not triangle[21, 21]
    with pytest.raises(SettingsError, match="at least 3"):
        region_of_points(corners[:2], (64, 48))
    with pytest.raises(SettingsError, match="outside the 64×48"):
        region_of_points(corners + 500, (64, 48))


def test_alpha_marks_what_is_unknown(walk: Scene) -> None:
    alpha = np.full((H, W, 1), 255, np.uint8)
    alpha[60:80, 50:90] = 0
    model = model_from_plate(np.concatenate([walk.plate, alpha], axis=-1), walk.frames)
    assert not model.known[70, 60] and model.known[10, 10]
    ious = [overlap(silhouette(f, model)[100:], m[100:]) for f, m in zip(walk.frames, walk.masks, strict=True)]
    assert min(ious) > 0.95


def test_a_gap_stays_open_and_a_coincidence_of_colours_is_filled() -> None:
    rng = np.random.default_rng(1)
    plate = np.clip(100 + 20 * texture((80, 100), 1.0, rng), 0, 255).astype(np.uint8)
    image, solid = plate.astype(float), np.zeros((80, 100), bool)
    solid[10:70, 20:80] = True
    solid[30:40, 30:40] = False  # a real gap
    image[solid] = [200, 60, 40]
    patch = (slice(50, 60), slice(55, 65))  # the subject has nearly the background's colours here
    image[patch] = plate[patch] + 9.0
    image = np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)
    model = BackgroundModel(plate, np.full((80, 100), 1.8), np.ones((80, 100), bool))
    mask = silhouette(image, model, SilhouetteSettings(shadows=False, gain=False)) > 0
    assert not mask[33:37, 33:37].any()
    assert mask[patch].all()
    assert overlap(mask, solid) > 0.99


def test_dark_trousers_are_no_shadow() -> None:
    rng = np.random.default_rng(2)
    floor = np.clip(90 + 3 * texture((80, 100), 1.0, rng), 0, 255).astype(np.float32)
    model = BackgroundModel(floor, np.full((80, 100), 1.6), np.ones((80, 100), bool))
    image = floor.copy()
    image[20:60, 30:45] *= 0.65  # shadow
    image[20:60, 60:75] = 24 + 2 * texture((40, 15), 0.7, rng)  # trousers
    image = np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)
    expected = np.zeros((80, 100), bool)
    expected[20:60, 60:75] = True
    assert overlap(silhouette(image, model), expected) > 0.95


def test_pieces_of_several_subjects_stay_and_specks_go(walk: Scene, model: BackgroundModel) -> None:
    image = np.hstack([walk.frames[0][:, :160], walk.frames[11][:, 160:]])
    truth = np.hstack([walk.masks[0][:, :160], walk.masks[11][:, 160:]])
    settings = SilhouetteSettings(gain=False)
    image[20:23, 5:8] = [255, 0, 255]
    model = BackgroundModel(model.mean, np.maximum(model.sigma, 4), model.known)
    mask = silhouette(image, model, settings)
    assert not mask[18:26, :12].any()
    assert mask[:, :150].any() and mask[:, 170:].any()
    assert overlap(mask, truth) > 0.8


def test_the_subject_before_the_sharpest_edges_is_no_noise() -> None:
    rng = np.random.default_rng(8)
    plate = np.full((120, 160, 3), 110.0)
    plate[60:] = 60.0  # one sharp edge, half covered at all times
    image = plate.copy()
    image[40:80, 20:130] = [30, 80, 160]
    frames = [np.clip(image + rng.normal(0, 1.5, plate.shape), 0, 255).astype(np.uint8) for _ in range(4)]
    model = model_from_plate(plate.astype(np.uint8), frames)
    assert model.sigma.max() < 10
    truth = np.zeros((120, 160), bool)
    truth[40:80, 20:130] = True
    assert overlap(silhouette(frames[0], model), truth) > 0.99


def test_bad_input_is_named(walk: Scene, model: BackgroundModel) -> None:
    with pytest.raises(CaptureError, match="camera left: 320×240 pixels, but the images are 160×120"):
        silhouette(np.zeros((120, 160, 3), np.uint8), model)
    with pytest.raises(CaptureError, match="camera left: 100×50 pixels, but the images are 320×240"):
        model_from_plate(np.zeros((50, 100, 3), np.uint8), walk.frames, camera="left")
    with pytest.raises(CaptureError, match="expected \\(H, W, 3\\) uint8"):
        silhouette(np.zeros((H, W), np.uint8), model)
    with pytest.raises(CaptureError, match="no frames"):
        model_from_plate(walk.plate, [])
    with pytest.raises(CaptureError, match="at least 3"):
        model_from_frames(walk.frames[:2], camera="left")
    with pytest.raises(CaptureError, match="camera left: 320×240 pixels, but the images are 100×50"):
        model_from_frames([*walk.frames[:3], np.zeros((50, 100, 3), np.uint8)], camera="left")
    with pytest.raises(CaptureError, match="region of interest"):
        silhouette(walk.frames[0], model, region=np.ones((2, 2), bool))
    with pytest.raises(CaptureError, match="don't fit"):
        BackgroundModel(np.zeros((4, 4, 3)), np.zeros((4, 5)), np.zeros((4, 4), bool))


# --- kernels beside their references ---


def test_background_misfit_is_half_the_chi_square(walk: Scene, model: BackgroundModel) -> None:
    gain, offset = np.array([1.02, 1, 0.97], np.float32), np.array([1, 0, -2], np.float32)
    known = model.known.copy()
    known[:20] = False
    image = walk.frames[1]
    kernel = background_misfit(image, model.mean, model.sigma, known, gain, offset)
    chi2 = (((image - (gain * model.mean + offset)) / model.sigma[..., None]) ** 2).sum(axis=-1)
    np.testing.assert_allclose(kernel, np.where(known, chi2 / 2, 0), rtol=1e-4, atol=2e-3)


def reference_smoothing(evidence: np.ndarray, image: np.ndarray, sigma: np.ndarray, reach: float, edge: float):
    """The recursive filter line by line."""
    picture = image.astype(float)
    scale = edge * sigma.astype(float)
    right = 1 / (1 + (np.diff(picture, axis=1) ** 2).sum(-1) / scale[:, :-1] ** 2) ** 2
    down = 1 / (1 + (np.diff(picture, axis=0) ** 2).sum(-1) / scale[:-1] ** 2) ** 2

    def line(values: np.ndarray, weights: np.ndarray) -> None:
        for k in range(1, len(values)):
            values[k] += weights[k - 1] * (values[k - 1] - values[k])
        for k in range(len(values) - 2, -1, -1):
            values[k] += weights[k] * (values[k + 1] - values[k])

    out = evidence.astype(float)
    for k in range(2):
        a = np.exp(-np.sqrt(2) / (reach * np.sqrt(3) * 2 ** (1 - k) / np.sqrt(15)))
        for y in range(out.shape[0]):
            line(out[y], a * right[y])
        for x in range(out.shape[1]):
            line(out[:, x], a * down[:, x])
    return out


def test_smoothing_is_the_recursive_filter(walk: Scene, model: BackgroundModel) -> None:
    part = (slice(60, 110), slice(60, 140))
    image, sigma = np.ascontiguousarray(walk.frames[2][part]), np.ascontiguousarray(model.sigma[part])
    evidence = np.random.default_rng(3).normal(size=sigma.shape).astype(np.float32)
    kernel = smooth_evidence(evidence, image, sigma)
    np.testing.assert_allclose(kernel, reference_smoothing(evidence, image, sigma, 3, 12), atol=1e-4)


def reference_misfit(image: np.ndarray, lit: np.ndarray, sigma: float, color: float) -> float:
    """Misfit of a whole window as the shadow of its background, and of its centre, by plain least squares."""
    n = image.shape[0]
    v, u = np.mgrid[:n, :n] - n // 2
    A = np.stack([(lit * k[..., None]).ravel() for k in (np.ones_like(u), u, v)], axis=1)
    s = np.linalg.lstsq(A, image.ravel().astype(float), rcond=None)[0]
    shaded = (A @ s).reshape(image.shape)
    tint = (image * shaded).sum((0, 1)) / (shaded**2).sum((0, 1))
    rest = ((image - tint * shaded) ** 2).sum((0, 1))
    texture = (rest / (sigma**2 + color**2 * (shaded**2).mean((0, 1)))).sum() / (3 * n * n)
    hue = ((tint - 1) ** 2 / (sigma**2 / (shaded**2).sum((0, 1)) + color**2)).sum()
    middle = (tint * shaded)[n // 2, n // 2]
    own = ((image[n // 2, n // 2] - middle) ** 2 / (sigma**2 + color**2 * middle**2)).sum()
    return 8 * max(0, texture - 1) + hue + own


def test_shadow_misfit_is_that_of_the_shaded_background() -> None:
    rng = np.random.default_rng(5)
    lit = (110 + 12 * texture((5, 5), 0.8, rng)).astype(np.float32)
    v, u = np.mgrid[:5, :5] - 2
    for tint in ([1, 1, 1], [1.08, 1, 0.9]):
        factor = (0.6 + 0.03 * u - 0.02 * v)[..., None] * np.array(tint)
        image = np.clip(lit * factor + rng.normal(0, 1.5, lit.shape), 0, 255).astype(np.uint8)
        direct = np.zeros((5, 5), np.float32)
        direct[2, 2] = 20  # one window alone
        one, zero = np.ones(3, np.float32), np.zeros(3, np.float32)
        sigma, known = np.full((5, 5), 1.6, np.float32), np.ones((5, 5), bool)
        result = shadow_misfit(direct, image, lit, sigma, known, one, zero, 0.4, 1e6)
        expected = reference_misfit(image, lit.astype(float), 1.6, 0.03) / 2
        assert result[2, 2] == pytest.approx(expected, rel=1e-3, abs=2e-3)
        for limit in (0.5 * result[2, 2], 2.0 * result[2, 2]):
            limited = shadow_misfit(direct, image, lit, sigma, known, one, zero, 0.4, limit)
            np.testing.assert_array_equal(limited, np.where(result < limit, result, np.inf))
        assert np.isinf(result.ravel()[np.arange(25) != 12]).all()
