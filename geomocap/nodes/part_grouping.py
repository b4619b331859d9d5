"""Nodes of a surface grouped into rigid parts by what the points of all frames know of their motion.

A piece of surface knows its motion only across itself: a plane may slide in itself, a shaft may turn about itself, and
nothing is seen of it. How badly a motion suits a piece is therefore a quadratic form of the motion's twist, the
linearised sum of squared distances to the points' planes. The forms of two pieces add, so what it costs to move both
as one rigid part follows from the forms alone: what a piece doesn't know of its motion is no evidence against the
other's.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

_FRAMES = 0.95  # a part must move as one in this fraction of the frames; in the others it may have been lost


@dataclass(frozen=True)
class MotionForms:
    """Motions of G pieces of surface in T frames, and what twists of them cost.

    With a twist ξ (turn, shift; about the origin of the world axes) after its motion, a piece costs
    ξᵀ `form` ξ + 2 `slope` · ξ + `cost`.

    Attributes
    ----------
    R, t : (G, T, 3, 3), (G, T, 3) float
        Rotation and translation since the reference frame.
    form : (G, T, 6, 6) float
    slope : (G, T, 6) float
    cost : (G, T) float
    weight : (G, T) float
        Number of samples that points support.
    """

    R: np.ndarray
    t: np.ndarray
    form: np.ndarray
    slope: np.ndarray
    cost: np.ndarray
    weight: np.ndarray


def group_nodes(forms: MotionForms, edges: np.ndarray, largest_misfit: float, least: int) -> np.ndarray:
    """Group neighbouring nodes as long as one motion suits them, the best suited first.

    Parameters
    ----------
    forms : MotionForms
        Of the N nodes.
    edges : (E, 2) int
        Neighbours.
    largest_misfit : float
        By which points may miss the smaller of two groups, root mean square, more if both move as one; in the unit of
        the forms' lengths.
    least : int
        Groups of fewer nodes go on joining the neighbour that suits them best.

    Returns
    -------
    (N,) int, from 0
    """
    state = _NodeGroups(forms)
    neighbours: list[set[int]] = [set() for _ in range(len(forms.R))]
    for i, j in edges.tolist():
        neighbours[i].add(j)
        neighbours[j].add(i)
    size, version = np.ones(len(forms.R), int), np.zeros(len(forms.R), int)
    label = np.arange(len(forms.R))
    misfit = state.misfit(edges[:, 0], edges[:, 1])
    heap = [(m, i, j, 0, 0) for m, (i, j) in zip(misfit.tolist(), edges.tolist(), strict=True)]
    heapq.heapify(heap)
    while heap:
        m, i, j, of_i, of_j = heapq.heappop(heap)
        if version[i] != of_i or version[j] != of_j:  # one of them has joined another since
            continue
        if m > largest_misfit and min(size[i], size[j]) >= least:
            continue
        state.join(i, j)
        label[label == j] = i
        size[i] += size[j]
        version[i] += 1
        version[j] = -1
        neighbours[i] = (neighbours[i] | neighbours[j]) - {i, j}
        for k in neighbours[j] - {i}:
            neighbours[k].discard(j)
            neighbours[k].add(i)
        near = np.array(sorted(neighbours[i]), int)
        if len(near):
            again = state.misfit(np.full(len(near), i), near)
            for m, k in zip(again.tolist(), near.tolist(), strict=True):
                heapq.heappush(heap, (m, i, k, int(version[i]), int(version[k])))
    return np.unique(label, return_inverse=True)[1]


class _NodeGroups:
    """Forms of groups of nodes, that of a joined pair in the place of its first."""

    def __init__(self, forms: MotionForms):
        self.R, self.t = forms.R.copy(), forms.t.copy()
        self.form, self.slope = forms.form.copy(), forms.slope.copy()
        self.cost, self.weight = forms.cost.copy(), forms.weight.copy()
        own = np.linalg.solve(self.form, self.slope[..., None])[..., 0]
        self.least = self.cost - (self.slope * own).sum(axis=-1)

    def together(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Twists (n, T, 6) of i's motions that suit i and j together best, and their costs (n, T)."""
        apart = twist_of(self.R[i], self.t[i], self.R[j], self.t[j])
        moved = (self.form[j] @ apart[..., None])[..., 0]
        slope = self.slope[i] + self.slope[j] - moved
        twist = -np.linalg.solve(self.form[i] + self.form[j], slope[..., None])[..., 0]
        constant = self.cost[i] + self.cost[j] + ((moved - 2 * self.slope[j]) * apart).sum(axis=-1)
        return twist, constant + (slope * twist).sum(axis=-1)

    def misfit(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Root mean square by which points miss the smaller one more, were both one part, (n,)."""
        more = self.together(i, j)[1] - self.least[i] - self.least[j]
        few = np.maximum(np.minimum(self.weight[i], self.weight[j]), 1e-6)
        ordered = np.sort(np.maximum(more, 0.0) / few, axis=1)
        return np.sqrt(ordered[:, int(_FRAMES * (ordered.shape[1] - 1))])

    def join(self, i: int, j: int) -> None:
        twist, cost = self.together(np.array([i]), np.array([j]))
        turn, shift = motion_of(twist[0])
        self.R[i], self.t[i] = turn @ self.R[i], (turn @ self.t[i][..., None])[..., 0] + shift
        self.form[i] += self.form[j]
        self.weight[i] += self.weight[j]
        self.slope[i] = 0.0
        self.cost[i] = self.least[i] = cost[0]


def twist_of(R: np.ndarray, t: np.ndarray, to_R: np.ndarray, to_t: np.ndarray) -> np.ndarray:
    """Twists (…, 6), turn and shift, that take motions (R, t) to (to_R, to_t), by the logarithm of SE(3)."""
    turn = to_R @ R.swapaxes(-1, -2)
    shift = to_t - (turn @ t[..., None])[..., 0]
    w = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(t.shape)
    angle = np.linalg.norm(w, axis=-1)
    half = angle / 2
    # 1/a² (1 − a/2 · cot a/2), which tends to 1/12
    second = np.where(
        angle > 1e-3, (1 - half / np.tan(np.maximum(half, 1e-4))) / np.maximum(angle, 1e-3) ** 2, 1.0 / 12.0
    )
    once = np.cross(w, shift)
    return np.concatenate([w, shift - once / 2 + second[..., None] * np.cross(w, once)], axis=-1)


def motion_of(twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (n, 3, 3) and translations (n, 3) of twists (n, 6), by the exponential of SE(3)."""
    w, v = twist[:, :3], twist[:, 3:]
    angle = np.linalg.norm(w, axis=1)
    safe = np.maximum(angle, 1e-3)
    first = np.where(angle > 1e-3, (1 - np.cos(safe)) / safe**2, 0.5)[:, None]
    second = np.where(angle > 1e-3, (safe - np.sin(safe)) / safe**3, 1.0 / 6.0)[:, None]
    once = np.cross(w, v)
    return Rotation.from_rotvec(w).as_matrix(), v + first * once + second * np.cross(w, once)
