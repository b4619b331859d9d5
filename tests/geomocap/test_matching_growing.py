"""The grid, Voronoi regions, the consistency pass, and the seeds."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.matching import grow_kernel as gk
from geomocap.matching.epipolar import transfers
from geomocap.matching.growing import consistent, regions
from geomocap.matching.lsm import Matches
from geomocap.matching.match_grid import MatchGrid
from geomocap.matching.matching_settings import GrowingSettings, SeedSettings
from geomocap.matching.plane_sweep import SweepImages
from geomocap.matching.seeds import DepthRange, Seeds, find_seeds
from tests.geomocap.ball import RADIUS, Texture, photograph, ring


def test_grid_covers_the_mask_and_knows_its_neighbours() -> None:
    mask = np.zeros((40, 60), bool)
    mask[10:30, 20:50] = True
    grid = MatchGrid.over(mask.shape, 2.0, mask)
    assert len(grid) == 10 * 15
    rows, columns = (grid.pixels[:, ::-1].T).astype(int)
    assert mask[rows, columns].all()
    left, right, above, below = grid.neighbours[:, :4].T
    for side, way in ((left, (-2, 0)), (right, (2, 0)), (above, (0, -2)), (below, (0, 2))):
        there = side >= 0
        np.testing.assert_allclose(grid.pixels[side[there]] - grid.pixels[there], np.tile(way, (there.sum(), 1)))
    assert (left < 0).sum() == 10 and (above < 0).sum() == 15
    np.testing.assert_array_equal(grid.image(np.arange(150), -1)[grid.row, grid.column], np.arange(150))
    assert len(MatchGrid.over((20, 20), 2.0, np.zeros((20, 20)))) == 0


def seeds_at(pixels: np.ndarray) -> Seeds:
    return Seeds(pixels, np.tile([0.5, 0, 0], (len(pixels), 1)), np.ones(len(pixels)), {})


def test_regions_are_those_of_the_nearest_seed() -> None:
    grid = MatchGrid.over((60, 80), 2.0)
    pixels = np.random.default_rng(0).uniform([5, 5], [75, 55], (12, 2))
    region, begin = regions(grid, seeds_at(pixels))
    nearest = np.linalg.norm(grid.pixels[:, None] - pixels[None], axis=2).argmin(axis=1)
    np.testing.assert_array_equal(region, nearest)
    assert (region[begin] == np.arange(12)).all()
    none = regions(grid, seeds_at(np.zeros((0, 2))))
    assert (none[0] == -1).all() and len(none[1]) == 0


def plane_matches(grid: MatchGrid, affine: np.ndarray) -> Matches:
    """Matches of a plane in two images."""
    n = len(grid)
    positions = np.repeat((grid.pixels @ affine.T)[:, None], 2, axis=1)
    zeros = np.zeros((n, 2))
    return Matches(
        positions,
        np.tile(affine, (n, 2, 1, 1)),
        np.zeros((n, 2, 2, 2)),
        *(zeros,) * 4,
        np.zeros((n, 2, 2)),
        *(zeros,) * 2,
        zeros.astype(int),
        zeros.astype(np.uint8),
    )


def test_consistency_removes_strays_and_islands_only() -> None:
    grid = MatchGrid.over((60, 80), 2.0)
    affine = np.array([[0.9, 0.1], [-0.1, 1.1]])
    matches = plane_matches(grid, affine)
    matched = np.ones(len(grid), bool)
    settings = GrowingSettings(step=2.0)
    assert consistent(grid, matches, matched, settings).all()
    stray = len(grid) // 2 + 7
    matches.positions[stray, 0] += 3.0
    kept = consistent(grid, matches, matched, settings)
    assert not kept[stray] and kept.sum() == len(grid) - 1
    # An island that hangs together with nothing, of five cells
    island = (grid.row == 3) & (grid.column >= 10) & (grid.column < 15)
    near = (np.abs(grid.row - 3) <= 1) & (grid.column >= 9) & (grid.column < 16)
    kept = consistent(grid, plane_matches(grid, affine), matched & (island | ~near), settings)
    assert not kept[island].any() and kept[~near].all()


@pytest.mark.parametrize("tilts", [0, 2])
def test_seeds_lie_on_the_ball(tilts: int) -> None:
    rig = ring(3, 40)
    images, masks = photograph(rig, Texture.random())
    grey = [i[..., 0].astype(np.float32) for i in images]
    order = [1, 0, 2]
    smooth = SweepImages.of([grey[i] for i in order], [masks[i] for i in order], 1.2)
    depth = DepthRange.constant(grey[1].shape, 1.2, 2.5)
    found = find_seeds(
        grey[1], masks[1], smooth, transfers(rig, 1, [0, 2]), depth, 420.0, SeedSettings(tilts=tilts, cell=14)
    )
    origin, rays = rig.rays(1, found.pixels)
    forward = rays @ rig.viewing_directions[1]
    points = origin + rays * (1 / found.planes[:, 0] / forward)[:, None]
    assert len(found) > 40
    assert np.mean(np.abs(np.linalg.norm(points, axis=1) - RADIUS) < 0.02) > (0.97 if tilts else 0.9)
    assert found.reasons["seed found"] == len(found)


def test_no_seeds_outside_the_depth_range() -> None:
    rig = ring(3, 40)
    images, masks = photograph(rig, Texture.random())
    grey = [i[..., 0].astype(np.float32) for i in images]
    smooth = SweepImages.of([grey[1], grey[0], grey[2]], [masks[1], masks[0], masks[2]], 1.2)
    nowhere = DepthRange.constant(grey[1].shape, np.nan, np.nan)
    found = find_seeds(grey[1], masks[1], smooth, transfers(rig, 1, [0, 2]), nowhere, 420.0)
    assert len(found) == 0 and set(found.reasons) == {"seed without depth range"}


def test_best_neighbours_as_written_out() -> None:
    rng = np.random.default_rng(0)
    grid = MatchGrid.over((30, 40), 2.0, rng.random((30, 40)) < 0.9)
    n = len(grid)
    planes = np.zeros((n, gk.PLANE))
    planes[:, gk.IMAGES] = rng.integers(0, 3, n)
    planes[:, gk.KEY] = rng.random(n)
    tries, last = rng.integers(0, 4, n), rng.integers(-1, n, n)
    source, key = np.full(n, -7, np.int64), np.zeros(n)
    # Some cells were last tried from their best neighbour, and are left alone
    gk.best_neighbours(grid.neighbours, planes, tries, 3, last, source, key)
    again = source >= 0
    last[again & (np.arange(n) % 3 == 0)] = source[again & (np.arange(n) % 3 == 0)]
    gk.best_neighbours(grid.neighbours, planes, tries, 3, last, source, key)
    for cell in range(n):
        around = [m for m in grid.neighbours[cell, :4] if m >= 0 and planes[m, gk.IMAGES] > 0]
        best = max(around, key=lambda m: planes[m, gk.KEY], default=-1)
        if planes[cell, gk.IMAGES] > 0 or tries[cell] >= 3 or best == last[cell]:
            best = -1
        assert source[cell] == best
        assert best < 0 or key[cell] == planes[best, gk.KEY]
    assert 0 < (source >= 0).sum() < n
