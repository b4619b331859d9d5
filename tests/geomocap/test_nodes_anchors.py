"""Anchors: paths known from elsewhere that keep nodes from sliding."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.model.motion_paths import DEPTH_FRACTION, MotionPaths, sure_part
from geomocap.nodes.anchors import AnchorPoints, Anchors, carried, find_homes
from geomocap.nodes.node_tracking import track_nodes
from tests.geomocap.capsules import SMALL, capsule, small_graph

# A round rod that turns about its axis looks the same all the time
ANGLES = np.deg2rad(12.0) * np.arange(5)
TURNS = Rotation.from_rotvec(np.column_stack([ANGLES, 0 * ANGLES, 0 * ANGLES])).as_matrix()


def rod(seed: int) -> np.ndarray:
    return capsule(1200, seed=seed) / [1, 1, 0.7]


def error(anchors: MotionPaths | None) -> tuple[float, float]:
    """Median error of the nodes of the rod in its outer frames, and their standard deviation, metres."""
    skin = SMALL.model_copy(update={"part_rounds": 0})
    t = track_nodes(lambda k: rod(20 + k) @ TURNS[k].T, 5, skin, anchors=anchors)
    at_rest = t.reference @ TURNS[t.reference_frame]
    truth = np.einsum("tij,nj->nti", TURNS, at_rest)
    return float(np.median(np.linalg.norm(t.positions - truth, axis=-1)[:, [0, 4]])), float(np.median(t.sigma))


def test_anchors_show_the_twist_of_a_round_limb():
    marks = np.einsum("tij,nj->nti", TURNS, rod(50)[:60])
    marks[::2, 0] = np.nan  # half of them are met later
    marks[1::2, 4] = np.nan
    (without, unsure), (with_them, sure) = error(None), error(MotionPaths(marks))
    # 24° on a radius of 8 cm are 33 mm
    assert without > 0.02
    assert with_them < 0.012
    assert sure < 0.8 * unsure


def test_wrong_depths_of_anchors_do_little_harm_where_rays_say_so():
    home = rod(50)
    marks = np.einsum("tij,nj->nti", TURNS, home[home[:, 1] > 0.03][:80])
    ray = np.zeros_like(marks)
    ray[..., 1] = -1.0
    off = 0.04 * np.random.default_rng(2).normal(size=(1, 5, 1)) * ray  # as hulls of few cameras are off
    misled, told = error(MotionPaths(marks + off))[0], error(MotionPaths(marks + off, ray=ray))[0]
    assert misled > 0.01
    assert told < 0.005


@pytest.mark.parametrize("rays", [False, True])
def test_what_marks_pull_is_the_sum_written_out(rays):
    _, _, g = small_graph()
    rng = np.random.default_rng(6)
    x, R = g.nodes + 0.1 * rng.normal(size=g.nodes.shape), Rotation.random(len(g.nodes), rng=rng).as_matrix()
    K, S = 40, len(g.samples)
    sample, offset, precision = rng.integers(0, S, K), 0.01 * rng.normal(size=(K, 3)), rng.random(K)
    position = g.deform(x, R)[0][sample] + 0.1 * rng.normal(size=(K, 3))
    ray = rng.normal(size=(K, 3))
    ray *= (rng.random((K, 1)) < 0.5) / np.linalg.norm(ray, axis=1, keepdims=True)
    A, b = np.ones((S, 3, 3)), np.ones((S, 3))
    marks = AnchorPoints(sample, offset, position, precision, ray if rays else None)
    marks.add_to(A, b, g, x, R, 4.0, 0.1)
    y, turn = carried(g, sample, x, R)
    np.testing.assert_allclose(y, g.deform(x, R)[0][sample], atol=1e-12)
    np.testing.assert_allclose(turn, np.einsum("kh,khij->kij", g.weights[sample], R[g.binding[sample]]), atol=1e-12)
    A2, b2 = np.ones((S, 3, 3)), np.ones((S, 3))
    for k, s in enumerate(sample):
        error = y[k] - position[k] - turn[k] @ offset[k]
        miss = sure_part(error, ray[k] if rays else None)
        w = 4 * precision[k] / (1 + miss @ miss / 0.1**2) ** 2
        W = w * (np.eye(3) - (1 - DEPTH_FRACTION**2) * rays * np.outer(ray[k], ray[k]))
        A2[s] += W
        b2[s] += W @ error
    np.testing.assert_allclose(A, A2, atol=1e-12)
    np.testing.assert_allclose(b, b2, atol=1e-12)


def test_anchors_pull_across_their_rays_and_hardly_along_them():
    _, _, graph = small_graph()
    still = (graph.nodes, np.tile(np.eye(3), (len(graph.nodes), 1, 1)))
    home = graph.samples[:1]

    def pulled(offset: np.ndarray, ray: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        A, b = np.zeros((len(graph.samples), 3, 3)), np.zeros((len(graph.samples), 3))
        known = Anchors((home + offset)[:, None], ray=None if ray is None else ray[None, None])
        AnchorPoints.of(graph, home, known, 0).add_to(A, b, graph, *still, 1.0, 100.0)
        return A.sum(axis=0), b.sum(axis=0)

    along = np.array([0.0, 0.6, 0.8])
    across = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(pulled(0.01 * across, along)[1], pulled(0.01 * across, None)[1], rtol=1e-6)
    matrix, pull = pulled(0.01 * along, along)
    np.testing.assert_allclose(pull, 0.01 * pulled(0.01 * along, None)[1], atol=1e-9)
    np.testing.assert_allclose(along @ matrix @ along, 0.01, rtol=1e-4)


def test_homes_are_where_points_came_from():
    _, _, g = small_graph()
    R = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    x, turns = g.nodes @ R.T + [0.3, 2.0, -1.0], np.tile(R, (len(g.nodes), 1, 1))
    points = np.vstack([g.samples[:20] @ R.T + [0.3, 2.0, -1.0], [[np.nan] * 3], [[9.0, 9, 9]]])
    homes = find_homes(g, x, turns, Anchors(points[:, None]), 0)
    np.testing.assert_allclose(homes[:20], g.samples[:20], atol=1e-9)
    assert np.isnan(homes[20:]).all()


def test_nodes_move_as_the_marks_around_them_and_others_stay():
    _, _, g = small_graph()
    R, shift = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([0.3, 2.0, -1.0])
    axis = int(np.ptp(g.nodes, axis=0).argmax())
    home = g.samples[g.samples[:, axis] < np.quantile(g.samples[:, axis], 0.25)]
    marks = AnchorPoints.of(g, home, Anchors((home @ R.T + shift)[:, None]), 0)
    still = g.nodes, np.tile(np.eye(3), (len(g.nodes), 1, 1))
    x, turns = marks.move(g, *still, 0.3, g.spacing)
    moved = (x != g.nodes).any(axis=1)
    amid = g.nodes[:, axis] < np.quantile(g.nodes[:, axis], 0.15)
    assert moved[amid].all() and not moved.all()
    np.testing.assert_allclose(x[amid], g.nodes[amid] @ R.T + shift, atol=0.02 * g.spacing)
    np.testing.assert_allclose(turns[amid], np.tile(R, (amid.sum(), 1, 1)), atol=0.05)
    np.testing.assert_array_equal(marks.move(g, x, turns, 0.3, 0.5 * g.spacing)[0], x)  # they are there already
    # marks that contradict each other move nothing, nor do those that only one camera saw
    torn = AnchorPoints.of(g, home, Anchors((home + np.where(np.arange(len(home)) % 2, 1, -1)[:, None])[:, None]), 0)
    alone = AnchorPoints.of(g, home, Anchors((home + shift)[:, None], ray=np.ones((len(home), 1, 3))), 0)
    for none in (torn, alone):
        np.testing.assert_array_equal(none.move(g, *still, 0.3, 0.0)[0], g.nodes)
