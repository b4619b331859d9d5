from dataclasses import replace

import numpy as np
import pytest

from geomocap.patches import patch_search
from geomocap.patches.patch_search import Followed, search
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.seeding import seed_patches, seed_spacing
from tests.geomocap.moving_ellipsoid import MovingEllipsoid

SETTINGS = TrackingSettings(n_patches=150, radius_px=4)
FAR = 0.2  # metres: nothing there looks like a patch


@pytest.fixture(scope="module")
def views():
    scene = MovingEllipsoid()
    return [scene.view(k) for k in range(2)]


@pytest.fixture(scope="module")
def state(views):
    spacing = seed_spacing(views[0], SETTINGS.n_patches)
    patches = seed_patches(views[0], np.zeros((0, 3)), spacing, SETTINGS, np.random.default_rng(0))
    return Followed.begin(patches, np.arange(len(patches)), by_one=False)


@pytest.fixture
def asked(monkeypatch):
    """Numbers of points of which the flow was asked, and patches that were aligned, call by call."""
    flow, aligned = [], []
    image_flow, align = patch_search.image_flow, patch_search.align

    def counted_flow(previous, view, positions, seen):
        flow.append(len(positions))
        return image_flow(previous, view, positions, seen)

    def counted_align(patches, which, *rest, iterations, **more):
        if iterations[0] > 0:
            aligned.append(which)
        return align(patches, which, *rest, iterations=iterations, **more)

    monkeypatch.setattr(patch_search, "image_flow", counted_flow)
    monkeypatch.setattr(patch_search, "align", counted_align)
    return flow, aligned


def test_where_moving_on_fits_flow_is_not_needed(views, state, asked):
    flow, _ = asked
    found = search(state, views[0], views[0], SETTINGS)
    assert not flow
    np.testing.assert_allclose(found.positions, state.patches.positions, atol=1e-4)  # metres: 0.03 pixels
    moving = search(state, views[0], views[1], SETTINGS)
    assert 0 < sum(flow) < len(state.patches)  # the others fit where they were
    assert (moving.correlation > 0.9).mean() > 0.8


def test_only_those_that_were_there_before_try_their_neighbours_motions(views, state, asked):
    _, aligned = asked
    patches = state.patches
    away = patches.positions.copy()
    away[:10] += FAR
    gap = np.zeros(len(patches), int)
    gap[:5] = 3
    lost = replace(state, patches=patches.moved(away, patches.frames), gap=gap)
    search(lost, views[0], views[0], SETTINGS)
    first, second = aligned
    assert np.isin(np.arange(10), first).all()
    np.testing.assert_array_equal(second, np.arange(5, 10))
