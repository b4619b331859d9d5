"""Products rounded once, inside kernels."""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.model.fused import fma, turned


@njit
def fused(a, b, c):
    return fma(a, b, c)


def test_a_product_and_a_sum_are_rounded_once():
    a = 1.0 + 2.0**-30
    assert a * a - (1.0 + 2.0**-29) == 0.0
    assert fused(a, a, -(1.0 + 2.0**-29)) == 2.0**-60


def test_turned_is_the_product():
    rng = np.random.default_rng(0)
    R, v = rng.normal(size=(3, 3)), rng.normal(size=3)
    np.testing.assert_allclose([turned(R, m, *v) for m in range(3)], R @ v, atol=1e-14)
