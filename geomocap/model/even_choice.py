"""Some of many in a row, evenly spread: frames to look at, samples to ask."""

from __future__ import annotations

import numpy as np


def evenly_chosen(count: int, most: int) -> np.ndarray:
    """Numbers from 0 to `count` - 1, at most so many, the first and the last among them: (K,) int, ascending."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
