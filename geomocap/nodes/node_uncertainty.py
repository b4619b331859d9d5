"""How well the points of a frame hold each node, direction by direction."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from geomocap.model.motion_paths import MotionPaths
from geomocap.nodes.node_graph import NodeGraph

# Standard deviation of a coordinate, fraction of the distance from the nearest anchor.
_SWAY = 0.05
# The same, fraction of the distance from where the neighbours would have a node; and the least, node spacings. All
# three were chosen by the likelihood of the nodes' distances from where their bone has them, at most five standard
# deviations, on a galloping stag and a trotting and a galloping horse. Its logarithm, in each frame, with 0.1 of the
# distance from the anchor alone → these (and firmer edges): stag 12.4 → 13.0, trotting horse 11.5 → 12.3. Nodes that
# are 60 mm and more astray have a larger one than others with probability 0.62 → 0.89 and 0.60 → 0.84. A fan in small
# images comes in a body too many as often (3 and 4 of 18: three captures, six choices of the paths).
_STRAYED = 0.3
_LEAST = 0.05


def patch_mean(graph: NodeGraph, rounds: int = 2) -> csr_matrix:
    """Matrix (N, S) that averages what samples know over the patch around each node, rows summing to 1.

    A sample counts for the nodes that carry it, and then for their neighbours, `rounds` edges far.
    """
    N, (S, K) = len(graph.nodes), graph.binding.shape
    own = coo_matrix((graph.weights.ravel(), (graph.binding.ravel(), np.repeat(np.arange(S), K))), (N, S)).tocsr()
    i, j = graph.edges.T
    ones = np.ones(len(i))
    near = coo_matrix((ones, (i, j)), (N, N)).tocsr()
    near = near + near.T + coo_matrix((np.ones(N), (np.arange(N), np.arange(N))), (N, N)).tocsr()
    mean = own
    for _ in range(rounds):
        mean = near @ mean
    total = np.asarray(mean.sum(axis=1)).ravel()
    return csr_matrix(coo_matrix((1 / np.maximum(total, 1e-12), (np.arange(N), np.arange(N))), (N, N)) @ mean)


def node_covariance(
    mean: csr_matrix,
    normals: np.ndarray,
    weight: np.ndarray,
    across: np.ndarray,
    slide: float,
    floor: float,
    anchored: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of each node's position (N, 3, 3), m², and the support of its patch (N,), 0 to 1.

    A patch is held along its normals: a plane in one direction, a limb in two, an end of a limb in all three. What is
    left is free to slide, with standard deviation `slide`.

    Parameters
    ----------
    mean : (N, S) sparse
        From `patch_mean`.
    normals : (S, 3) float
        Of the samples as they lie in the frame.
    weight : (S,) float
        How well points support each sample, 0 to 1.
    across : (S,) float
        Distance of each sample to the plane of its point, metres.
    slide, floor : float
        Standard deviation of an unseen sliding, and the least of any direction, metres.
    anchored : (S,) float, optional
        Number of anchors at each sample; they hold it in all directions.
    """
    support = mean @ weight
    held = mean @ (weight[:, None] * (normals[:, :, None] * normals[:, None, :]).reshape(-1, 9))
    variance = (mean @ (weight * across**2)) / np.maximum(support, 1e-6) + floor**2
    information = held.reshape(-1, 3, 3) / variance[:, None, None] + np.eye(3) / slide**2
    if anchored is not None:
        information += (mean @ anchored / variance)[:, None, None] * np.eye(3)
    return np.linalg.inv(information), support


def carried_sigma(nodes: np.ndarray, anchors: MotionPaths) -> np.ndarray:
    """Standard deviation of nodes that anchors hold, frame by frame, (N, T) float, metres; NaN without anchors.

    What is carried along by the surface between it and the nearest anchor errs by that one's noise and by a turn that
    nobody measured, the more so the farther it is away.

    Parameters
    ----------
    nodes : (N, T, 3) float, metres
        NaN where lost.
    anchors : MotionPaths
        With `sigma`.
    """
    assert anchors.sigma is not None
    noise = np.broadcast_to(anchors.sigma.reshape(anchors.count, -1), anchors.seen.shape)
    found = np.full(nodes.shape[:2], np.nan)
    for k in range(nodes.shape[1]):
        held, there = np.flatnonzero(anchors.seen[:, k]), np.flatnonzero(np.isfinite(nodes[:, k, 0]))
        if len(held) and len(there):
            away, nearest = cKDTree(anchors.positions[held, k]).query(nodes[there, k])
            found[there, k] = np.hypot(noise[held[nearest], k], _SWAY * away)
    return found


def with_departure(sigma: np.ndarray, departure: np.ndarray, spacing: float) -> np.ndarray:
    """Add to standard deviations (N, T) how far nodes are from where their neighbours would have them: (N, T), metres.

    A surface bends and hardly stretches: a node that is far from there went astray, or its neighbours did.

    Parameters
    ----------
    sigma, departure : (N, T) float, metres
    spacing : float, metres
        Of the nodes.
    """
    return np.asarray(np.sqrt(sigma**2 + (_STRAYED * departure) ** 2 + (_LEAST * spacing) ** 2))
