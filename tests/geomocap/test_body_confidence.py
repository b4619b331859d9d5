"""When a body is one: its confidence, and its size."""

import numpy as np
import pytest

from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.model.motion_paths import MotionPaths
from tests.geomocap.moving_chains import chain, seen_by_single_cameras


@pytest.fixture(scope="module")
def three():
    return chain(3)


def test_confidence_of_bodies(three):
    found = find_motion_bodies(MotionPaths(three.positions))
    assert found.confidence.shape == (3,)
    assert (found.confidence > 0.6).all() and (found.confidence <= 1.0).all()
    forced = find_motion_bodies(MotionPaths(three.positions), MotionBodiesSettings(bodies=4))
    assert forced.confidence.min() < 0.5


def test_no_body_is_left_that_explains_less_than_is_required():
    # a trunk that bends all along: samples that choose their bodies anew weaken one of those that were kept (to 0.47)
    four = chain(4, samples=150, turn_deg=30.0)
    rest, width = four.positions[:, 0], 0.6
    steps = [np.clip((rest[:, 0] - joint + width / 2) / width, 0.0, 1.0) for joint in (0.4, 0.8, 1.2)]
    first, second, third = (s**2 * (3.0 - 2.0 * s) for s in steps)
    weights = np.stack([1 - first, first * (1 - second), first * second * (1 - third), first * second * third], axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    carried = np.einsum("tbij,nj->nbti", four.rotations, rest) + four.translations.swapaxes(0, 1)[None]
    bodies = find_motion_bodies(MotionPaths(np.einsum("nb,nbti->nti", weights, carried)))
    assert (bodies.confidence >= 0.5).all()
    counts = [step.bodies for step in bodies.curve]
    assert counts == sorted(counts, reverse=True) and len(set(counts)) == len(counts)  # one curve, not two


@pytest.mark.parametrize(("halved", "bodies"), [(1, 3), (2, 2)])
def test_a_small_body_is_one_if_others_hang_together_by_it(three, halved, bodies):
    kept = (three.body != halved) | (np.arange(len(three.body)) % 2 == 0)
    settings = MotionBodiesSettings(min_fraction=0.22)  # of the samples 2/5, 2/5 and 1/5
    assert find_motion_bodies(MotionPaths(three.positions[kept]), settings).body_count == bodies


def test_what_single_cameras_see_counts_less_in_the_size_of_a_body(three):
    kept = (three.body != 2) | (np.arange(len(three.body)) % 2 == 0)
    positions, settings = (
        three.positions[kept],
        MotionBodiesSettings(min_fraction=0.16),
    )  # the last has 1/5 of the samples
    ray = seen_by_single_cameras(three, 0.0)[1][kept]
    assert find_motion_bodies(MotionPaths(positions), settings).body_count == 3
    assert find_motion_bodies(MotionPaths(positions, ray=ray), settings).body_count == 2
    assert find_motion_bodies(MotionPaths(positions, ray=ray), MotionBodiesSettings()).body_count == 3
