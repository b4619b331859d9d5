"""Bodies that turn alike once they are refined."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap import motion
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.model.motion_paths import MotionPaths
from tests.geomocap.moving_chains import chain, same_partition


@pytest.fixture(scope="module")
def three():
    return chain(3)


@pytest.fixture(scope="module")
def found(three):
    return find_motion_bodies(MotionPaths(three.positions))


def split(bodies, wobble_deg):
    """Bodies of which half of the first is another one, whose motion wobbles."""
    half = (bodies.label == 0) & (bodies.rest[:, 0] > np.median(bodies.rest[bodies.label == 0, 0]))
    weights = np.pad(bodies.weights, ((0, 0), (0, 1)))
    weights[half] = np.eye(bodies.body_count + 1)[-1]
    angles = wobble_deg * np.sin(np.arange(len(bodies.rotations)))[:, None]
    wobble = Rotation.from_euler("z", angles, degrees=True).as_matrix()
    turned = wobble @ bodies.rotations[:, 0]
    middle = bodies.rest[half].mean(axis=0)
    shift = bodies.rotations[:, 0] @ middle + bodies.translations[:, 0] - turned @ middle
    return replace(
        bodies,
        label=np.where(half, bodies.body_count, bodies.label).astype(np.int32),
        weights=weights,
        rotations=np.concatenate([bodies.rotations, turned[:, None]], axis=1),
        translations=np.concatenate([bodies.translations, shift[:, None]], axis=1),
        reliability=np.pad(bodies.reliability, ((0, 0), (0, 1)), constant_values=0.5),
        confidence=np.append(bodies.confidence, 0.55),
    )


def test_bodies_that_turn_alike_once_refined_are_one(three, found, monkeypatch):
    paths = MotionPaths(three.positions)
    torn = split(found, wobble_deg=17.0)
    monkeypatch.setattr(motion, "find_bodies_and_depths", lambda *_: (torn, paths))
    joined = motion.find_motion(paths, fps=30)
    assert joined.body_count == 3
    assert same_partition(joined.labels, three.body) > 0.97
    as_asked = motion.find_motion(paths, fps=30, bodies=4)
    assert as_asked.body_count == 4


def test_a_body_takes_the_samples_of_another(found):
    torn = split(found, wobble_deg=17.0)
    joined = torn.merged(0, 3)
    np.testing.assert_array_equal(joined.label, found.label)
    np.testing.assert_array_equal(joined.rotations, found.rotations)
    np.testing.assert_allclose(joined.weights.sum(axis=1), 1.0)
    sizes = np.bincount(torn.label)
    expected = (sizes[0] * torn.reliability[:, 0] + sizes[3] * torn.reliability[:, 3]) / (sizes[0] + sizes[3])
    np.testing.assert_allclose(joined.reliability[:, 0], expected)
    assert joined.confidence[0] == torn.confidence[[0, 3]].max()
    other_way = torn.merged(3, 0)  # later numbers move up
    assert same_partition(other_way.label, found.label) == 1.0
    np.testing.assert_array_equal(other_way.rotations[:, 2], torn.rotations[:, 3])
