"""Motions of rigid parts: from nodes that were followed, and the equations that register all parts to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.model.rotations import rigid_motion


@dataclass(frozen=True)
class RigidParts:
    """B rigid parts of a surface of N nodes in T frames.

    Attributes
    ----------
    label : (N,) int
        Part of each node.
    R, t : (B, T, 3, 3), (B, T, 3) float, metres
        position = R @ reference + t.
    rests : (B,) bool
        Parts that stay where they are in all frames, as a robot's base does.
    """

    label: np.ndarray
    R: np.ndarray
    t: np.ndarray
    rests: np.ndarray

    def carry(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, T, 3) and rotations (N, T, 3, 3) of nodes (N, 3)."""
        R = self.R[self.label]
        return (R @ nodes[:, None, :, None])[..., 0] + self.t[self.label], R

    def at_rest(self, rests: np.ndarray) -> RigidParts:
        """Let parts rest, (B,) bool."""
        turns = np.where(rests[:, None, None, None], np.eye(3), self.R)
        return RigidParts(self.label, turns, np.where(rests[:, None, None], 0.0, self.t), rests)

    def compact(self) -> RigidParts:
        """Return the parts that have nodes, numbered anew."""
        kept, label = np.unique(self.label, return_inverse=True)
        return RigidParts(label, self.R[kept], self.t[kept], self.rests[kept])


@njit(cache=True, nogil=True, error_model="numpy")
def carry_samples(R, t, label, samples, normals, binding, weights):
    """Samples (S, 3) and their normals (S, 3) as the parts of their nodes carry them, with the nodes' fractions.

    The parameters are those of `part_equations`, `normals` (S, 3) in the reference frame.
    """
    y, n = np.zeros_like(samples), np.zeros_like(samples)
    for s in range(len(samples)):
        for k in range(binding.shape[1]):
            q, w = label[binding[s, k]], weights[s, k]
            for i in range(3):
                y[s, i] += w * t[q, i]
                for j in range(3):
                    y[s, i] += w * R[q, i, j] * samples[s, j]
                    n[s, i] += w * R[q, i, j] * normals[s, j]
        length = max(np.sqrt(n[s, 0] ** 2 + n[s, 1] ** 2 + n[s, 2] ** 2), 1e-12)
        for i in range(3):
            n[s, i] /= length
    return y, n


@njit(cache=True, nogil=True, error_model="numpy")
def part_equations(R, t, middle, label, samples, binding, weights, A, b, nodes, hinges, hold):
    """Normal equations H (6B, 6B), right side (6B,) of the parts' steps: turn about the middle, and shift.

    Parameters
    ----------
    R, t, middle : (B, 3, 3), (B, 3), (B, 3) float
        Motions since the reference, and centres of the parts in the frame.
    label : (N,) int
        Parts of the nodes.
    samples, binding, weights : (S, 3), (S, K), (S, K)
        Samples in the reference, the nodes that carry them, and their fractions.
    A, b : (S, 3, 3), (S, 3) float
        Weights of the samples' positions, and weights times errors.
    nodes : (N, 3) float
        In the reference.
    hinges : (E, 2) int
        Pairs of nodes of different parts: both parts carry both nodes to the same places, with weight `hold` (E,).
    """
    B = len(R)
    H = np.zeros((6 * B, 6 * B))
    g = np.zeros(6 * B)
    K = binding.shape[1]
    J = np.zeros((max(K, 2), 3, 6))
    AJ = np.zeros((3, 6))
    part, fraction = np.empty(max(K, 2), np.int64), np.empty(max(K, 2))
    for s in range(len(samples) + 2 * len(hinges)):
        hinge = s >= len(samples)
        if hinge:
            e, side = (s - len(samples)) // 2, (s - len(samples)) % 2
            p = nodes[hinges[e, side]]
            used = 2
        else:
            e, side = 0, 0
            p = samples[s]
            used = 0
            for k in range(K):
                q = label[binding[s, k]]
                for h in range(used + 1):
                    if h == used:
                        part[h], fraction[h] = q, 0.0
                        used += 1
                    if part[h] == q:
                        fraction[h] += weights[s, k]
                        break
        e0, e1, e2 = 0.0, 0.0, 0.0
        for k in range(used):
            if hinge:
                part[k], fraction[k] = label[hinges[e, k]], 1.0 - 2.0 * k
            q, w = part[k], fraction[k]
            y0 = R[q, 0, 0] * p[0] + R[q, 0, 1] * p[1] + R[q, 0, 2] * p[2] + t[q, 0]
            y1 = R[q, 1, 0] * p[0] + R[q, 1, 1] * p[1] + R[q, 1, 2] * p[2] + t[q, 1]
            y2 = R[q, 2, 0] * p[0] + R[q, 2, 1] * p[1] + R[q, 2, 2] * p[2] + t[q, 2]
            e0, e1, e2 = e0 + w * y0, e1 + w * y1, e2 + w * y2
            a0, a1, a2 = w * (y0 - middle[q, 0]), w * (y1 - middle[q, 1]), w * (y2 - middle[q, 2])
            # dy/dturn = −[a]ₓ, dy/dshift = w
            J[k, 0, 1], J[k, 0, 2], J[k, 0, 3] = a2, -a1, w
            J[k, 1, 0], J[k, 1, 2], J[k, 1, 4] = -a2, a0, w
            J[k, 2, 0], J[k, 2, 1], J[k, 2, 5] = a1, -a0, w
        for k in range(used):
            first = 6 * part[k]
            for n in range(6):
                if hinge:
                    g[first + n] -= hold[e] * (J[k, 0, n] * e0 + J[k, 1, n] * e1 + J[k, 2, n] * e2)
                    for m in range(3):
                        AJ[m, n] = hold[e] * J[k, m, n]
                else:
                    g[first + n] -= J[k, 0, n] * b[s, 0] + J[k, 1, n] * b[s, 1] + J[k, 2, n] * b[s, 2]
                    for m in range(3):
                        AJ[m, n] = A[s, m, 0] * J[k, 0, n] + A[s, m, 1] * J[k, 1, n] + A[s, m, 2] * J[k, 2, n]
            for h in range(used):
                second = 6 * part[h]
                for m in range(6):
                    for n in range(6):
                        H[second + m, first + n] += (
                            J[h, 0, m] * AJ[0, n] + J[h, 1, m] * AJ[1, n] + J[h, 2, m] * AJ[2, n]
                        )
    return H, g


def part_motions(label: np.ndarray, nodes: np.ndarray, x: np.ndarray, R: np.ndarray, arm: float) -> RigidParts:
    """Fit rigid motions to groups of nodes by Kabsch's method; a node's rotation counts as points `arm` metres from it.

    Parameters
    ----------
    label : (N,) int
    nodes, x, R : (N, 3), (N, T, 3), (N, T, 3, 3) float
        Reference positions, positions and rotations.
    """
    B, T = int(label.max()) + 1, x.shape[1]
    turns, shifts = np.empty((B, T, 3, 3)), np.empty((B, T, 3))
    for b in range(B):
        own = label == b
        turns[b], shifts[b] = rigid_motion(nodes[own], x[own].swapaxes(0, 1), prior=arm**2 * R[own].mean(axis=0))
    return RigidParts(label, turns, shifts, np.zeros(B, bool))
