"""What a frame's points ask of a deforming surface: correspondences both ways, robustly weighted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from geomocap.model.point_grid import PointGrid
from geomocap.nodes.surface_points import PointSet


@dataclass(frozen=True)
class Pull:
    """Weights and errors of the samples' positions, as the deformation takes them.

    Attributes
    ----------
    A : (S, 3, 3) float
        Weight of each sample's position, by direction; no unit.
    b : (S, 3) float
        A times the sample's error, metres.
    support : (S,) float
        How well the frame's points support each sample, 0 to 1.
    across : (S,) float
        Distance of each sample to the plane of the point found, metres.
    energy : float
        Mean of the robust distances of both ways, between 0 and 1.
    """

    A: np.ndarray
    b: np.ndarray
    support: np.ndarray
    across: np.ndarray
    energy: float


@dataclass(frozen=True)
class Target:
    """A frame's points, ready to be searched.

    Attributes
    ----------
    points : PointSet
    feature_scale : (F,) float
        Change of a feature that counts as one scale of distance.
    normal_weight : float
        How many scales of distance opposed normals are apart, halved.
    """

    points: PointSet
    feature_scale: np.ndarray
    normal_weight: float = 1.0

    def coordinates(self, scale: float) -> np.ndarray:
        """Positions, normals and features in one space in which a scale is worth as much in each (M, 6 + F)."""
        p = self.points
        return self.search_coordinates(p.positions, p.normals, p.features, scale)

    def search_coordinates(
        self, positions: np.ndarray, normals: np.ndarray, features: np.ndarray, scale: float
    ) -> np.ndarray:
        """Positions (M, 3), normals and features (M, F) side by side, each scaled to metres."""
        found = np.empty((len(positions), 6 + features.shape[1]))
        found[:, :3] = positions
        np.multiply(scale * self.normal_weight, normals, out=found[:, 3:6])
        np.multiply(scale / self.feature_scale, features, out=found[:, 6:])
        return found

    def grid(self, scale: float) -> PointGrid:
        """Grid of the coordinates at a scale, which is kept."""
        grid = self._grids.get(scale)
        if grid is None:
            grid = self._grids[scale] = PointGrid.of(self.coordinates(scale))
        return grid

    @cached_property
    def _grids(self) -> dict[float, PointGrid]:
        return {}


def pull(
    target: Target,
    y: np.ndarray,
    normals: np.ndarray,
    features: np.ndarray,
    scale: float,
    point_weight: float,
    feature_weight: float,
) -> Pull:
    """Find each sample's point and each point's sample, and gather what they pull.

    Parameters
    ----------
    target : Target
    y, normals, features : (S, 3), (S, 3), (S, F) float
        The surface as it stands.
    scale : float
        Distance at which a correspondence loses its weight, metres.
    point_weight : float
        Weight of a distance along the surface relative to one across it.
    feature_weight : float
        Weight of the features' differences, one feature scale for one `scale` of distance.
    """
    points, grid = target.points, target.grid(scale)
    own = target.search_coordinates(y, normals, features, scale)
    far_out, found = grid.query(own)
    back, taker = PointGrid.of(own).query(grid.data)
    forth_weight = np.exp(-0.5 * (far_out / scale) ** 2)
    back_weight = np.exp(-0.5 * (back / scale) ** 2)
    fraction = min(len(y) / len(points), 1.0)
    A, b, across = gather_pulls(
        y, points.positions, points.normals, found, forth_weight, taker, fraction * back_weight, point_weight
    )
    if features.shape[1] and feature_weight > 0:
        per_feature = scale / target.feature_scale
        gather_features(
            A,
            b,
            y,
            features,
            points.positions,
            points.normals,
            points.features,
            points.gradients,
            found,
            feature_weight * forth_weight,
            per_feature,
        )
    energy = 1 - 0.5 * float(forth_weight.mean() + back_weight.mean())
    return Pull(A, b, forth_weight, across, energy)


@njit(cache=True, nogil=True, error_model="numpy")
def gather_pulls(y, q, n, found, forth_weight, taker, back_weight, point_weight):
    """Sum up what points pull at samples, A (S, 3, 3) and b (S, 3); their distances across their points' planes, (S,).

    Parameters
    ----------
    y : (S, 3) float
        Samples.
    q, n : (M, 3) float
        Points and their normals.
    found : (S,) int
        Each sample's point, and its weight `forth_weight` (S,).
    taker : (M,) int
        Each point's sample, and its weight `back_weight` (M,).
    point_weight : float
        Weight of the distance between points relative to that from the point's plane.
    """
    A = np.zeros((len(y), 3, 3))
    b = np.zeros((len(y), 3))
    distance = np.empty(len(y))
    for k in range(len(found) + len(taker)):
        if k < len(found):
            s, p, w = k, found[k], forth_weight[k]
        else:
            p = k - len(found)
            s, w = taker[p], back_weight[p]
        e0, e1, e2 = y[s, 0] - q[p, 0], y[s, 1] - q[p, 1], y[s, 2] - q[p, 2]
        across = e0 * n[p, 0] + e1 * n[p, 1] + e2 * n[p, 2]
        if k < len(found):
            distance[s] = across
        e = (e0, e1, e2)
        for i in range(3):
            b[s, i] += w * (n[p, i] * across + point_weight * e[i])
            A[s, i, i] += w * point_weight
            for j in range(3):
                A[s, i, j] += w * n[p, i] * n[p, j]
    return A, b, distance


@njit(cache=True, nogil=True, error_model="numpy")
def gather_features(A, b, y, own, q, n, features, gradients, found, strength, per_feature):
    """Add what the features of points ask of samples to A (S, 3, 3) and b (S, 3).

    Parameters
    ----------
    y, own : (S, 3), (S, F) float
        Samples and their features.
    q, n : (M, 3) float
        Points and their normals.
    features, gradients : (M, F), (M, F, 3) float
        The points' features, and how these change along the surface.
    found : (S,) int
        Each sample's point, and its weight `strength` (S,).
    per_feature : (F,) float
        Distance that counts as much as a feature's change by one.
    """
    squares, products = np.empty((3, 3)), np.empty(3)
    # three colours are summed up as `np.einsum` does: the first and the third, then the second
    F = len(per_feature)
    order = np.concatenate((np.arange(0, F, 2), np.arange(1, F, 2)))
    for s in range(len(y)):
        p, w = found[s], strength[s]
        e0, e1, e2 = y[s, 0] - q[p, 0], y[s, 1] - q[p, 1], y[s, 2] - q[p, 2]
        across = e0 * n[p, 0] + e1 * n[p, 1] + e2 * n[p, 2]
        e0, e1, e2 = e0 - across * n[p, 0], e1 - across * n[p, 1], e2 - across * n[p, 2]
        squares[:], products[:] = 0.0, 0.0
        for f in order:
            unit = per_feature[f]
            g = (gradients[p, f, 0] * unit, gradients[p, f, 1] * unit, gradients[p, f, 2] * unit)
            r = (features[p, f] - own[s, f]) * unit + (g[0] * e0 + g[1] * e1 + g[2] * e2)
            for i in range(3):
                products[i] += g[i] * r
                for j in range(3):
                    squares[i, j] += g[i] * g[j]
        for i in range(3):
            b[s, i] += w * products[i]
            for j in range(3):
                A[s, i, j] += w * squares[i, j]
