"""Point sets of a surface: normals turned outwards, thinning, and the graph along which distances are geodesic."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csr_matrix, triu
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError
from geomocap.model.surface import plane_normals

_ROUNDS = 10  # in which votes on the side of normals spread to neighbours


@dataclass(frozen=True)
class PointSet:
    """Points of one frame's surface.

    Attributes
    ----------
    positions : (M, 3) float, metres, world
    normals : (M, 3) float
        Unit normals, outwards.
    features : (M, F) float
        What else is known of each point, such as its colour; F may be 0.
    gradients : (M, F, 3) float
        How the features change along the surface, per metre.
    """

    positions: np.ndarray
    normals: np.ndarray
    features: np.ndarray
    gradients: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def at(self, kept: np.ndarray) -> PointSet:
        """Return the points at some indices."""
        return PointSet(self.positions[kept], self.normals[kept], self.features[kept], self.gradients[kept])

    def every(self, step: int) -> PointSet:
        """Return one point in `step`."""
        return self.at(np.arange(0, len(self), step))

    def turned_like(self, surface: np.ndarray, normals: np.ndarray, scale: float) -> PointSet:
        """Turn normals to the side that a known surface near them has.

        Each point is voted on by the sample next to it; votes then spread to neighbours whose normals are parallel, so
        that what is far from the known surface follows what is near, and faces that meet at an edge decide alone.

        Parameters
        ----------
        surface, normals : (S, 3) float
            Samples of the known surface, metres, and their normals.
        scale : float
            Distance at which a sample loses its vote, metres.
        """
        distance, nearest = cKDTree(surface).query(self.positions)
        own = np.exp(-0.5 * (distance / scale) ** 2) * (self.normals * normals[nearest]).sum(axis=1)
        parallel, total = self._beside
        vote = own
        for _ in range(_ROUNDS):
            vote = own + 0.95 * (parallel @ vote) / total
        return replace(self, normals=np.where((vote < 0)[:, None], -self.normals, self.normals))

    @cached_property
    def _beside(self) -> tuple[csr_matrix, np.ndarray]:
        """Cosines between the normals of neighbouring points, where these are parallel, (M, M); their sums, (M,)."""
        i, j = _pairs(self.positions, min(8, len(self) - 1))
        cosine = (self.normals[i] * self.normals[j]).sum(axis=1)
        parallel = csr_matrix((np.where(np.abs(cosine) > 0.6, cosine, 0.0), (i, j)), (len(self), len(self)))
        parallel = parallel + parallel.T
        return parallel, np.maximum(np.asarray(np.abs(parallel).sum(axis=1)).ravel(), 1e-9)

    def thinned(self, count: int, seed: int) -> PointSet:
        """Return at most `count` points, drawn at random."""
        if len(self) <= count:
            return self
        return self.at(np.sort(np.random.default_rng(seed).permutation(len(self))[:count]))


def point_set(
    points: np.ndarray,
    n_points: int,
    neighbours: int,
    seed: int = 0,
    features: np.ndarray | None = None,
    normals: np.ndarray | None = None,
) -> PointSet:
    """Make a point set of at most `n_points`, normals and gradients measured on all points; coincident ones are one.

    Parameters
    ----------
    points : (M, 3) float, metres
    n_points : int
        Points to keep, drawn at random.
    neighbours : int
        Neighbours that make a normal.
    seed : int
    features : (M, F) float, optional
    normals : (M, 3) float, optional
        Outward unit normals, where they are known better than from the points' planes, which leave the side open; 0
        where they are not.

    Raises
    ------
    GeometryError
        If there are fewer distinct points than a normal needs.
    """
    points = np.ascontiguousarray(points, float)
    if features is None:
        features = np.zeros((len(points), 0))
    chosen = np.arange(len(points))
    if len(points) > 3 * n_points:
        chosen = np.sort(np.random.default_rng(seed).permutation(len(points))[: 3 * n_points])
    chosen = chosen[np.sort(np.unique(points[chosen], axis=0, return_index=True)[1])]
    if len(chosen) <= neighbours:
        raise GeometryError(
            f"a surface of {len(chosen)} distinct points has no normals; more than {neighbours} are needed"
        )
    points, features = points[chosen], features[chosen]
    near = cKDTree(points).query(points, neighbours + 1)[1]
    if normals is None:
        outward = oriented_normals(points, near)
    else:
        outward = np.array(normals, float)[chosen]
        unknown = ~outward.any(axis=1)
        outward[unknown] = plane_normals(points, near[unknown])
    gradients = feature_gradients(points, outward, near, features)
    return PointSet(points, outward, np.asarray(features, float), gradients).thinned(n_points, seed)


def oriented_normals(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Normals of planes, oriented along a minimum spanning tree and then outwards: open surfaces keep one side.

    Source: H. Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992, sections 3.2 and 3.3.

    Parameters
    ----------
    points : (M, 3) float, metres
    near : (M, k) int
        Each point's nearest points, itself first.

    Returns
    -------
    (M, 3) float
    """
    normals = plane_normals(points, near)
    M, k = near.shape
    i, j = np.repeat(np.arange(M), k - 1), near[:, 1:].ravel()
    cost = 1 - np.abs((normals[i] * normals[j]).sum(axis=1)) + 1e-6
    graph = csr_matrix((cost, (i, j)), (M, M))
    tree = minimum_spanning_tree(triu(graph.maximum(graph.T)))  # each edge once: half of what has to be sorted
    tree = tree + tree.T
    n_parts, part = connected_components(tree, directed=False)
    for first in np.unique(part, return_index=True)[1][:n_parts]:
        members, parent = breadth_first_order(tree, first, directed=False)
        _follow(normals, members, parent)
        # the volume that a closed surface encloses is positive where normals point outwards
        outward = ((points[members] - points[members].mean(axis=0)) * normals[members]).sum()
        if outward < 0:
            normals[members] *= -1
    return normals


def _follow(normals: np.ndarray, order: np.ndarray, parent: np.ndarray) -> None:
    """Turn each normal to its parent's side, in the order of the tree; in place."""
    sign = np.ones(len(normals))
    agree = np.where((normals[order[1:]] * normals[parent[order[1:]]]).sum(axis=1) < 0, -1.0, 1.0)
    for child, s in zip(order[1:].tolist(), agree.tolist(), strict=True):
        sign[child] = sign[parent[child]] * s
    normals[order] *= sign[order, None]


def feature_gradients(points: np.ndarray, normals: np.ndarray, near: np.ndarray, features: np.ndarray) -> np.ndarray:
    """Gradients of features in the tangent plane by least squares, (M, F, 3), per metre.

    Source: J. Park, Q.-Y. Zhou, V. Koltun, "Colored point cloud registration revisited", ICCV 2017, section 4.1.
    """
    if features.shape[1] == 0:
        return np.zeros((len(points), 0, 3))
    A, right = _tangent_sums(points, normals, near, np.ascontiguousarray(features, float))
    scale = np.trace(A, axis1=1, axis2=2)[:, None, None]
    # the normal direction is held at zero
    A += scale * (normals[:, :, None] * normals[:, None] + 1e-3 * np.eye(3))
    return np.linalg.solve(A, right).transpose(0, 2, 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _tangent_sums(points, normals, near, features):
    """Normal equations of features (M, F) on the tangent plane of each point: (M, 3, 3) and (M, 3, F).

    Sums over the neighbours `near` (M, k), of offsets without their part along the normal (M, 3).
    """
    count, k = near.shape
    F = features.shape[1]
    A, right = np.zeros((count, 3, 3)), np.zeros((count, 3, F))
    offset = np.empty(3)
    for m in range(count):
        for i in range(k):
            other = near[m, i]
            along = 0.0
            for d in range(3):
                offset[d] = points[other, d] - points[m, d]
                along += offset[d] * normals[m, d]
            for d in range(3):
                offset[d] -= along * normals[m, d]
            for d in range(3):
                for e in range(3):
                    A[m, d, e] += offset[d] * offset[e]
                for f in range(F):
                    right[m, d, f] += offset[d] * (features[other, f] - features[m, f])
    return A, right


def surface_graph(points: np.ndarray, normals: np.ndarray, neighbours: int) -> csr_matrix:
    """Symmetric graph of neighbouring points on the same side of the surface, weighted by distance (M, M).

    Points whose normals oppose each other, as on two limbs that touch, are no neighbours.
    """
    M = len(points)
    distance, near = cKDTree(points).query(points, neighbours + 1)
    i, j, d = np.repeat(np.arange(M), neighbours), near[:, 1:].ravel(), distance[:, 1:].ravel()
    reach = 1.25 * np.median(distance[:, -1])
    keep = (d < reach) & ((normals[i] * normals[j]).sum(axis=1) > -0.2)
    graph = coo_matrix((np.maximum(d[keep], 1e-9), (i[keep], j[keep])), (M, M)).tocsr()
    return graph.maximum(graph.T)


def _pairs(points: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of all points and of their nearest neighbours, two (M * neighbours,) arrays."""
    near = cKDTree(points).query(points, neighbours + 1)[1]
    return np.repeat(np.arange(len(points)), neighbours), near[:, 1:].ravel()
