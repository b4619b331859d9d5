"""Trajectories that stand one after the other in a file, each from its start to its end."""

from __future__ import annotations

import numpy as np

MOST_FRAMES = 10_000_000  # four days at 30 per second
MOST_BYTES = 1 << 35  # of an array that is spread over all frames


def spread_over_frames(
    values: np.ndarray, first: np.ndarray, start: np.ndarray, frames: int, counted: bool = False
) -> np.ndarray:
    """Give each trajectory all frames, (N, T, …).

    Parameters
    ----------
    values : (M, …)
        One trajectory after the other.
    first : (N + 1,) int
        Where each begins in `values`.
    start : (N,) int
        Frame in which each begins.
    frames : int
        Number of frames T.
    counted : bool
        What is not there is 0 instead of NaN.

    Raises
    ------
    ValueError
        If a trajectory leaves the frames.
    """
    lengths = np.diff(first)
    if first.ndim != 1 or len(first) < 1 or start.shape != lengths.shape or lengths.min(initial=0) < 0:
        raise ValueError("its trajectories don't stand one after the other")
    if first[0] != 0 or first[-1] != len(values) or not 0 < frames <= MOST_FRAMES:
        raise ValueError(f"its trajectories take {first[-1]} rows and {frames} frames, it has {len(values)} rows")
    if len(lengths) * frames * values[:1].nbytes > MOST_BYTES:
        raise ValueError(f"{len(lengths):,} trajectories in {frames:,} frames are more than memory holds")
    who = np.repeat(np.arange(len(lengths)), lengths)
    when = start[who] + np.arange(len(who)) - first[:-1][who]
    if len(who) and not 0 <= when.min() <= when.max() < frames:
        raise ValueError(f"trajectories begin or end beyond frames 0 to {frames - 1}")
    shape = (len(lengths), frames, *values.shape[1:])
    result = np.zeros(shape, values.dtype) if counted else np.full(shape, np.nan, values.dtype)
    result[who, when] = values
    return result
