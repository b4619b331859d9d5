"""Edges of a node graph learn how firm they are from a motion."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.nodes.edge_stiffness import learned_stiffness
from geomocap.nodes.node_graph import NodeGraph
from tests.geomocap.capsules import small_graph

ANGLES = np.linspace(0, 1.2, 7)


def bent(graph: NodeGraph, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes with all beyond the middle turned about it, as two bones at a hinge."""
    middle = np.median(graph.nodes[:, 0])
    beyond = graph.nodes[:, 0] > middle
    turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    hinge = np.array([middle, 0, 0])
    x = np.where(beyond[:, None], (graph.nodes - hinge) @ turn.T + hinge, graph.nodes)
    return x, np.where(beyond[:, None, None], turn, np.eye(3))


def test_edges_across_a_joint_are_softer_than_those_within_bones():
    _, _, graph = small_graph()
    states = [bent(graph, angle) for angle in ANGLES]
    firm = learned_stiffness(graph, states)
    beyond = graph.nodes[:, 0] > np.median(graph.nodes[:, 0])
    across = beyond[graph.edges[:, 0]] != beyond[graph.edges[:, 1]]
    assert across.any()
    assert np.median(firm[across]) < 0.3 * np.median(firm[~across])


def test_edges_that_strain_alike_are_alike():
    _, _, graph = small_graph()
    states = [(graph.nodes, np.tile(np.eye(3), (len(graph.nodes), 1, 1)))] * 3
    np.testing.assert_allclose(learned_stiffness(graph, states), 1.0)


def test_one_frame_astray_teaches_nothing():
    _, _, graph = small_graph()
    states = [bent(graph, angle) for angle in ANGLES]
    firm = learned_stiffness(graph, states)
    astray = states[3][0].copy()
    astray[::3] += 5.0
    states.append((astray, states[3][1]))
    assert np.abs(np.log(learned_stiffness(graph, states) / firm)).max() < np.log(3)  # weights may differ 33-fold


def test_a_node_departs_by_as_much_as_its_neighbours_say():
    _, _, graph = small_graph()
    x, R = graph.nodes.copy(), np.tile(np.eye(3), (len(graph.nodes), 1, 1))
    assert graph.departure(x, R).max() < 1e-12
    x[0] += [0.0, 0.07, 0.0]
    found = graph.departure(x, R)
    np.testing.assert_allclose(found[0], 0.07)
    beside = np.unique(graph.edges[(graph.edges == 0).any(axis=1)])
    assert (found[np.setdiff1d(np.arange(len(x)), beside)] < 1e-12).all()
    assert (found[np.setdiff1d(beside, [0])] < 0.07).all()
