"""Rows of the benchmark table: our figure beside that of what a user would pick instead, from the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    task : what was done, with its size
    seconds : ours
    competitor : name of the alternative, "" if there is none
    competitor_seconds : its time in the same run, NaN if there is none
    goal : what it must reach, in words
    note : accuracy, memory or anything else worth knowing
    """

    task: str
    seconds: float
    competitor: str = ""
    competitor_seconds: float = float("nan")
    goal: str = ""
    note: str = ""


def measure(function: Callable[[], object], repeat: int = 5, warm_up: bool = True) -> float:
    """Return the median time of a call, seconds, after one call that compiles."""
    if warm_up:
        function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))
