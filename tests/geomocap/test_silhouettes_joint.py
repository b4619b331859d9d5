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

from geomocap.model.rig import Rig
from geomocap.silhouettes.background import BackgroundModel, model_from_plate
from geomocap.silhouettes.colors import LEVEL, LEVELS, color_density, count_colors
from geomocap.silhouettes.joint_decision import CameraEvidence, Decision, decide, learn_from
from geomocap.silhouettes.likelihood import (
    BINS,
    CLASSES,
    QUARTERS,
    Likelihood,
    log_odds,
    misfit_density,
    shared_noise,
)
from geomocap.silhouettes.other_cameras import OtherCameras
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
