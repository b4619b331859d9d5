"""Patches that a single camera sees."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geomocap.patches.one_camera import image_precision
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.patch_tracking import track_surface
from geomocap.patches.seeding import seed_for_one_camera
from tests.geomocap.moving_ellipsoid import MovingEllipsoid

FRAMES = 6
SCENE = MovingEllipsoid(n_cameras=3)  # 120° apart: two cameras never see the same surface well
SETTINGS = TrackingSettings(n_patches=150, radius_px=4, seed_every=4)


@pytest.fixture(scope="module")
def views():
    return [SCENE.view(k) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def tracks(views):
    return track_surface(lambda k: views[k], FRAMES, SETTINGS)


def test_the_surface_is_covered_where_two_cameras_see_too_little(views, tracks):
    alone = tracks.n_views == 1
    assert alone.sum() > 0.8 * tracks.measured.sum()
    assert tracks.measured.sum(axis=0).min() > 60
    never = SETTINGS.model_copy(update={"one_camera_below": 0.0})
    assert len(track_surface(lambda k: views[k], 2, never)) < 15


def test_they_are_placed_more_seldom(views):
    settings = SETTINGS.model_copy(update={"seed_every": None, "backward": False})
    assert set(np.unique(track_surface(lambda k: views[k], FRAMES, settings).placed)) <= {0, FRAMES - 1}


def test_they_follow_the_surface_and_state_how_well(tracks):
    start = tracks.start
    error = []
    for n in range(len(tracks)):
        turn, place = SCENE.pose(int(start[n]))
        body = (tracks.positions[n, start[n]] - place) @ turn
        truth = np.array([SCENE.pose(k)[0] @ body + SCENE.pose(k)[1] for k in range(FRAMES)])
        error.append(np.linalg.norm(tracks.positions[n] - truth, axis=1))
    late = (np.arange(FRAMES) > start[:, None]) & (tracks.n_views == 1)
    error, stated = np.array(error)[late], tracks.sigma[late]
    # a pixel is 4 mm, a voxel 10 mm, and the ellipsoid shifts by 22 mm and turns by 4° a frame
    assert np.median(error) < 0.006 and np.percentile(error, 95) < 0.03
    # how the volume is wrong in all frames alike is stated too, and on an ellipsoid it isn't
    assert 0.1 < np.median(error) / (1.54 * np.median(stated)) < 2


def test_precision_is_that_of_least_squares_in_two_dimensions(views):
    taken = np.zeros((0, 3))
    seeds = seed_for_one_camera(views[0], taken, 0.1, SETTINGS, np.random.default_rng(0))
    camera = seeds.has.argmax(axis=1)
    assert (seeds.has.sum(axis=1) == 1).all()
    got = image_precision(seeds, np.arange(len(seeds)), camera, np.full(len(seeds), 0.95))
    for n in range(len(seeds)):
        slot = seeds.slots[n, camera[n]]
        template = seeds.store.templates[slot, -1][seeds.store.usable[slot] != 0].astype(float)
        A = template[:, 1:] - template[:, 1:].mean(axis=0)
        residual = template[:, 0].var() * (1 - 0.95**2) * 0.15 * len(template) + 4
        expected = np.sqrt(np.linalg.eigvalsh(residual * np.linalg.inv(A.T @ A))[-1])
        assert got[n] == pytest.approx(expected, rel=1e-3)


def test_where_narrow_patches_hold_too_little_texture_there_are_wide_ones(views):
    plain = replace(views[0], levels=np.float32(0.2) * views[0].levels)  # a fifth of the contrast
    spacing, none = 0.02, np.zeros((0, 3))  # five pixels
    settings = TrackingSettings(radius_px=8)
    seeds = seed_for_one_camera(plain, none, spacing, settings, np.random.default_rng(0))
    width = 2 * seeds.radius + 1
    narrow, wide = seeds.positions[width == 11], seeds.positions[width == 17]
    assert len(narrow) + len(wide) == len(seeds) and len(wide) > 2 * len(narrow) > 0
    # they stand where the others don't
    assert cKDTree(narrow).query(wide)[0].min() > 0.7 * spacing
    only_narrow = settings.model_copy(update={"radius_px": 5})
    fewer = seed_for_one_camera(plain, none, spacing, only_narrow, np.random.default_rng(0))
    assert len(fewer) == len(narrow)


def test_where_texture_suffices_all_are_narrow(views):
    settings = TrackingSettings(radius_px=8)
    seeds = seed_for_one_camera(views[0], np.zeros((0, 3)), 0.02, settings, np.random.default_rng(0))
    assert (seeds.radius == 5).mean() > 0.9
