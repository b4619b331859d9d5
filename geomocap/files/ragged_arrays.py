"""Trajectories that stand one after the other in a file, each from its start to its end."""

from __future__ import annotations

import numpy as np

# Of trajectories times frames that are spread at once, half a gigabyte of positions; of more every k-th is taken.
MOST_POSITIONS = 20_000_000
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
    check_layout(first, start, frames, len(values))
    lengths = np.diff(first)
    if len(lengths) * frames * values[:1].nbytes > MOST_BYTES:
        raise ValueError(f"{len(lengths):,} trajectories in {frames:,} frames are more than memory holds")
    who, when = np.repeat(np.arange(len(lengths)), lengths), frames_of(first, start, frames)
    shape = (len(lengths), frames, *values.shape[1:])
    result = np.zeros(shape, values.dtype) if counted else np.full(shape, np.nan, values.dtype)
    result[who, when] = values
    return result


def check_layout(first: np.ndarray, start: np.ndarray, frames: int, rows: int) -> None:
    """Raise ValueError if trajectories can't stand one after the other so; see `spread_over_frames`."""
    lengths = np.diff(first)
    if first.ndim != 1 or len(first) < 1 or start.shape != lengths.shape or lengths.min(initial=0) < 0:
        raise ValueError("its trajectories don't stand one after the other")
    if first[0] != 0 or first[-1] != rows or not 0 < frames <= MOST_FRAMES:
        raise ValueError(f"its trajectories take {first[-1]} rows and {frames} frames, it has {rows} rows")


def frames_of(first: np.ndarray, start: np.ndarray, frames: int) -> np.ndarray:
    """Frame of each row of trajectories that stand one after the other, (M,) int.

    Raises
    ------
    ValueError
        If a trajectory leaves the frames.
    """
    lengths = np.diff(first)
    when = np.arange(first[-1]) + np.repeat(start - first[:-1], lengths)
    if len(when) and not 0 <= when.min() <= when.max() < frames:
        raise ValueError(f"trajectories begin or end beyond frames 0 to {frames - 1}")
    return when


def one_after_the_other(values: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Take from each trajectory its frames from start to end: (M, …), which `spread_over_frames` undoes.

    Parameters
    ----------
    values : (N, T, …)
    start, end : (N,) int
        First and last frame of each; end is before start where there is none.
    """
    frames = np.arange(values.shape[1])
    return values[(frames >= start[:, None]) & (frames <= end[:, None])]


def some_of(first: np.ndarray, start: np.ndarray, frames: int, most: int = MOST_POSITIONS) -> np.ndarray:
    """Which trajectories are read where they and their frames are too many to be spread: every k-th, (K,) int.

    Parameters
    ----------
    first : (N + 1,) int
        Where each begins among the values.
    start : (N,) int
    frames : int
        Number of frames T.
    most : int
        Of trajectories times frames.
    """
    return np.arange(0, len(start), max(1, -(-len(start) * frames // most)))


def rows_of(first: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of some trajectories among the values, (M,) int, and where each begins among these, (K + 1,) int."""
    lengths = first[which + 1] - first[which]
    begin = np.concatenate([[0], np.cumsum(lengths)])
    return np.arange(begin[-1]) + np.repeat(first[which] - begin[:-1], lengths), begin
