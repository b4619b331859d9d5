"""Lost patches that are found again by cameras that had not seen them."""

import numpy as np
from numpy.testing import assert_allclose

from geomocap.patches.patch_search import hiding_depth
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.reacquisition import reacquire
from geomocap.patches.seeding import seed_patches, seed_spacing
from geomocap.patches.surface_patches import with_templates
from tests.geomocap.moving_ellipsoid import MovingEllipsoid

SCENE = MovingEllipsoid(n_cameras=8, turn_deg=(0, 0, 45.0), shift=(0.0, 0.0, 0.0))
SETTINGS = TrackingSettings(n_patches=100, radius_px=4)


def test_after_a_turn_a_patch_is_known_again_by_the_next_cameras():
    views = [SCENE.view(k) for k in range(2)]
    spacing = seed_spacing(views[0], 100)
    seeds = seed_patches(views[0], np.zeros((0, 3)), spacing, SETTINGS, np.random.default_rng(0))
    turn, _ = SCENE.pose(1)
    truth = seeds.positions @ turn.T
    # a turn by the angle between cameras: what camera c saw, camera c + 1 sees now; nobody may use its own template
    only = np.zeros_like(seeds.has)
    only[np.arange(len(seeds)), seeds.has.argmax(axis=1)] = True
    known = with_templates(seeds.cleared((81, 8, 2)), only, views[0])
    rng = np.random.default_rng(1)
    carried = known.moved(truth + rng.normal(0, 0.004, truth.shape), turn @ seeds.frames)
    lost = np.ones(len(seeds), bool)
    lost[:3] = False
    slack = hiding_depth(carried, views[1], SETTINGS.slack_px)
    again, found, cameras = reacquire(carried, lost, views[1], slack, SETTINGS, 0.9)
    assert not found[:3].any() and found[3:].mean() > 0.7
    away = np.linalg.norm(again.positions - truth, axis=1)[found]
    assert np.median(away) < 0.001 and np.percentile(away, 90) < 0.004  # a pixel is 4 mm
    assert (cameras[found].sum(axis=1) >= 2).all() and not cameras[~found].any()
    assert_allclose(again.positions[:3], carried.positions[:3])
    # another piece of this smooth texture is seldom taken for it
    swapped = carried.moved(np.roll(carried.positions, 7, axis=0), np.roll(carried.frames, 7, axis=0))
    assert reacquire(swapped, lost, views[1], slack, SETTINGS, 0.9)[1].mean() < 0.15
