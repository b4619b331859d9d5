"""Which rigid part each node of a surface follows, and which parts there are, by what it costs to follow each of them.

Costs are fractions between 0 and 1 by which points miss a node that a part carries, (N, B); infinite where the
part is no candidate for the node.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geomocap.nodes.node_graph import NodeGraph

_TOGETHER = 0.025  # what it costs a node to be of another part than all its neighbours
_FAITHFUL = 0.01  # a node leaves its part only for one that suits it by so much better,
_AT_REST = 0.005  # and a part that rests for one that suits it by so much better than another would have to
_CLEAR = 0.1  # a node that costs so much more clearly is of another part
_CLEAR_NODES = 4  # a part stays if so many nodes clearly are not of the one beside it,
_MEAN_COST = 0.03  # or if all of them cost so much more on average,
_SHARED_COST = 0.005  # but must cost no more at all where they would go to several
_ALIKE = 0.05  # parts whose costs differ by less suit a node alike
_CONCAVE = 0.35  # turn of the normals towards each other across an edge that is a crease, as a sine
_FLAT = 0.5  # a round solid is flat if it is so high, relative to its width
_ROUND = 0.25  # how far the axis may be from its middle, relative to its radius
_LEAST = 6  # nodes of such a solid
_KNOWN = 0.1  # directions in which two parts' turns hold a point less, relative to the best known, hold it not at all


def choose_parts(label: np.ndarray, cost: np.ndarray, rests: np.ndarray, mean: csr_matrix) -> np.ndarray:
    """Let each node follow the part that suits it and its neighbours best; where all suit alike, it stays.

    Parameters
    ----------
    label : (N,) int
        Parts of the nodes so far.
    cost : (N, B) float
    rests : (B,) bool
        Parts that stay where they are.
    mean : (N, N) sparse
        Averages over neighbours, rows summing to 1.

    Returns
    -------
    (N,) int
    """
    one = np.eye(cost.shape[1])
    cost = cost - _FAITHFUL * one[label] - _AT_REST * rests
    for _ in range(3):
        label = (cost - _TOGETHER * (mean @ one[label])).argmin(axis=1)
    return label


def without_weakest(label: np.ndarray, cost: np.ndarray, beside: np.ndarray, rests: np.ndarray) -> np.ndarray | None:
    """Give the nodes of the weakest part to the parts beside it; None: every part is needed.

    A part is not needed if a neighbour's motion suits its nodes, or if those of several neighbours do without any loss:
    what was split because it slid in itself, as a round piece may, comes together again. A base that
    rests, the greatest of all parts, isn't given to what moves.

    Parameters
    ----------
    label : (N,) int
    cost : (N, B) float
    beside : (B, B) bool
        Parts that touch.
    rests : (B,) bool

    Returns
    -------
    (N,) int or None
    """
    B = cost.shape[1]
    own = cost[np.arange(len(label)), label]
    more = np.where(np.isfinite(cost), cost, 1.0) - own[:, None]
    of_part = np.eye(B)[label].T
    count = np.maximum(of_part.sum(axis=1), 1.0)
    base = rests & (count == count.max())
    fits = rests | ~base[:, None]
    usable = beside & ~np.eye(B, dtype=bool) & fits
    clear = np.where(usable, of_part @ (more > _CLEAR), np.inf)
    mean = np.where(usable, of_part @ more / count[:, None], np.inf)
    part, into = np.unravel_index(np.lexsort((mean.ravel(), clear.ravel()))[0], mean.shape)
    if clear[part, into] < _CLEAR_NODES and mean[part, into] <= _MEAN_COST:
        return np.where(label == part, into, label)
    more[np.arange(len(label)), label] = np.inf
    more[~usable[label]] = np.inf
    best = np.minimum(more.min(axis=1), 1.0)
    mean_best = np.where(of_part @ (best > _CLEAR) < _CLEAR_NODES, of_part @ best / count, np.inf)
    part = mean_best.argmin()
    return np.where(label == part, more.argmin(axis=1), label) if mean_best[part] <= _SHARED_COST else None


def follow_bearings(
    label: np.ndarray, cost: np.ndarray, R: np.ndarray, t: np.ndarray, rests: np.ndarray, graph: NodeGraph
) -> np.ndarray:
    """Let flat round solids turn with what stands on them, as turntables and wheels do.

    Of a solid that is round about the axis of two parts' turn against each other, the points don't say which of the two
    it belongs to. A shaft may well stand still below what turns; a disc is there in order to turn. A solid ends at
    creases: nodes that both parts suit are split where the surface is concave.

    Parameters
    ----------
    label : (N,) int
    cost : (N, B) float
        Of the parts that touch a node's own part.
    R, t : (B, T, 3, 3), (B, T, 3) float, metres
        Motions of the parts.
    rests : (B,) bool
    graph : NodeGraph

    Returns
    -------
    (N,) int
    """
    label, B = label.copy(), cost.shape[1]
    N = len(label)
    i, j = graph.edges.T
    normals = graph.normals[cKDTree(graph.samples).query(graph.nodes)[1]]
    along = graph.nodes[j] - graph.nodes[i]
    smooth = ((normals[j] - normals[i]) * along).sum(axis=1) > -_CONCAVE * graph.lengths
    solid = csr_matrix(coo_matrix((np.ones(int(smooth.sum())), (i[smooth], j[smooth])), (N, N)))
    beside = touching(label, graph.edges, B)
    size = np.bincount(label, minlength=B)
    # the greatest first; what rests is the greatest
    order = np.lexsort((size, rests))[::-1]
    for rank, ground in enumerate(order):
        for mover in order[rank + 1 :]:
            if not beside[ground, mover]:
                continue
            known = np.isin(label, (ground, mover)) & np.isfinite(cost[:, [ground, mover]]).all(axis=1)
            alike = known.copy()
            alike[known] = np.abs(cost[known, ground] - cost[known, mover]) < _ALIKE
            on_top = ~alike & (label == mover)
            if not alike.any() or not on_top.any():
                continue
            touched = np.zeros(N, bool)
            touched[i[on_top[j]]] = touched[j[on_top[i]]] = True
            axis = _axis(R[ground].swapaxes(1, 2) @ R[mover])
            center = _common_point(R, t, ground, mover, graph.nodes[on_top].mean(axis=0))
            rows = np.flatnonzero(alike)
            piece = connected_components(solid[rows][:, rows], directed=False)[1]
            for k in np.unique(piece[touched[rows]]):
                nodes = rows[piece == k]
                if len(nodes) >= _LEAST and _is_flat_and_round(graph.nodes[nodes], center, axis):
                    label[nodes] = mover
    return label


def touching(label: np.ndarray, edges: np.ndarray, count: int) -> np.ndarray:
    """Which of `count` parts have neighbouring nodes, (B, B) bool, each part touching itself."""
    beside = np.eye(count, dtype=bool)
    i, j = label[edges].T
    beside[i, j] = beside[j, i] = True
    return beside


def _axis(turns: np.ndarray) -> np.ndarray:
    """Unit vector about which rotations (T, 3, 3) turn most, least squares."""
    w = np.stack([turns[:, 2, 1] - turns[:, 1, 2], turns[:, 0, 2] - turns[:, 2, 0], turns[:, 1, 0] - turns[:, 0, 1]], 1)
    return np.linalg.eigh(w.T @ w)[1][:, 2]


def _common_point(R: np.ndarray, t: np.ndarray, first: int, second: int, near: np.ndarray) -> np.ndarray:
    """Point (3,), metres, in the reference that both parts carry to the same places, as `near` as the motions allow."""
    apart = (R[first] - R[second]).reshape(-1, 3)
    miss = (apart.reshape(-1, 3, 3) @ near).ravel() + (t[first] - t[second]).ravel()
    return near - np.linalg.lstsq(apart, miss, rcond=_KNOWN)[0]


def _is_flat_and_round(points: np.ndarray, center: np.ndarray, axis: np.ndarray) -> bool:
    """Whether points (n, 3) are wider than high about an axis through a point, and have it in their middle."""
    height = (points - center) @ axis
    away = points - center - height[:, None] * axis
    radius = max(float(np.linalg.norm(away, axis=1).max()), 1e-12)
    middle = 0.5 * (away.min(axis=0) + away.max(axis=0))
    return bool(np.ptp(height) < _FLAT * 2 * radius and np.linalg.norm(middle) < _ROUND * radius)
