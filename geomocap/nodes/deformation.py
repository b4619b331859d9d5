"""Gauss–Newton steps of a deformation that is as rigid as possible, on nodes with 6 degrees of freedom.

Energy, with nodes at x_i turned by R_i, reference positions p_i and samples y_s carried by their nodes:

    E = Σ_ij w_ij |x_i − x_j − R_i (p_i − p_j)|²  +  Σ_s (y_s − q_s)ᵀ A_s (y_s − q_s)

Sources: O. Sorkine, M. Alexa, "As-rigid-as-possible surface modeling", SGP 2007, equation 3; R. Sumner et al.,
"Embedded deformation for shape manipulation", SIGGRAPH 2007, section 4. The normal equations are sparse with blocks of
6 × 6 and are solved by conjugate gradients with their diagonal blocks as preconditioner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.model.fused import fma
from geomocap.nodes.node_graph import NodeGraph

_MOST = 0.5  # radians by which a node turns in one step: the linearisation ends there
_SMALL = 1e-3  # radians up to which a sine is its series


@dataclass(frozen=True)
class BlockPattern:
    """Where the 6 × 6 blocks of the normal equations stand.

    Attributes
    ----------
    start : (N + 1,) int
        First block of each row.
    column : (B,) int
    diagonal : (N,) int
        Block of each node with itself.
    of_edges : (E, 2) int
        Blocks (i, j) and (j, i) of each edge.
    of_samples : (S, K, K) int
        Blocks of each pair of a sample's nodes.
    """

    start: np.ndarray
    column: np.ndarray
    diagonal: np.ndarray
    of_edges: np.ndarray
    of_samples: np.ndarray


def block_pattern(graph: NodeGraph) -> BlockPattern:
    """Lay out the normal equations of a graph."""
    N = len(graph.nodes)
    i, j = graph.edges.T
    # pairs of nodes of which one carries nothing may be no edge; they get blocks all the same
    a, b = graph.binding[:, :, None], graph.binding[:, None, :]
    shared = (a * N + b).ravel()
    keys = np.unique(np.concatenate([i * N + j, j * N + i, np.arange(N) * (N + 1), shared]))
    row, column = keys // N, keys % N
    start = np.searchsorted(row, np.arange(N + 1))
    return BlockPattern(
        start,
        column,
        np.searchsorted(keys, np.arange(N) * (N + 1)),
        np.searchsorted(keys, np.column_stack([i * N + j, j * N + i])),
        np.searchsorted(keys, a * N + b),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(
    x, R, nodes, edges, edge_weights, binding, weights, offsets, A, b, diagonal, of_edges, of_samples, n_blocks
):
    """Blocks H (B, 6, 6) and right side g (N, 6) of the step (turn, shift) of each node.

    Parameters
    ----------
    x, R : (N, 3), (N, 3, 3) float
        State of the nodes.
    nodes : (N, 3) float
        Reference positions.
    edge_weights : (E,) float
    A : (S, 3, 3) float
        Weights of the samples' positions.
    b : (S, 3) float
        A times the sample's error.
    """
    N = len(x)
    S, K = binding.shape
    H = np.zeros((n_blocks, 6, 6))
    g = np.zeros((N, 6))
    for e in range(len(edges)):
        w = edge_weights[e]
        if w == 0:
            continue
        for side in range(2):
            i, j = edges[e, side], edges[e, 1 - side]
            bi, bj = diagonal[i], diagonal[j]
            bij, bji = of_edges[e, side], of_edges[e, 1 - side]
            d0, d1, d2 = nodes[i, 0] - nodes[j, 0], nodes[i, 1] - nodes[j, 1], nodes[i, 2] - nodes[j, 2]
            a0 = R[i, 0, 0] * d0 + R[i, 0, 1] * d1 + R[i, 0, 2] * d2
            a1 = R[i, 1, 0] * d0 + R[i, 1, 1] * d1 + R[i, 1, 2] * d2
            a2 = R[i, 2, 0] * d0 + R[i, 2, 1] * d1 + R[i, 2, 2] * d2
            r0, r1, r2 = x[i, 0] - x[j, 0] - a0, x[i, 1] - x[j, 1] - a1, x[i, 2] - x[j, 2] - a2
            # residual r; dr/dturn_i = [a]ₓ, dr/dshift_i = 1, dr/dshift_j = −1
            q = a0 * a0 + a1 * a1 + a2 * a2
            av = (a0, a1, a2)
            for m in range(3):
                for n in range(3):
                    H[bi, m, n] -= w * av[m] * av[n]
                H[bi, m, m] += w * q
                H[bi, 3 + m, 3 + m] += w
                H[bj, 3 + m, 3 + m] += w
                H[bij, 3 + m, 3 + m] -= w
                H[bji, 3 + m, 3 + m] -= w
            # [a]ₓᵀ = −[a]ₓ stands between turn and shift
            c01, c02, c12 = w * a2, -w * a1, w * a0
            H[bi, 0, 4] += c01
            H[bi, 1, 3] -= c01
            H[bi, 0, 5] += c02
            H[bi, 2, 3] -= c02
            H[bi, 1, 5] += c12
            H[bi, 2, 4] -= c12
            H[bi, 4, 0] += c01
            H[bi, 3, 1] -= c01
            H[bi, 5, 0] += c02
            H[bi, 3, 2] -= c02
            H[bi, 5, 1] += c12
            H[bi, 4, 2] -= c12
            H[bij, 0, 4] -= c01
            H[bij, 1, 3] += c01
            H[bij, 0, 5] -= c02
            H[bij, 2, 3] += c02
            H[bij, 1, 5] -= c12
            H[bij, 2, 4] += c12
            H[bji, 4, 0] -= c01
            H[bji, 3, 1] += c01
            H[bji, 5, 0] -= c02
            H[bji, 3, 2] += c02
            H[bji, 5, 1] -= c12
            H[bji, 4, 2] += c12
            g[i, 0] -= c01 * r1 + c02 * r2
            g[i, 1] -= -c01 * r0 + c12 * r2
            g[i, 2] -= -c02 * r0 - c12 * r1
            g[i, 3] -= w * r0
            g[i, 4] -= w * r1
            g[i, 5] -= w * r2
            g[j, 3] += w * r0
            g[j, 4] += w * r1
            g[j, 5] += w * r2
    arms, AJ = np.zeros((K, 4)), np.zeros((K, 3, 6))
    for s in range(S):
        if A[s, 0, 0] + A[s, 1, 1] + A[s, 2, 2] == 0:
            continue
        for k in range(K):
            i = binding[s, k]
            w = weights[s, k]
            o0, o1, o2 = offsets[s, k, 0], offsets[s, k, 1], offsets[s, k, 2]
            a0 = w * (R[i, 0, 0] * o0 + R[i, 0, 1] * o1 + R[i, 0, 2] * o2)
            a1 = w * (R[i, 1, 0] * o0 + R[i, 1, 1] * o1 + R[i, 1, 2] * o2)
            a2 = w * (R[i, 2, 0] * o0 + R[i, 2, 1] * o1 + R[i, 2, 2] * o2)
            arms[k, 0], arms[k, 1], arms[k, 2], arms[k, 3] = a0, a1, a2, w
            # dy/dturn = −[a]ₓ, dy/dshift = w
            for m in range(3):
                A0, A1, A2 = A[s, m, 0], A[s, m, 1], A[s, m, 2]
                AJ[k, m, 0], AJ[k, m, 1], AJ[k, m, 2] = A2 * a1 - A1 * a2, A0 * a2 - A2 * a0, A1 * a0 - A0 * a1
                AJ[k, m, 3], AJ[k, m, 4], AJ[k, m, 5] = A0 * w, A1 * w, A2 * w
            b0, b1, b2 = b[s, 0], b[s, 1], b[s, 2]
            g[i, 0] -= a1 * b2 - a2 * b1
            g[i, 1] -= a2 * b0 - a0 * b2
            g[i, 2] -= a0 * b1 - a1 * b0
            g[i, 3] -= w * b0
            g[i, 4] -= w * b1
            g[i, 5] -= w * b2
        for k in range(K):
            a0, a1, a2, w = arms[k, 0], arms[k, 1], arms[k, 2], arms[k, 3]
            for h in range(K):
                B = H[of_samples[s, k, h]]
                for n in range(6):
                    B0, B1, B2 = AJ[h, 0, n], AJ[h, 1, n], AJ[h, 2, n]
                    B[0, n] += a1 * B2 - a2 * B1
                    B[1, n] += a2 * B0 - a0 * B2
                    B[2, n] += a0 * B1 - a1 * B0
                    B[3, n] += w * B0
                    B[4, n] += w * B1
                    B[5, n] += w * B2
    return H, g


@njit(cache=True, nogil=True, error_model="numpy")
def solve_blocks(H, g, start, column, diagonal, iterations, tolerance):
    """Solve H z = g by conjugate gradients with block-diagonal preconditioner; returns z (N, 6).

    Stops when the preconditioned residual has fallen by `tolerance`, or after `iterations`.
    """
    N = len(g)
    P = np.zeros((N, 6, 6))
    for i in range(N):
        P[i] = np.linalg.inv(H[diagonal[i]])
    z = np.zeros((N, 6))
    r = g.copy()
    u = np.zeros((N, 6))
    q = np.zeros((N, 6))
    rho = 0.0
    for i in range(N):
        for m in range(6):
            s = 0.0
            for n in range(6):
                s += P[i, m, n] * r[i, n]
            u[i, m] = s
            rho += s * r[i, m]
    rho0 = rho
    if rho0 <= 0:
        return z
    for _ in range(iterations):
        pq = 0.0
        for i in range(N):
            q0 = q1 = q2 = q3 = q4 = q5 = 0.0
            for k in range(start[i], start[i + 1]):
                v = u[column[k]]
                B = H[k]
                for n in range(6):
                    vn = v[n]
                    q0 += B[0, n] * vn
                    q1 += B[1, n] * vn
                    q2 += B[2, n] * vn
                    q3 += B[3, n] * vn
                    q4 += B[4, n] * vn
                    q5 += B[5, n] * vn
            q[i, 0], q[i, 1], q[i, 2], q[i, 3], q[i, 4], q[i, 5] = q0, q1, q2, q3, q4, q5
            pq += u[i, 0] * q0 + u[i, 1] * q1 + u[i, 2] * q2 + u[i, 3] * q3 + u[i, 4] * q4 + u[i, 5] * q5
        alpha = rho / pq
        new = 0.0
        for i in range(N):
            for m in range(6):
                z[i, m] += alpha * u[i, m]
                r[i, m] -= alpha * q[i, m]
        for i in range(N):
            for m in range(6):
                s = 0.0
                for n in range(6):
                    s += P[i, m, n] * r[i, n]
                q[i, m] = s
                new += s * r[i, m]
        if new < tolerance * tolerance * rho0:
            break
        beta = new / rho
        rho = new
        for i in range(N):
            for m in range(6):
                u[i, m] = q[i, m] + beta * u[i, m]
    return z


def step(
    graph: NodeGraph,
    pattern: BlockPattern,
    x: np.ndarray,
    R: np.ndarray,
    edge_weights: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
    iterations: int,
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss–Newton step; returns the nodes' new positions (N, 3) and rotations (N, 3, 3).

    Parameters
    ----------
    edge_weights : (E,) float
    A, b : (S, 3, 3), (S, 3) float
        Samples' weights, and weights times errors.
    iterations : int
        Of the conjugate gradients, at most.
    """
    H, g = normal_equations(
        x,
        R,
        graph.nodes,
        graph.edges,
        edge_weights,
        graph.binding,
        graph.weights,
        graph.offsets,
        A,
        b,
        pattern.diagonal,
        pattern.of_edges,
        pattern.of_samples,
        len(pattern.column),
    )
    # a little damping keeps nodes in place that nothing holds
    size = graph.spacing**2
    for m in range(6):
        H[pattern.diagonal, m, m] += 1e-4 * (size if m < 3 else 1.0)
    z = solve_blocks(H, g, pattern.start, pattern.column, pattern.diagonal, iterations, 1e-3)
    turned = np.empty(R.shape)
    turn_by(z[:, :3], R, _MOST, turned)
    return x + z[:, 3:], turned


@njit(cache=True, nogil=True, error_model="numpy")
def turn_by(turns, R, most, turned):
    """Fill rotations (N, 3, 3), those of R turned by rotation vectors (N, 3), which are shortened to `most` radians."""
    T = np.empty((3, 3))
    for i in range(len(turns)):
        x, y, z = turns[i, 0], turns[i, 1], turns[i, 2]
        much = max(math.sqrt(x * x + y * y + z * z) / most, 1.0)
        x, y, z = x / much, y / much, z / much
        square = x * x + y * y + z * z
        angle = math.sqrt(square)
        # sine of half the angle over the angle, and a quaternion
        if angle <= _SMALL:
            part = 0.5 - square / 48 + square * square / 3840
        else:
            part = math.sin(angle / 2) / angle
        x, y, z, w = part * x, part * y, part * z, math.cos(angle / 2)
        T[0, 0], T[0, 1], T[0, 2] = x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)
        T[1, 0], T[1, 1], T[1, 2] = 2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)
        T[2, 0], T[2, 1], T[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w
        for m in range(3):
            for n in range(3):
                turned[i, m, n] = fma(T[m, 2], R[i, 2, n], fma(T[m, 1], R[i, 1, n], T[m, 0] * R[i, 0, n]))
