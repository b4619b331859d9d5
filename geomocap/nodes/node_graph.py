"""The deformation graph: nodes spread over a reference surface, their neighbours, and the samples that they carry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError
from geomocap.model.fused import turned
from geomocap.nodes.surface_points import PointSet

_LEAST_LENGTH = 1e-12  # of a blend of normals


@dataclass(frozen=True)
class NodeGraph:
    """Nodes of a reference surface and what hangs on them.

    Attributes
    ----------
    nodes : (N, 3) float, metres, world
        Positions in the reference frame.
    spacing : float
        Mean distance of neighbouring nodes, metres.
    edges : (E, 2) int
        Pairs of neighbouring nodes, first < second.
    lengths : (E,) float
        Distance of the pairs in the reference frame, metres.
    samples : (S, 3) float, metres
        Surface samples in the reference frame.
    normals : (S, 3) float
    features : (S, F) float
    binding : (S, K) int
        Nodes that carry each sample.
    weights : (S, K) float
        Their fractions, each row sums to 1.
    """

    nodes: np.ndarray
    spacing: float
    edges: np.ndarray
    lengths: np.ndarray
    samples: np.ndarray
    normals: np.ndarray
    features: np.ndarray
    binding: np.ndarray
    weights: np.ndarray

    @cached_property
    def offsets(self) -> np.ndarray:
        """Samples relative to their nodes in the reference frame, (S, K, 3), metres."""
        return self.samples[:, None] - self.nodes[self.binding]

    def deform(self, x: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Samples and their normals with nodes at x (N, 3) turned by R (N, 3, 3): (S, 3), (S, 3).

        Source: R. Sumner et al., "Embedded deformation for shape manipulation", SIGGRAPH 2007, equation 2.
        """
        places, normals = np.empty_like(self.samples), np.empty_like(self.normals)
        deform(x, R, self.binding, self.weights, self.offsets, self.normals, places, normals)
        return places, normals

    def strain(self, x: np.ndarray, R: np.ndarray) -> np.ndarray:
        """How far each edge is from moving rigidly with its two nodes, (E,), as a fraction of its length."""
        found = np.empty(len(self.edges))
        strains(x, R, self.nodes, self.edges, self.lengths, found)
        return found

    def mean_of_edges(self, values: np.ndarray) -> np.ndarray:
        """Mean of the values (E,) of each node's edges, (N,); 0 without any."""
        N = len(self.nodes)
        ends = self.edges.ravel()
        return np.bincount(ends, np.repeat(values, 2), N) / np.maximum(np.bincount(ends, minlength=N), 1)

    def departure(self, x: np.ndarray, R: np.ndarray) -> np.ndarray:
        """Distance of each node from where its neighbours would rigidly have it, root mean square, (N,), metres."""
        return np.sqrt(self.mean_of_edges((self.strain(x, R) * self.lengths) ** 2))


@njit(cache=True, nogil=True, error_model="numpy")
def deform(x, R, binding, weights, offsets, normals, places, turned):
    """Fill the places (S, 3) of samples and their turned normals (S, 3), see `NodeGraph.deform`."""
    blend = np.empty((3, 3))
    for s in range(len(binding)):
        blend[:] = 0.0
        places[s] = 0.0
        for k in range(binding.shape[1]):
            i, w = binding[s, k], weights[s, k]
            o0, o1, o2 = offsets[s, k, 0], offsets[s, k, 1], offsets[s, k, 2]
            for m in range(3):
                places[s, m] += w * (x[i, m] + R[i, m, 0] * o0 + R[i, m, 1] * o1 + R[i, m, 2] * o2)
                for n in range(3):
                    blend[m, n] += w * R[i, m, n]
        n0, n1, n2 = normals[s, 0], normals[s, 1], normals[s, 2]
        square = 0.0
        for m in range(3):
            turned[s, m] = blend[m, 0] * n0 + blend[m, 1] * n1 + blend[m, 2] * n2
            square += turned[s, m] ** 2
        length = max(math.sqrt(square), _LEAST_LENGTH)
        for m in range(3):
            turned[s, m] /= length


@njit(cache=True, nogil=True, error_model="numpy")
def strains(x, R, nodes, edges, lengths, found):
    """Fill the strain (E,) of edges, see `NodeGraph.strain`."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        d0, d1, d2 = nodes[i, 0] - nodes[j, 0], nodes[i, 1] - nodes[j, 1], nodes[i, 2] - nodes[j, 2]
        of_i, of_j = 0.0, 0.0
        for m in range(3):
            edge = x[i, m] - x[j, m]
            of_i += (edge - turned(R[i], m, d0, d1, d2)) ** 2
            of_j += (edge - turned(R[j], m, d0, d1, d2)) ** 2
        found[e] = math.sqrt((of_i + of_j) / 2) / lengths[e]


def farthest_points(positions: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` points, each the farthest from those before it; any first part of them is evenly spread too.

    Distances are Euclidean; the first point is the one farthest from the centre.
    """
    first = int(np.linalg.norm(positions - positions.mean(axis=0), axis=1).argmax())
    chosen = np.empty(min(count, len(positions)), int)
    chosen[0] = first
    distance = ((positions - positions[first]) ** 2).sum(axis=1)
    for k in range(1, len(chosen)):
        chosen[k] = int(distance.argmax())
        distance = np.minimum(distance, ((positions - positions[chosen[k]]) ** 2).sum(axis=1))
    return chosen


def node_graph(
    surface: PointSet, graph: csr_matrix, chosen: np.ndarray, n_samples: int, carriers: int = 4
) -> NodeGraph:
    """Hang samples of a surface on nodes chosen among its points, by distance along the surface.

    Parameters
    ----------
    surface : PointSet
    graph : (M, M) sparse
        From `surface_graph`.
    chosen : (N,) int
        Points that become nodes.
    n_samples : int
    carriers : int
        Nodes that carry a sample.

    Raises
    ------
    GeometryError
        If there are too few points for a graph.
    """
    N = len(chosen)
    if carriers + 2 > N:
        raise GeometryError(f"a surface of {len(surface)} points is too small to be tracked; give more points")
    positions = surface.positions
    area_spacing = np.sqrt(_area(positions, chosen))
    distance = dijkstra(graph, directed=False, indices=chosen, limit=5.0 * area_spacing)
    # points that no node reaches along the surface hang on the nearest nodes through space
    lost = ~np.isfinite(distance).any(axis=0)
    if lost.any():
        through = np.linalg.norm(positions[chosen][:, None] - positions[lost][None], axis=-1)
        distance[:, lost] = through
    kept = np.arange(len(positions)) if len(positions) <= n_samples else _spread(len(positions), n_samples)
    kept = np.union1d(kept, chosen)
    to_samples = distance[:, kept].T
    binding = np.argsort(to_samples, axis=1, kind="stable")[:, : carriers + 1]
    near = np.take_along_axis(to_samples, binding, axis=1)
    # the next node's distance is where the weights end (Sumner et al., equation 4)
    reach = np.where(np.isfinite(near[:, -1]), near[:, -1], 1.5 * area_spacing)[:, None] + 1e-9
    weights = np.where(np.isfinite(near[:, :-1]), (1 - np.minimum(near[:, :-1] / reach, 1)) ** 2 + 1e-9, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    edges = _edges(distance[:, chosen], binding[:, :-1], weights)
    lengths = np.linalg.norm(positions[chosen[edges[:, 0]]] - positions[chosen[edges[:, 1]]], axis=1)
    return NodeGraph(
        positions[chosen],
        float(np.median(lengths)),
        edges,
        lengths,
        positions[kept],
        surface.normals[kept],
        surface.features[kept],
        binding[:, :-1],
        weights,
    )


def largest_parts(graph: csr_matrix, fraction: float) -> np.ndarray:
    """Points in parts of the surface that hold at least a fraction of all points, (M,) bool."""
    _, part = connected_components(graph, directed=False)
    size = np.bincount(part)
    return size[part] >= max(fraction * len(part), 4)


def _area(positions: np.ndarray, chosen: np.ndarray) -> float:
    """Surface that one node stands for: the squared mean distance of the nodes' nearest neighbours, m²."""
    return float(np.mean(cKDTree(positions[chosen]).query(positions[chosen], 2)[0][:, 1] ** 2)) * 1.2


def _spread(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, wanted).astype(int))


def _edges(between: np.ndarray, binding: np.ndarray, weights: np.ndarray, neighbours: int = 7) -> np.ndarray:
    """Pairs of nodes near each other along the surface, and all pairs that share a sample."""
    N = len(between)
    order = np.argsort(between, axis=1, kind="stable")[:, 1 : neighbours + 1]
    i = np.repeat(np.arange(N), order.shape[1])
    j = order.ravel()
    reached = np.isfinite(between[i, j])
    pairs = [np.column_stack([i[reached], j[reached]])]
    K = binding.shape[1]
    for a in range(K):
        for b in range(a + 1, K):
            both = (weights[:, a] > 0) & (weights[:, b] > 0)
            pairs.append(binding[both][:, [a, b]])
    edges = np.sort(np.concatenate(pairs), axis=1)
    return np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0)
