"""Kernels of joints between bodies against NumPy and SciPy."""

import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.transform import Rotation

from geomocap.bodies.joint_kernel import frames_of, joint_costs, parting_of, tree_cost

BODIES, FRAMES, RIDGE, VARIANCE, LEAST = 6, 30, 0.07, 4e-6, 5


@pytest.fixture(scope="module")
def motions():
    rng = np.random.default_rng(5)
    turns = Rotation.from_rotvec(rng.normal(scale=0.4, size=(BODIES * FRAMES, 3))).as_matrix()
    return turns.reshape(BODIES, FRAMES, 3, 3), rng.normal(scale=0.3, size=(BODIES, FRAMES, 3))


def parting_by_numpy(motions, first, second, frames, place):
    rotations, translations = motions
    turned = rotations[first, frames] - rotations[second, frames]
    apart = turned @ place + translations[first, frames] - translations[second, frames]
    normal = np.einsum("tji,tjk->ik", turned, turned) / len(turned) + RIDGE * np.eye(3)
    moved = -np.linalg.solve(normal, np.einsum("tji,tj->i", turned, apart) / len(turned))
    return turned @ moved + apart


def test_common_points_part_as_numpy_says(motions):
    rng = np.random.default_rng(6)
    for first, second in ((0, 1), (4, 2)):
        frames, place = np.sort(rng.choice(FRAMES, 20, replace=False)), rng.normal(size=3)
        apart = np.empty((20, 3))
        square = parting_of(*motions, first, second, frames, place, RIDGE, apart)
        expected = parting_by_numpy(motions, first, second, frames, place)
        np.testing.assert_allclose(apart, expected, atol=1e-12)
        assert square == pytest.approx((expected**2).sum(axis=1).mean(), rel=1e-12)


def test_frames_that_show_both_bodies_and_all_where_these_are_few():
    known = np.zeros((3, FRAMES), bool)
    known[0, :20], known[1, 10:], known[2, 18:] = True, True, True
    frames = np.empty(FRAMES, np.int64)
    assert frames[: frames_of(known, 0, 1, LEAST, frames)].tolist() == list(range(10, 20))
    assert frames_of(known, 0, 2, LEAST, frames) == FRAMES and frames.tolist() == list(range(FRAMES))
    assert frames_of(known[:, :2], 1, 2, LEAST, frames) == 2  # a sequence of so few has no others


def test_joints_cost_what_numpy_says(motions):
    rng = np.random.default_rng(7)
    contacts = rng.integers(0, 2, (BODIES, BODIES))
    contacts = contacts | contacts.T
    places = rng.normal(size=(BODIES, BODIES, 3))
    places = places + places.swapaxes(0, 1)
    known = rng.random((BODIES, FRAMES)) < 0.7
    bodies, body = np.array([3, 0, 1, 5]), 3
    contacts[3] = contacts[:, 3] = 1
    expected = np.zeros((4, 4))
    for i in range(4):
        for k in range(i):
            pair = int(bodies[i]), int(bodies[k])
            frames = np.flatnonzero(known[pair[0]] & known[pair[1]])
            where = [places[pair]] if contacts[pair] else []
            where += [] if body in pair else [places[body, one] for one in pair]
            least = min((parting_by_numpy(motions, *pair, frames, p) ** 2).sum(axis=1).mean() for p in where)
            expected[i, k] = expected[k, i] = np.log1p(least / VARIANCE)
    found = joint_costs(bodies, body, *motions, known, contacts, places, RIDGE, VARIANCE, LEAST)
    np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_the_tree_costs_what_scipy_says(count):
    costs = np.random.default_rng(count).random((count, count)) + 0.1
    costs = np.triu(costs, 1) + np.triu(costs, 1).T
    assert tree_cost(costs) == pytest.approx(minimum_spanning_tree(costs).sum())
