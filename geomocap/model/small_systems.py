"""Small matrices inside kernels: Cholesky's factors of symmetric 6 × 6 ones, 3 × 3 systems, nearest rotations."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def cholesky(H, L, least=1e-10):
    """Factorise H = L Lᵀ, (6, 6), lower triangle given; False if a pivot is not above `least` times its diagonal."""
    for i in range(6):
        for j in range(i + 1):
            s = H[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > least * H[i, i]:
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def solve(L, b, x):
    """Solve L Lᵀ x = b for x (6,)."""
    for i in range(6):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@njit(cache=True, nogil=True, error_model="numpy")
def inverse_diagonal(L, out):
    """Diagonal of (L Lᵀ)⁻¹, with L (6, 6) lower triangular, into `out` (6,): the squares of L⁻¹ summed over rows."""
    column = np.empty(6)
    for r in range(6):
        out[r] = 0.0
        for i in range(r, 6):
            s = 1.0 if i == r else 0.0
            for k in range(r, i):
                s -= L[i, k] * column[k]
            column[i] = s / L[i, i]
            out[r] += column[i] * column[i]


@njit(cache=True, nogil=True, error_model="numpy")
def solve_symmetric(N, b, x):
    """Solve N x = b for x (3,) by cofactors; N (3, 3) symmetric and positive definite, `x` may be `b`."""
    xx, xy, xz = (
        N[1, 1] * N[2, 2] - N[1, 2] * N[1, 2],
        N[0, 2] * N[1, 2] - N[0, 1] * N[2, 2],
        N[0, 1] * N[1, 2] - N[0, 2] * N[1, 1],
    )
    yy, yz, zz = (
        N[0, 0] * N[2, 2] - N[0, 2] * N[0, 2],
        N[0, 1] * N[0, 2] - N[0, 0] * N[1, 2],
        N[0, 0] * N[1, 1] - N[0, 1] * N[0, 1],
    )
    determinant = N[0, 0] * xx + N[0, 1] * xy + N[0, 2] * xz
    u, v, w = b[0] / determinant, b[1] / determinant, b[2] / determinant
    x[0], x[1], x[2] = xx * u + xy * v + xz * w, xy * u + yy * v + yz * w, xz * u + yz * v + zz * w


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_turn(M, R):
    """Proper rotation that maximises trace(Rᵀ M), into R (3, 3), by one-sided Jacobi rotations (Hestenes 1958).

    The identity if M has rank 0 or just 1.
    """
    U, V = M.copy(), np.empty((3, 3))
    lengths = np.empty(3)
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):  # 4 to 6 are enough
        done = True
        for p, q in ((0, 1), (0, 2), (1, 2)):
            own, other, both = 0.0, 0.0, 0.0
            for i in range(3):
                own += U[i, p] * U[i, p]
                other += U[i, q] * U[i, q]
                both += U[i, p] * U[i, q]
            if abs(both) <= 1e-15 * math.sqrt(own * other):
                continue
            done = False
            ratio = (other - own) / (2.0 * both)
            tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
            c = 1.0 / math.sqrt(1.0 + tangent * tangent)
            s = c * tangent
            for i in range(3):
                U[i, p], U[i, q] = c * U[i, p] - s * U[i, q], s * U[i, p] + c * U[i, q]
                V[i, p], V[i, q] = c * V[i, p] - s * V[i, q], s * V[i, p] + c * V[i, q]
        if done:
            break
    for j in range(3):
        lengths[j] = U[0, j] * U[0, j] + U[1, j] * U[1, j] + U[2, j] * U[2, j]
    # By hand: sorting an array, or assigning to a whole one, would take longer to compile than all the rest.
    first, second, third = 0, 1, 2
    if lengths[second] > lengths[first]:
        first, second = second, first
    if lengths[third] > lengths[second]:
        second, third = third, second
    if lengths[second] > lengths[first]:
        first, second = second, first
    u, v = np.empty((3, 3)), np.empty((3, 3))
    for k in range(2):
        column = second if k else first
        for i in range(3):
            u[k, i], v[k, i] = U[i, column], V[i, column]
        if k:
            along = u[0, 0] * u[1, 0] + u[0, 1] * u[1, 1] + u[0, 2] * u[1, 2]
            for i in range(3):
                u[1, i] -= along * u[0, i]
        length = math.sqrt(u[k, 0] * u[k, 0] + u[k, 1] * u[k, 1] + u[k, 2] * u[k, 2])
        if length == 0.0:
            for i in range(3):
                for j in range(3):
                    R[i, j] = 1.0 if i == j else 0.0
            return
        for i in range(3):
            u[k, i] /= length
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        u[2, i] = u[0, j] * u[1, k] - u[0, k] * u[1, j]
        v[2, i] = v[0, j] * v[1, k] - v[0, k] * v[1, j]
    for i in range(3):
        for j in range(3):
            R[i, j] = u[0, i] * v[0, j] + u[1, i] * v[1, j] + u[2, i] * v[2, j]


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_turns(matrices, rotations):
    """Fill in the proper rotation (N, 3, 3) nearest to each matrix (N, 3, 3)."""
    for k in range(len(matrices)):
        nearest_turn(matrices[k], rotations[k])
