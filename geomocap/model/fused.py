"""Products of 3 × 3 matrices inside kernels, rounded as NumPy's are by the libraries behind these.

A product and a sum that are rounded once are an instruction of today's processors. Errors of the last bit would do no
harm by themselves, but where a search decides by them, kernels and arrays find the same.
"""

from __future__ import annotations

from typing import Any

from numba import njit, types
from numba.extending import intrinsic


def _fma(typing, a, b, c):
    """Return a b + c of floats, rounded once."""
    signature = types.float64(types.float64, types.float64, types.float64)
    return signature, lambda context, builder, signature, arguments: builder.fma(*arguments)


fma: Any = intrinsic(_fma)


@njit(cache=True, nogil=True, error_model="numpy")
def turned(R, m, v0, v1, v2):
    """Coordinate m of R v, as `np.matmul` of many R (3, 3) with columns (3, 1) rounds it."""
    return fma(R[m, 2], v2, fma(R[m, 0], v0, R[m, 1] * v1))
