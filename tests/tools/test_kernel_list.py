"""The list of kernels that are compiled ahead is written in words that are read again."""

from __future__ import annotations

import json

import numba
import numpy as np

from geomocap.kernels_ahead import type_of
from tools.kernel_list import list_of

KINDS = (numba.typeof(np.zeros((2, 3), np.float32)), numba.int64)


def test_kernels_are_listed_in_order_and_those_with_other_arguments_left_out():
    calls = [("a", "first", KINDS), ("b", "odd", (numba.typeof("text"),)), ("b", "last", KINDS[1:])]
    read = json.loads(list_of(calls))
    assert [(module, name) for module, name, _ in read] == [("a", "first"), ("b", "last")]
    assert tuple(type_of(code) for code in read[0][2]) == KINDS
