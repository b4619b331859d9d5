"""Small symmetric systems of equations inside kernels: Cholesky's factors of 6 × 6 matrices, 3 × 3 by cofactors."""

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
