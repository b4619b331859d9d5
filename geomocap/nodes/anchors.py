"""Trajectories known from elsewhere, such as patches of the images, as anchors that keep a surface from sliding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from geomocap.model.fused import turned
from geomocap.model.motion_paths import DEPTH_FRACTION
from geomocap.model.rotations import nearest_rotation
from geomocap.nodes.node_graph import NodeGraph

_AROUND = 12  # marks that move a node
_LEAST = 4
_REACH = 2.0  # node spacings
_TURN = 1e-3  # squared node spacings; a turn that marks hardly show stays as it is


@dataclass(frozen=True)
class Anchors:
    """Points of the surface whose paths are known.

    Attributes
    ----------
    positions : (P, T, 3) float
        In the unit that nodes are followed in; NaN where not known.
    sigma : (P, T) float, optional
        Standard deviation of a coordinate, in that unit.
    ray : (P, T, 3) float, optional
        Along which positions are unsure, see `MotionPaths`.
    """

    positions: np.ndarray
    sigma: np.ndarray | None = None
    ray: np.ndarray | None = None

    @classmethod
    def none(cls, frames: int) -> Anchors:
        """No points at all."""
        return cls(np.zeros((0, frames, 3)))


@dataclass(frozen=True)
class AnchorPoints:
    """Points of the surface whose places in a frame are known.

    Attributes
    ----------
    sample : (K,) int
        The graph's sample next to each.
    offset : (K, 3) float, metres
        From the mark to its sample, in the reference frame.
    position : (K, 3) float, metres, world
        Where the mark is in the frame.
    precision : (K,) float
        One over the variance of a coordinate, or 1 where that isn't known.
    ray : (K, 3) float, optional
        Along which the place is unsure.
    """

    sample: np.ndarray
    offset: np.ndarray
    position: np.ndarray
    precision: np.ndarray
    ray: np.ndarray | None = None

    @classmethod
    def of(cls, graph: NodeGraph, homes: np.ndarray, anchors: Anchors, frame: int) -> AnchorPoints:
        """Hang the marks of a frame on a graph; `homes` (P, 3) are their places in the reference frame or NaN."""
        positions = anchors.positions[:, frame]
        known = np.isfinite(homes[:, 0]) & np.isfinite(positions[:, 0])
        home = homes[known]
        distance, sample = cKDTree(graph.samples).query(home)
        near = distance < graph.spacing
        sample = sample[near].astype(int)
        sigma, ray = (None if a is None else a[known, frame][near] for a in (anchors.sigma, anchors.ray))
        precision = np.ones(len(sample)) if sigma is None else 1 / sigma**2
        return cls(sample, graph.samples[sample] - home[near], positions[known][near], precision, ray)

    def move(
        self, graph: NodeGraph, x: np.ndarray, R: np.ndarray, give: float, scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Put nodes that are far from the marks around them where these say, each by its marks' rigid motion.

        A fit can't do that: a mark that is missed by much loses its weight. Other nodes stay, also those around which
        fewer than four marks are known, or whose marks don't move as one. Marks that are unsure along a ray have no
        say.

        Parameters
        ----------
        x, R : (N, 3), (N, 3, 3) float
            State of the nodes.
        give : float
            What marks miss of one motion, at most (node spacings).
        scale : float
            Distance at which a mark loses its weight, metres.
        """
        sure = np.ones(len(self.sample), bool) if self.ray is None else ~self.ray.any(axis=1)
        if sure.sum() < _AROUND:
            return x, R
        home, place = (graph.samples[self.sample] - self.offset)[sure], self.position[sure]
        distance, near = cKDTree(home).query(graph.nodes, _AROUND)
        weight = np.where(distance < _REACH * graph.spacing, np.exp(-0.5 * (distance / graph.spacing) ** 2), 0.0)
        enough = (weight > 0).sum(axis=1) >= _LEAST
        weight, near = weight[enough] / weight[enough].sum(axis=1, keepdims=True), near[enough]
        rest, now = ((weight[..., None] * places[near]).sum(axis=1) for places in (home, place))
        away, moved = home[near] - rest[:, None], place[near] - now[:, None]
        moments = np.einsum("nk,nki,nkj->nij", weight, moved, away)
        turn = nearest_rotation(moments + _TURN * graph.spacing**2 * R[enough])
        miss = moved - np.einsum("nij,nkj->nki", turn, away)
        one = np.sqrt((weight * (miss**2).sum(axis=2)).sum(axis=1)) < give * graph.spacing
        expected = x[enough] + np.einsum("nij,nj->ni", R[enough], rest - graph.nodes[enough])
        one &= np.linalg.norm(now - expected, axis=1) > scale
        rows = np.flatnonzero(enough)[one]
        x, R = x.copy(), R.copy()
        x[rows] = now[one] + np.einsum("nij,nj->ni", turn[one], graph.nodes[rows] - rest[one])
        R[rows] = turn[one]
        return x, R

    def add_to(
        self, A: np.ndarray, b: np.ndarray, graph: NodeGraph, x: np.ndarray, R: np.ndarray, weight: float, scale: float
    ) -> None:
        """Add what the marks pull at the samples to A (S, 3, 3) and b (S, 3), in place; robustly, by Geman and McClure.

        What is missed along a ray counts a tenth: there the surface knows more.

        Parameters
        ----------
        x, R : (N, 3), (N, 3, 3) float
            State of the nodes.
        weight : float
            Of a precision of 1, relative to that of a point.
        scale : float
            Distance at which a mark loses its weight, metres.
        """
        rays = np.zeros((0, 3)) if self.ray is None else self.ray
        pull_marks(
            A,
            b,
            self.sample,
            self.offset,
            self.position,
            self.precision,
            rays,
            x,
            R,
            graph.binding,
            graph.weights,
            graph.offsets,
            weight,
            scale**2,
        )


def carried(graph: NodeGraph, sample: np.ndarray, x: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (K, 3) and turns (K, 3, 3) of some samples; the turns are blends and no exact rotations."""
    places, turns = np.empty((len(sample), 3)), np.empty((len(sample), 3, 3))
    carry(sample, x, R, graph.binding, graph.weights, graph.offsets, places, turns)
    return places, turns


@njit(cache=True, nogil=True, error_model="numpy")
def carry(sample, x, R, binding, weights, offsets, places, turns):
    """Fill the places (K, 3) and turns (K, 3, 3) of samples (K,), see `carried`."""
    for k in range(len(sample)):
        s = sample[k]
        places[k], turns[k] = 0.0, 0.0
        for h in range(binding.shape[1]):
            i, w = binding[s, h], weights[s, h]
            o0, o1, o2 = offsets[s, h, 0], offsets[s, h, 1], offsets[s, h, 2]
            for m in range(3):
                places[k, m] += w * (x[i, m] + turned(R[i], m, o0, o1, o2))
                for n in range(3):
                    turns[k, m, n] += w * R[i, m, n]


@njit(cache=True, nogil=True, error_model="numpy")
def pull_marks(A, b, sample, offset, position, precision, ray, x, R, binding, weights, offsets, weight, scale_square):
    """Add what marks pull to A (S, 3, 3) and b (S, 3), see `AnchorPoints.add_to`; without rays `ray` has no rows."""
    count = len(sample)
    places, turns = np.empty((count, 3)), np.empty((count, 3, 3))
    carry(sample, x, R, binding, weights, offsets, places, turns)
    error, pull = np.empty(3), np.eye(3)
    # sums of three as `np.einsum` has them: the first and the third, then the second
    for k in range(count):
        s = sample[k]
        square, along = 0.0, 0.0
        for m in range(3):
            arm = turns[k, m, 0] * offset[k, 0] + turns[k, m, 2] * offset[k, 2] + turns[k, m, 1] * offset[k, 1]
            error[m] = places[k, m] - position[k, m] - arm
            if len(ray):
                along += error[m] * ray[k, m]
        for m in range(3):
            miss = error[m]
            if len(ray):
                miss -= (1 - DEPTH_FRACTION) * along * ray[k, m]
                for n in range(3):
                    pull[m, n] = (1.0 if m == n else 0.0) - (1 - DEPTH_FRACTION**2) * ray[k, m] * ray[k, n]
            square += miss * miss
        w = weight * precision[k] / (1 + square / scale_square) ** 2
        for m in range(3):
            pulled = pull[m, 0] * error[0] + pull[m, 2] * error[2] + pull[m, 1] * error[1]
            b[s, m] += w * pulled
            for n in range(3):
                A[s, m, n] += w * pull[m, n]


def find_homes(graph: NodeGraph, x: np.ndarray, R: np.ndarray, anchors: Anchors, frame: int) -> np.ndarray:
    """Where the anchors of a frame were in the reference frame, (P, 3), metres; NaN where not known.

    Each is carried back by the sample next to it; what is farther from the surface than half the nodes' spacing has no
    home. That of an anchor with a ray is beside its sample: how far before or behind it, nobody saw.
    """
    positions = anchors.positions[:, frame]
    homes = np.full(positions.shape, np.nan)
    rows = np.flatnonzero(np.isfinite(positions[:, 0]))
    if not len(rows):
        return homes
    distance, sample = cKDTree(graph.deform(x, R)[0]).query(positions[rows])
    rows, sample = rows[distance < 0.5 * graph.spacing], sample[distance < 0.5 * graph.spacing].astype(int)
    y, turn = carried(graph, sample, x, R)
    away = positions[rows] - y
    if anchors.ray is not None:
        ray = anchors.ray[rows, frame]
        away -= (away * ray).sum(axis=1, keepdims=True) * ray
    homes[rows] = graph.samples[sample] + np.einsum("kji,kj->ki", turn, away)
    return homes
