"""How unsure nodes are that anchors hold."""

from __future__ import annotations

import numpy as np

from geomocap.model.motion_paths import MotionPaths
from geomocap.nodes.node_uncertainty import carried_sigma, with_departure

FRAMES = 3


def _anchors() -> MotionPaths:
    """Two anchors 1 m apart: the first precise and always there, the second in the first frame only."""
    positions = np.zeros((2, FRAMES, 3))
    positions[1, :, 0] = 1.0
    positions[1, 1:] = np.nan
    return MotionPaths(positions, sigma=np.array([0.001, 0.003]))


def test_nodes_are_as_precise_as_the_anchor_they_lie_on():
    nodes = np.zeros((2, FRAMES, 3))
    nodes[1, :, 0] = 1.0
    sigma = carried_sigma(nodes, _anchors())
    np.testing.assert_allclose(sigma[0], 0.001)
    np.testing.assert_allclose(sigma[1, 0], 0.003)


def test_a_node_is_less_sure_where_the_anchor_beside_it_is_not_seen():
    nodes = np.tile([0.9, 0.0, 0.0], (1, FRAMES, 1))
    sigma = carried_sigma(nodes, _anchors())[0]
    assert sigma[1] == sigma[2]
    assert 8.5 < np.sqrt(sigma[1] ** 2 - 0.001**2) / np.sqrt(sigma[0] ** 2 - 0.003**2) < 9.5  # 0.9 m, 0.1 m


def test_nothing_is_said_of_lost_nodes_and_of_frames_without_anchors():
    nodes = np.zeros((2, FRAMES, 3))
    nodes[1, 2] = np.nan
    anchors = MotionPaths(np.full((1, FRAMES, 3), [[[0.1, 0, 0]] * 2 + [[np.nan] * 3]]), sigma=np.array([0.001]))
    sigma = carried_sigma(nodes, anchors)
    assert np.isfinite(sigma[:, :2]).all()
    assert np.isnan(sigma[:, 2]).all()


def test_precision_of_each_frame_counts():
    nodes = np.zeros((1, FRAMES, 3))
    sigma = np.array([[0.001, 0.002, 0.004]])
    np.testing.assert_allclose(carried_sigma(nodes, MotionPaths(np.zeros((1, FRAMES, 3)), sigma=sigma)), sigma)


def test_nodes_that_went_astray_are_less_sure():
    sigma = np.full((2, FRAMES), 0.003)
    departure = np.zeros((2, FRAMES))
    departure[1, 2] = 0.1
    found = with_departure(sigma, departure, 0.02)
    np.testing.assert_allclose(found[0], found[0, 0])
    np.testing.assert_allclose(found[1, :2], found[0, 0])
    assert 0.02 < found[1, 2] < 0.1
    assert found[0, 0] > sigma[0, 0]  # no node is as precise as a patch
