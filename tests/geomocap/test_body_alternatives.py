"""Bodies against the best models without them."""

import numpy as np
import pytest

from geomocap.bodies.body_alternatives import best_alternative
from geomocap.bodies.body_criterion import Criterion
from geomocap.bodies.body_evidence import judge
from geomocap.bodies.body_model import model_of_labels, reassign
from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.first_bodies import first_bodies
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.model.motion_paths import MotionPaths
from geomocap.trajectories.completion import complete_tracks
from tests.geomocap.moving_chains import chain

SETTINGS = MotionBodiesSettings()


@pytest.fixture(scope="module")
def leg():
    """Trunk, thigh and shank, whose skin is a blend nearly everywhere: paths (N, T, 3) and places at rest along it."""
    three = chain(3, samples=200, turn_deg=60.0)
    rest, width = three.positions[:, 0], 0.4
    knee, hip = (np.clip((rest[:, 0] - joint + width / 2) / width, 0.0, 1.0) for joint in (0.8, 0.4))
    weights = np.stack([1 - hip, hip * (1 - knee), hip * knee], axis=1)
    carried = np.einsum("tbij,nj->nbti", three.rotations, rest) + three.translations.swapaxes(0, 1)[None]
    noise = 0.003 * np.random.default_rng(0).normal(size=three.positions.shape)
    return np.einsum("nb,nbti->nti", weights, carried) + noise, rest[:, 0]


def judged(positions, label):
    """What speaks for bodies of given samples beside the others, and against the best models without them."""
    paths = MotionPaths(positions)
    first = first_bodies(*complete_tracks(paths), paths, SETTINGS)
    criterion = Criterion(SETTINGS.least_turn(rigid=False), first.noise, SETTINGS.min_fraction, SETTINGS.soft_fraction)
    model = reassign(model_of_labels(label, first.evidence), first.evidence, 2)
    candidates = judge(range(model.count), model, first.evidence.with_places_open(), criterion)
    beside = np.array([candidates[b].evidence for b in range(model.count)])
    best = [best_alternative(candidates[b], model, first.evidence, criterion) for b in range(model.count)]
    return beside, np.array([alternative.evidence for alternative in best])


def test_half_a_soft_thigh_is_none(leg):
    positions, along = leg
    beside, against = judged(positions, np.digitize(along, [0.4, 0.6, 0.8]))
    assert (beside > 1.0).all()
    assert against[1:3].min() < 1.0 and (against[[0, 3]] > 1.0).all()


def test_a_soft_thigh_is_one(leg):
    positions, along = leg
    _, against = judged(positions, np.digitize(along, [0.4, 0.8]))
    assert (against > 1.0).all()


def test_a_soft_leg_has_three_bodies(leg):
    found = find_motion_bodies(MotionPaths(leg[0]))
    assert found.body_count == 3
