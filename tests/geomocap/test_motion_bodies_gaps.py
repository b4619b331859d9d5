"""Bodies of motion paths with gaps: how these are filled, and what is judged over the frames that are seen."""

import numpy as np
import pytest

from data_tools.figure import figure
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.files.scan_geometry import ScanSurface, places_on
from geomocap.model.motion_paths import MotionPaths
from geomocap.trajectories.completion import complete_tracks
from tests.geomocap.moving_chains import chain, same_partition, seen_while_it_turns


@pytest.fixture(scope="module")
def three():
    return chain(3)


def test_broken_paths_give_the_same_bodies(three):
    rng = np.random.default_rng(1)
    start = rng.integers(-6, 16, len(three.body))
    frame = np.arange(24)
    alive = (frame >= start[:, None]) & (frame < start[:, None] + 12)
    positions = np.where(alive[..., None], three.positions, np.nan)
    bodies = find_motion_bodies(MotionPaths(positions))
    assert bodies.body_count == 3
    assert same_partition(bodies.label, three.body) > 0.93
    gap = ~alive
    miss = np.linalg.norm(bodies.positions - three.positions, axis=2)[gap]
    assert np.median(miss) < 0.02


def test_completion_carries_gaps_with_the_neighbours(three):
    positions = three.positions.copy()
    positions[::5, 6:18] = np.nan
    filled, certainty = complete_tracks(MotionPaths(positions))
    miss = np.linalg.norm(filled - three.positions, axis=2)
    assert np.median(miss[::5, 6:18]) < 0.01
    assert (certainty[::5, 6:18] < 1).all() and (certainty[::5, 6:18] > 0).all()
    np.testing.assert_array_equal(filled[1::5], three.positions[1::5])


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_what_goes_out_of_sight_stays_with_its_body(seed):
    seen, true, body = seen_while_it_turns(seed)
    gaps = np.isnan(seen[..., 0])
    assert gaps.mean() > 0.4
    filled, _ = complete_tracks(MotionPaths(seen))
    miss = np.linalg.norm(filled - true, axis=2)[gaps]
    assert np.median(miss) < 0.01 and np.quantile(miss, 0.9) < 0.05  # of boxes 0.4 m long
    found = find_motion_bodies(MotionPaths(seen))
    assert found.body_count == 3
    assert same_partition(found.label, body) > 0.99
    by_bodies = np.linalg.norm(found.positions - true, axis=2)[gaps]  # 11 to 14 mm, by neighbours alone 15 to 20
    assert np.quantile(by_bodies, 0.9) < 0.85 * np.quantile(miss, 0.9)


def test_soft_limbs_stay_bodies_where_each_path_is_short():
    """Each point is seen for a quarter of the frames: what is soft is judged over those, as what is missed is."""
    asset = figure()
    surfaces = [ScanSurface(asset.vertices(t), asset.faces) for t in np.arange(60) / 30.0]
    places = places_on(surfaces[0], 1500, seed=0)
    paths = np.stack([places.of(surface.points) for surface in surfaces], axis=1)
    rng = np.random.default_rng(0)
    for path in paths:
        begin = int(rng.integers(-11, 56))
        path[: max(begin, 0)] = path[begin + 15 :] = np.nan
    assert 14 <= find_motion_bodies(MotionPaths(paths)).body_count <= 18  # of 16; over all frames 4 to 6
