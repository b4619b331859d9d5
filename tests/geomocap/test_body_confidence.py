"""When a body is one: its confidence, and its size."""

from dataclasses import replace

import numpy as np
import pytest

from geomocap.bodies.body_alternatives import remove
from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_evidence import Candidate, judge
from geomocap.bodies.body_joints import Borders, held_together
from geomocap.bodies.body_model import model_of_labels
from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.first_bodies import first_bodies
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.model.motion_paths import MotionPaths
from geomocap.trajectories.completion import complete_tracks
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


def test_a_small_body_needs_more_evidence(three):
    positions = three.positions[(three.body != 2) | (np.arange(len(three.body)) % 2 == 0)]  # the last has 1/5 of them
    small = MotionBodiesSettings(min_fraction=0.24)
    assert find_motion_bodies(MotionPaths(positions), small).body_count == 3
    noisy = MotionPaths(positions + 0.018 * np.random.default_rng(0).normal(size=positions.shape))
    assert find_motion_bodies(noisy).body_count == 3
    assert find_motion_bodies(noisy, small).body_count == 2


def test_a_small_body_that_single_cameras_see_needs_more_evidence_too(three):
    kept = (three.body != 2) | (np.arange(len(three.body)) % 2 == 0)  # the last has 1/5 of them, each counts two thirds
    positions, small = three.positions[kept], MotionBodiesSettings(min_fraction=0.24)
    ray = seen_by_single_cameras(three, 0.0)[1][kept]
    assert find_motion_bodies(MotionPaths(positions, ray=ray), small).body_count == 3
    noisy = MotionPaths(positions + 0.018 * np.random.default_rng(0).normal(size=positions.shape), ray=ray)
    assert find_motion_bodies(noisy).body_count == 3
    assert find_motion_bodies(noisy, small).body_count == 2


def test_a_body_adds_to_the_joints_of_those_it_joins(three):
    paths, settings = MotionPaths(three.positions), MotionBodiesSettings()
    first = first_bodies(*complete_tracks(paths), paths, settings)
    model = model_of_labels(three.body, first.evidence)
    borders = Borders.of(model, first.evidence)
    assert (borders.contacts > 0).tolist() == [[False, True, False], [True, False, True], [False, True, False]]
    np.testing.assert_allclose(borders.places[1, 2], borders.places[2, 1])
    assert abs(borders.places[0, 1, 0] - three.joints[0, 0]) < 0.03
    criterion = Criterion(settings.least_turn(rigid=False), first.noise, settings.min_fraction, settings.soft_fraction)
    for body, neighbours in ((0, [1]), (2, [1])):
        assert held_together(body, np.array(neighbours), model, criterion, borders) == 0
    # without the middle one the outer two would have to meet, which they do nowhere
    assert held_together(1, np.array([0, 2]), model, criterion, borders) > 3
    # two halves of one body join nothing that the other half doesn't
    halves = np.where((three.body == 1) & (np.arange(len(three.body)) % 2 == 0), 3, three.body)
    model = model_of_labels(halves, first.evidence)
    borders = Borders.of(model, first.evidence)
    assert held_together(3, np.array([0, 1, 2]), model, criterion, borders) < 0.5


def test_few_samples_that_hardly_touch_others_are_no_body(three):
    paths, settings = MotionPaths(three.positions), MotionBodiesSettings()
    first = first_bodies(*complete_tracks(paths), paths, settings)
    label = three.body.copy()
    label[7] = 3
    linked = first.evidence.adjacency.tolil()
    only = linked[7].nonzero()[1][0]
    linked[7], linked[:, 7] = 0, 0
    linked[7, only] = linked[only, 7] = 1
    evidence = replace(first.evidence, adjacency=linked.tocsr())
    model = model_of_labels(label, evidence)
    criterion = Criterion(settings.least_turn(rigid=False), first.noise, settings.min_fraction, settings.soft_fraction)
    (candidate,) = judge([3], model, evidence.with_places_open(), criterion).values()
    assert candidate.strength < 0.5


def test_a_body_that_touches_others_in_one_place_only_goes(three):
    paths, settings = MotionPaths(three.positions), MotionBodiesSettings()
    first = first_bodies(*complete_tracks(paths), paths, settings)
    # a single sample is body 0; it touches one other and is near none that another body has
    label = three.body + 1
    lone = int(np.argmin(three.positions[:, 0, 0]))
    label[lone] = 0
    other = int(np.flatnonzero(label == 1)[0])
    few = first.evidence.adjacency.tolil(copy=True)
    few[lone], few[:, lone] = 0, 0
    few[lone, other] = few[other, lone] = 1
    near = first.evidence.near.tolil(copy=True)
    near[lone], near[:, lone] = 0, 0
    near[lone, lone] = 1
    evidence = replace(first.evidence, adjacency=few.tocsr(), near=near.tocsr())
    model, _ = remove(Candidate(0, 0.5, -1, 1.0, 0.5), model_of_labels(label, evidence), evidence)
    assert model.label[lone] == 1
