"""Which part each node follows, which parts are needed, and what flat round solids turn with."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.nodes.node_graph import NodeGraph
from geomocap.nodes.part_selection import choose_parts, follow_bearings, touching, without_weakest

ALL_BESIDE = np.ones((3, 3), bool)
NONE_REST = np.zeros(3, bool)


def chain(count: int) -> csr_matrix:
    """Averages over the neighbours in a row of nodes."""
    near = np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)
    return csr_matrix(near / near.sum(axis=1, keepdims=True))


def test_nodes_follow_what_suits_them_and_stay_where_all_suits():
    cost = np.full((12, 2), 0.2)
    cost[:4, 1] = 0.5
    label = np.repeat([1, 0, 1], [4, 4, 4])
    chosen = choose_parts(label, cost, np.zeros(2, bool), chain(12))
    np.testing.assert_array_equal(chosen, np.repeat([0, 1], [8, 4]))


def test_a_node_goes_with_its_neighbours_unless_it_costs_much():
    cost = np.full((9, 2), 0.2)
    cost[4] = 0.195, 0.2
    label = np.repeat([0, 1, 0], [4, 1, 4])
    assert not choose_parts(label, cost, np.zeros(2, bool), chain(9)).any()
    cost[4, 0] = 0.4
    np.testing.assert_array_equal(choose_parts(label, cost, np.zeros(2, bool), chain(9)), label)


def test_a_part_goes_where_another_motion_suits_all_of_it():
    label = np.repeat([0, 1, 2], 10)
    cost = np.where(np.eye(3, dtype=bool)[label], 0.2, 0.6)
    assert without_weakest(label, cost, ALL_BESIDE, NONE_REST) is None
    cost[label == 2, 1] = 0.21
    np.testing.assert_array_equal(without_weakest(label, cost, ALL_BESIDE, NONE_REST), np.repeat([0, 1], [10, 20]))
    cost[25:, 1] = 0.35  # a few of its nodes know better
    assert without_weakest(label, cost, ALL_BESIDE, NONE_REST) is None


def test_a_part_goes_to_several_only_without_loss():
    label = np.repeat([0, 1, 2], 10)
    cost = np.where(np.eye(3, dtype=bool)[label], 0.2, 0.6)
    cost[20:25, 0] = cost[25:, 1] = 0.2
    np.testing.assert_array_equal(
        without_weakest(label, cost, ALL_BESIDE, NONE_REST), np.repeat([0, 1, 0, 1], [10, 10, 5, 5])
    )
    cost[20:25, 0] = 0.22
    assert without_weakest(label, cost, ALL_BESIDE, NONE_REST) is None


def test_a_base_that_rests_is_not_given_to_what_moves():
    label = np.repeat([0, 1, 2], 10)
    cost = np.where(np.eye(3, dtype=bool)[label], 0.2, 0.6)
    cost[label == 2, 1] = 0.2
    assert without_weakest(label, cost, ALL_BESIDE, np.array([True, False, True])) is None
    assert without_weakest(label, cost, ALL_BESIDE, np.array([True, True, True])) is not None
    assert without_weakest(label[:26], cost[:26], ALL_BESIDE, np.array([False, False, True])) is not None


def test_a_part_that_does_not_touch_is_no_candidate():
    label = np.repeat([0, 1, 2], 10)
    cost = np.where(np.eye(3, dtype=bool)[label], 0.2, 0.6)
    cost[label == 2, 0] = 0.2
    beside = touching(label, np.array([[0, 10], [10, 20]]), 3)
    assert without_weakest(label, cost, beside, NONE_REST) is None


def tower(height: float) -> tuple[NodeGraph, np.ndarray]:
    """A plate, a round solid of radius 0.2 on it, and a narrower box on top; which of the three each node is of."""
    u = np.linspace(-0.5, 0.5, 21)
    x, y = (a.ravel() for a in np.meshgrid(u, u))
    outside, inside = np.hypot(x, y) > 0.21, (np.hypot(x, y) < 0.19) & (np.maximum(abs(x), abs(y)) > 0.11)
    a = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    z = np.linspace(0.02, height - 0.02, max(3, round(height / 0.05)))
    angle, level = (b.ravel() for b in np.meshgrid(a, z))
    wall = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), level], axis=1)
    side = [(s * 0.1, v, w) for s in (-1, 1) for v in u[abs(u) < 0.11] for w in np.arange(0.03, 0.3, 0.05)]
    box = np.array([*side, *((v, s, w) for s, v, w in side)])
    box[:, 2] += height
    pieces = [
        (np.stack([x, y, 0 * x], axis=1)[outside], (0, 0, 1)),
        (np.stack([x, y, 0 * x + height], axis=1)[inside], (0, 0, 1)),
        (wall, wall * [5, 5, 0]),
        (box, np.where(abs(box[:, :1]) > 0.099, [[1, 0, 0]], [[0, 1, 0]]) * np.sign(box * [1, 1, 0])),
    ]
    nodes = np.concatenate([p for p, _ in pieces])
    normals = np.concatenate([np.broadcast_to(n, p.shape) for p, n in pieces])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    solid = np.repeat([0, 1, 1, 2], [len(p) for p, _ in pieces])
    edges = np.array(sorted(cKDTree(nodes).query_pairs(0.08)))
    lengths = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    none = np.zeros((len(nodes), 0))
    own = np.arange(len(nodes))[:, None]
    return NodeGraph(nodes, 0.05, edges, lengths, nodes, normals, none, own, np.ones((len(nodes), 1))), solid


@pytest.mark.parametrize(("height", "turns"), [(0.12, True), (0.6, False)])
def test_a_disc_turns_with_what_stands_on_it_and_a_column_does_not(height, turns):
    graph, solid = tower(height)
    cost = np.where(solid[:, None] == [0, 2], 0.2, 0.6)
    cost[solid == 1] = 0.2  # round: both suit it
    R = np.tile(np.eye(3), (2, 5, 1, 1))
    R[1] = Rotation.from_rotvec(np.outer(np.linspace(0, 1, 5), [0, 0, 1])).as_matrix()
    rests, boxes = np.array([True, False]), (solid == 2).astype(int)
    label = follow_bearings(boxes, cost, R, np.zeros((2, 5, 3)), rests, graph)
    np.testing.assert_array_equal(label[solid != 1], solid[solid != 1] // 2)
    assert (label[solid == 1] == int(turns)).mean() > 0.95
    # about an axis at its rim, it is no bearing
    rim = np.array([0.19, 0.0, 0.0])
    np.testing.assert_array_equal(follow_bearings(boxes, cost, R, rim - R @ rim, rests, graph), boxes)
