"""All cameras decide together: what none confirms goes, what all others see stays, and a few decide alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import cv2
import numpy as np
import open3d as o3d
import pycolmap
import pytest
from scipy.ndimage import maximum

from geomocap.model.rig import Rig
from geomocap.silhouettes.background import BackgroundModel, model_from_plate
from geomocap.silhouettes.colors import LEVEL, LEVELS, color_density, count_colors
from geomocap.silhouettes.joint_decision import CameraEvidence, Decision, decide, learn_from
from geomocap.silhouettes.likelihood import (
    BINS,
    CLASSES,
    QUARTERS,
    SURE,
    Counts,
    Likelihood,
    log_odds,
    misfit_density,
    shared_noise,
)
from geomocap.silhouettes.other_cameras import NOWHERE, STEPS, OtherCameras, best_on_rays, gather, say
from geomocap.silhouettes.pieces import clean, said_of
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

SETTINGS = SilhouetteSettings()
WIDTH, HEIGHT = 200, 160
CLOTH = np.array([150.0, 70.0, 60.0])


def ring_rig(count: int, arc_deg: float = 360.0) -> Rig:
    """Cameras of two lens models round the origin."""
    poses = []
    for i in range(count):
        angle = np.deg2rad(arc_deg) * i / count + 0.3
        center = np.array([2.6 * np.cos(angle), 2.6 * np.sin(angle), 0.4 + 0.5 * (i % 2)])
        z = -center / np.linalg.norm(center)
        x = np.cross([0.0, 0.0, -1.0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        poses.append(np.column_stack([R, -R @ center]))
    lenses = [
        pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=[230, 231, 99, 81, -0.06, 0.01, 0, 0]),
        pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[225, 100, 80]),
    ]
    return Rig(tuple(f"cam{i}" for i in range(count)), tuple(lenses[i % 2] for i in range(count)), np.array(poses))


def ball(center: tuple[float, float, float], radius: float) -> o3d.geometry.TriangleMesh:
    return o3d.geometry.TriangleMesh.create_sphere(radius, 30).translate(center)


def subject(shift: float) -> list[o3d.geometry.TriangleMesh]:
    """A trunk with a head and a leg."""
    parts = [((0, 0, 0), 0.28), ((0.05, 0, 0.38), 0.14), ((0, 0.08, -0.34), 0.12), ((0.02, 0.1, -0.5), 0.09)]
    return [ball((x + shift, y, z), r) for (x, y, z), r in parts]


def render(rig: Rig, meshes: list[o3d.geometry.TriangleMesh]) -> list[np.ndarray]:
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    masks = []
    for c, (w, h) in enumerate(rig.sizes):
        v, u = np.mgrid[0:h, 0:w] + 0.5
        origin, directions = rig.rays(c, np.column_stack([u.ravel(), v.ravel()]))
        rays = np.column_stack([np.broadcast_to(origin, directions.shape), directions]).astype(np.float32)
        masks.append(np.isfinite(scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()).reshape(h, w))
    return masks


def cloud_texture(shape: tuple[int, ...], scale: float, rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.normal(size=(*shape, 3)).astype(np.float32), (0, 0), scale)
    return noise / noise.std()


@dataclass
class Stage:
    """Walls of all cameras, images and true masks by frame."""

    rig: Rig
    walls: list[np.ndarray]
    images: list[list[np.ndarray]]
    masks: list[list[np.ndarray]]
    rng: np.random.Generator

    def learn(self, others: OtherCameras | None) -> tuple[list[BackgroundModel], Likelihood]:
        """Backgrounds, and the likelihood from all frames."""
        models = [
            model_from_plate(noisy(wall, self.rng), [frame[c] for frame in self.images])
            for c, wall in enumerate(self.walls)
        ]
        counts = [learn_from(self.views(models, k), others, SETTINGS) for k in range(len(self.images))]
        return models, Likelihood.of(reduce(add, counts))

    def views(self, models: list[BackgroundModel], frame: int) -> list[CameraEvidence]:
        return [CameraEvidence.of(i, m, SETTINGS) for i, m in zip(self.images[frame], models, strict=True)]

    def decided(self, frame: int) -> tuple[Decision, Decision]:
        """Alone, and together."""
        others = OtherCameras.of(self.rig)
        models, likelihood = self.learn(others)
        views = self.views(models, frame)
        return decide(views, likelihood, None, SETTINGS), decide(views, likelihood, others, SETTINGS)


def noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(np.rint(image + rng.normal(0, 1.5, image.shape)), 0, 255).astype(np.uint8)


def stage(rig: Rig, frames: int = 3, like: int | None = None, bystander: int | None = None) -> Stage:
    """A subject before walls; camera `like` has its colours on one half, camera `bystander` sees somebody else."""
    rng = np.random.default_rng(11)
    walls = []
    for c, (w, h) in enumerate(rig.sizes):
        wall = 120 + 12 * cloud_texture((h, w), 9.0, rng)
        if c == like:
            wall[:, w // 2 :] = (CLOTH + 2 * cloud_texture((h, w), 9.0, rng))[:, w // 2 :]
        walls.append(wall)
    images, masks = [], []
    for k in range(frames):
        truth = render(rig, subject(0.1 * (k - 1)))
        row = []
        for c, (wall, mask) in enumerate(zip(walls, truth, strict=True)):
            image = wall.copy()
            image[mask] = (CLOTH + 7 * cloud_texture(mask.shape, 2.0, rng))[mask]
            if c == bystander:
                image[50:140, 6:26] = [60, 80, 160]
            row.append(noisy(image, rng))
        images.append(row)
        masks.append(truth)
    return Stage(rig, walls, images, masks, rng)


def overlap(mask: np.ndarray, truth: np.ndarray) -> float:
    return np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth)


def test_what_one_camera_hardly_sees_comes_from_the_others() -> None:
    scene = stage(ring_rig(8), like=2)
    alone, together = scene.decided(1)
    truth = scene.masks[1]
    assert overlap(alone.masks[2], truth[2]) < 0.93
    assert overlap(together.masks[2], truth[2]) > overlap(alone.masks[2], truth[2]) + 0.015
    assert min(overlap(m, t) for m, t in zip(together.masks, truth, strict=True)) > 0.94


def test_a_bystander_whom_one_camera_sees_goes() -> None:
    scene = stage(ring_rig(5), bystander=1)
    alone, together = scene.decided(1)
    assert alone.masks[1][60:130, 8:24].all()
    assert not together.masks[1][:, :30].any()
    assert min(overlap(m, t) for m, t in zip(together.masks, scene.masks[1], strict=True)) > 0.95


def test_images_that_cut_the_subject_off_deny_nothing_beyond_their_border() -> None:
    rig = ring_rig(6)
    lenses = list(rig.cameras)
    for c in (1, 4):  # the lower half of the image is missing
        lenses[c] = pycolmap.Camera({**lenses[c].todict(), "height": 84})
    scene = stage(Rig(rig.names, tuple(lenses), np.array(rig.cam_from_world)))
    _, together = scene.decided(1)
    assert [m.shape[0] for m in together.masks] == [160, 84, 160, 160, 84, 160]
    assert min(overlap(m, t) for m, t in zip(together.masks, scene.masks[1], strict=True)) > 0.95


def test_an_empty_stage_is_empty_and_learns_nothing() -> None:
    scene = stage(ring_rig(4))
    scene.images = [[noisy(wall, scene.rng) for wall in scene.walls] for _ in range(3)]
    others = OtherCameras.of(scene.rig)
    models, likelihood = scene.learn(others)
    assert not any(m.any() for m in decide(scene.views(models, 0), likelihood, others, SETTINGS).masks)
    np.testing.assert_array_equal(likelihood.subject, color_density(np.zeros(LEVELS**3)))
    assert (likelihood.worth == 0).all()


def test_a_camera_that_sees_nobody_bears_no_witness() -> None:
    scene = stage(ring_rig(6))
    for images in scene.images:
        images[3] = noisy(scene.walls[3], scene.rng)
    _, together = scene.decided(1)
    assert not together.masks[3].any()
    seen = [c for c in range(6) if c != 3]
    assert min(overlap(together.masks[c], scene.masks[1][c]) for c in seen) > 0.95


@pytest.mark.parametrize("arc_deg", [0.0, 60.0])
def test_cameras_that_confirm_nothing_decide_alone_or_nearly_so(arc_deg: float) -> None:
    """Two cameras at one place bound nothing; two side by side say little."""
    scene = stage(ring_rig(2, arc_deg))
    alone, together = scene.decided(1)
    for a, b, t in zip(alone.masks, together.masks, scene.masks[1], strict=True):
        assert overlap(a, t) > 0.95 and overlap(b, t) > 0.95


def test_decisions_are_the_same_every_time() -> None:
    scene = stage(ring_rig(3))
    others = OtherCameras.of(scene.rig)
    models, likelihood = scene.learn(others)
    first, second = (decide(scene.views(models, 0), likelihood, others, SETTINGS) for _ in range(2))
    for a, b in zip(first.masks, second.masks, strict=True):
        np.testing.assert_array_equal(a, b)


# --- likelihood ---


def test_density_of_normal_noise_is_the_normal_density() -> None:
    rng = np.random.default_rng(0)
    misfit = 0.5 * (rng.normal(size=(400_000, 3)) ** 2).sum(axis=1)
    found = misfit_density(np.histogram(misfit, BINS)[0].astype(float))
    assert found.shape == (QUARTERS,) and (np.diff(found) <= 0).all()
    D = (np.arange(2, 16) + 0.5) / 4
    np.testing.assert_allclose(found[2:16], -D - 1.5 * np.log(2 * np.pi), atol=0.15)


def test_heavier_noise_makes_large_misfits_likelier() -> None:
    rng = np.random.default_rng(0)
    misfit = 0.5 * (2.0 * rng.normal(size=(200_000, 3)) ** 2).sum(axis=1)
    found = misfit_density(np.histogram(misfit, BINS)[0].astype(float))
    assert found[40] > Likelihood.unlearnt(1).background[0, 40] + 3


def test_shared_noise_counts_the_pixels_that_fraction_it() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(size=(400, 500)).astype(np.float32)
    everywhere = np.ones(white.shape, bool)
    assert shared_noise(white, everywhere) == pytest.approx(1, abs=0.1)
    assert shared_noise(cv2.blur(white, (3, 3)), everywhere) == pytest.approx(9, rel=0.15)
    assert shared_noise(white, np.zeros(white.shape, bool)) == 1


def test_colors_are_a_density() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(80, 120, (60, 60, 3)).astype(np.uint8)
    counts = count_colors(image, np.ones((60, 60), bool))
    assert counts.sum() == 3600
    density = np.exp(color_density(counts))
    width = np.bincount(LEVEL, minlength=LEVELS)
    cell = width[:, None, None] * width[None, :, None] * width[None, None, :]
    assert (density * cell).sum() == pytest.approx(0.7 + 0.3 * 256**3 / 30**3, rel=0.02)
    assert density[tuple(LEVEL[[100, 100, 100]])] > 1.2e-5 > density[tuple(LEVEL[[20, 20, 200]])]


def test_log_odds_are_as_in_numpy() -> None:
    rng = np.random.default_rng(4)
    h, w = 30, 40
    image = rng.integers(0, 256, (h, w, 3)).astype(np.uint8)
    mean = rng.uniform(20, 200, (h, w, 3)).astype(np.float32)
    sigma = rng.uniform(1, 4, (h, w)).astype(np.float32)
    known = rng.uniform(size=(h, w)) > 0.1
    model = BackgroundModel(mean, sigma, known)
    misfit = rng.exponential(20, (h, w)).astype(np.float32)
    shade = np.where(rng.uniform(size=(h, w)) < 0.5, rng.exponential(3, (h, w)), np.inf).astype(np.float32)
    counts = count_colors(image, rng.uniform(size=(h, w)) < 0.3)
    likelihood = replace(Likelihood.unlearnt(1), subject=color_density(counts), shadow=np.linspace(-4, 3, CLASSES))
    found = log_odds(image, model, misfit, shade, likelihood, 0)

    front = likelihood.subject[tuple(np.moveaxis(LEVEL[image], -1, 0))]
    quarter = np.minimum((4 * misfit).astype(int), QUARTERS - 1)
    lit = likelihood.background[0, quarter] - 3 * np.log(sigma)
    lit = np.maximum(lit, np.log(5e-3 / 256**3))
    odds = front - lit
    fits = likelihood.shadow[(np.minimum(shade, 11.9) * 2).astype(int)] - 4 * np.log1p(model.texture)
    odds = np.where(shade < 12, np.minimum(odds, fits), odds)
    expected = np.where(known, np.clip(odds, -6, 6), 1.0)
    np.testing.assert_allclose(found, expected, atol=1e-3)


# --- the volume between the cameras ---


def test_says_follow_the_sensor_model() -> None:
    assert say(np.array([0.0])) == 0
    far = say(np.array([20.0, -20.0])) / STEPS
    np.testing.assert_allclose(far, [np.log(0.98 / 0.3), np.log(0.02 / 0.7)], atol=0.04)


def test_voxels_and_rays_are_read_as_in_numpy() -> None:
    rng = np.random.default_rng(2)
    rig = ring_rig(3)
    others = OtherCameras.of(rig)
    says = rng.integers(-50, 20, others.valid.shape).astype(np.int8)
    beyond = np.array([-5, 0, -7], np.int8)
    origin, edge, shape = np.array([-0.7, -0.6, -0.9]), 0.09, (15, 14, 20)
    origin.setflags(write=False)  # as a grid's
    volume = np.empty((3, *shape), np.int8)
    gather(others.projections, says, beyond, origin, edge, volume)
    centers = origin + (np.stack(np.mgrid[:15, :14, :20], axis=-1) + 0.5) * edge
    q = (
        np.einsum("cij,xyzj->cxyzi", others.projections[:, :, :3], centers)
        + others.projections[:, None, None, None, :, 3]
    )
    u, v = np.floor(q[..., 0] / q[..., 2]).astype(int), np.floor(q[..., 1] / q[..., 2]).astype(int)
    H, W = says.shape[1:]
    inside = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    c = np.arange(3)[:, None, None, None]
    expected = np.where(inside, says[c, v.clip(0, H - 1), u.clip(0, W - 1)], beyond[c])
    assert (expected == volume).mean() > 0.9999  # a centre on the border between two pixels may fall into either

    camera = others.cameras[0]
    word = volume[1:].sum(axis=0, dtype=np.int16)
    best, _ = best_on_rays(camera.origin, camera.rays, word, origin, edge, 300.0, 10_000)
    steps = np.arange(0, 5, edge / 50)
    for y, x in np.argwhere(best < np.inf)[::37]:
        place = np.floor((camera.origin + steps[:, None] * camera.rays[y, x] - origin) / edge).astype(int)
        i, j, k = place[((place >= 0) & (place < shape)).all(axis=1)].T
        finest = word[i, j, k].max(initial=int(NOWHERE * STEPS)) / STEPS
        assert best[y, x] <= finest + 1e-6  # steps of a whole voxel may pass a corner by, but never invent one
        if len(i) > 400:
            assert best[y, x] > NOWHERE
    least = float(np.quantile(word, 0.7))
    for enough in (10_000, 20):
        best, length = best_on_rays(camera.origin, camera.rays, word, origin, edge, least, enough)
        assert 0 < length.max() < 40
        for y, x in np.argwhere(best < np.inf)[::37]:
            expected = _best_on_ray(camera.origin, camera.rays[y, x], word, origin, edge, least, enough)
            assert (best[y, x], length[y, x]) == (np.float32(expected[0]), expected[1])


def _best_on_ray(
    origin: np.ndarray, ray: np.ndarray, word: np.ndarray, low: np.ndarray, edge: float, least: float, enough: int
) -> tuple[float, int]:
    """`best_on_rays` of one ray, step by step from where it meets the grid."""
    ray = ray.astype(float)
    borders = np.sort((np.array([low, low + np.array(word.shape) * edge]) - origin) / ray, axis=0)
    near, far = max(0.0, borders[0].max()), borders[1].min()
    best, length = NOWHERE * STEPS, 0
    for n in range(int((far - near) / edge) + 1 if near < far else 0):
        place = (origin + near * ray - low) / edge + (n + 0.5) * ray
        if (place >= 0).all() and (place < word.shape).all():
            said = word[tuple(place.astype(int))]
            best, length = max(best, said), length + (said >= least)
    return min(best, enough) / STEPS, length


def test_what_is_confirmed_is_as_large_as_it_is_in_space():
    """A ball that seven of eight cameras are sure of, as the eighth sees it: in voxels, whatever the lens."""
    rig = ring_rig(8)
    others = OtherCameras.of(rig)
    masks = render(rig, [ball((0.0, 0.0, 0.0), 0.3)])
    words = others.words([np.where(mask, 6.0, -6.0).astype(np.float32) for mask in masks])
    assert words is not None
    voxel = 0.6 * (1 + 2 * 0.04) / 96  # the grid goes round the ball
    for word, mask in zip(words, masks, strict=True):
        assert (word.size[~cv2.dilate(mask.view(np.uint8), np.ones((15, 15), np.uint8)).view(bool)] == 0).all()
        assert word.size.max() == pytest.approx(0.6 / voxel, rel=0.25)  # a hull is larger, a box has a margin
        rows, columns = np.nonzero(mask)
        assert word.size[int(rows.mean()), int(columns.mean())] > 0.9 * word.size.max()


def test_a_large_volume_is_worth_more_than_a_thin_one():
    counts = Counts(
        np.zeros((2, len(BINS))),
        np.zeros(LEVELS**3),
        np.zeros((2, CLASSES + 1)),
        np.array([[90.0, 80, 70, 50, 20, 9, 0, 0], [10.0, 20, 70, 100, 400, 900, 999, 0]]),
        np.ones((2, 2)),
    )
    likelihood = Likelihood.of(counts)
    sizes = np.array([[0.0, 0.3, 0.9, 3.0, 6.0, 12.0, 31.0, 200.0]])
    bonus = likelihood.bonus(sizes)[0]
    assert bonus[0] == bonus[1] == 0.0
    assert (np.diff(bonus) >= 0).all()
    of_four_to_eight = np.log(401 / 21)
    assert likelihood.bonus(np.array([[8.0 * np.sqrt(2)]]))[0, 0] == pytest.approx(of_four_to_eight)
    assert bonus[-1] <= SURE


def middle(mask: np.ndarray, reach: int) -> tuple[slice, slice]:
    """The square that goes so far from the middle of what is true."""
    y, x = (int(np.median(places)) for places in np.nonzero(mask))
    return np.s_[y - reach : y + reach, x - reach : x + reach]


def test_what_looks_like_the_wall_behind_is_no_hole_in_the_subject():
    """One camera takes a part of the trunk for its wall, in every frame; the others hold far more than a gap there."""
    rig = ring_rig(8)
    scene = stage(rig)
    for images, masks in zip(scene.images, scene.masks, strict=True):
        images[0][middle(masks[0], 16)] = noisy(
            scene.walls[0][middle(masks[0], 16)] + scene.rng.normal(0, 2.5, (32, 32, 3)), scene.rng
        )
    alone, together = scene.decided(1)
    part = middle(scene.masks[1][0], 14)
    assert alone.voted[0][part].mean() < 0  # by itself it sees the wall
    assert together.masks[0][part].all()


def test_a_piece_that_the_others_deny_everywhere_goes() -> None:
    """One other camera that sees the place is too little against each pixel, but not against all of a piece."""
    mask = np.zeros((60, 80), bool)
    mask[10:50, 10:30] = mask[20:40, 50:70] = True
    odds = np.where(mask, 6.0, -6.0).astype(np.float32)
    words = np.full(mask.shape, -3.5, np.float32)
    words[15:45, 12:28] = 2.0  # the rim of the subject isn't confirmed, but hangs together with what is
    alone, together = (clean(mask, odds, 1.0, 1e-4, said) for said in (None, words))
    np.testing.assert_array_equal(alone, mask)
    assert together[10:50, 10:30].all() and together.sum() == 40 * 20
    words[25:30, 55:60] = 0.0  # nobody else sees this
    np.testing.assert_array_equal(clean(mask, odds, 1.0, 1e-4, words), mask)


def test_what_others_say_of_regions_is_their_largest_word():
    rng = np.random.default_rng(3)
    labels = rng.integers(0, 9, (40, 30)).astype(np.int32)
    words = rng.normal(-3.0, 1.2, labels.shape).astype(np.float32)
    found = said_of(labels, words, 10)  # label 9: no pixel
    largest = maximum(words, labels, np.arange(9))
    np.testing.assert_array_equal(found[:9], largest >= 0.0)
    assert 0 < found.sum() < 9 and not found[9]
