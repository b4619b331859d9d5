"""The trajectories of a run, `tracks.npz`, in either layout: all frames of each, or one after the other ("ragged").

Those of a long recording stand one after the other, each with the frames of its own life, so that the file grows with
what was measured; so many are never spread over all frames at once: of these every k-th is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geomocap.errors import GeometryError, RunError
from geomocap.files.array_schema import Expected, check_arrays
from geomocap.files.npz import read_npz, write_npz, write_npz_parts
from geomocap.files.ragged_arrays import (
    check_layout,
    frames_of,
    one_after_the_other,
    rows_of,
    some_of,
    spread_over_frames,
)
from geomocap.files.result_schemas import TRACKS_SCHEMA
from geomocap.files.run import Run
from geomocap.model.trajectories import REASONS, PathDerivatives, Tracks, TracksByFrame, Trajectories
from geomocap.reading import reason

TRACKS = "tracks.npz"
_OF_TRAJECTORIES = ("sigma", "correlation", "n_views", "ray", "normals", "placed", "end_reason", "begin_reason")
_OF_MOTION = ("velocities", "accelerations", "velocity_std", "acceleration_std")
_BY_FRAME = ("positions", "sigma", "correlation", "n_views", "ray", "sight", *_OF_MOTION)
_ONE_AFTER_THE_OTHER = {"positions": Expected("M 3", gaps=True), "sigma": Expected("M", gaps=True)}
_COUNTED = ("n_views", "ray", "sight")  # 0 where nothing was measured, the others NaN


def write_tracks(run: Run, tracks: Tracks) -> None:
    """Write trajectories with their motion, and what they were before the filters."""
    followed = tracks.trajectories
    arrays: dict[str, Any] = {"positions": followed.positions, "start": followed.start, "end": followed.end}
    arrays |= {name: getattr(followed, name) for name in _OF_TRAJECTORIES}
    arrays |= {name: getattr(tracks.motion, name) for name in _OF_MOTION}
    arrays |= {"ray": followed.ray.astype(np.float32), "reasons": list(REASONS)}
    arrays |= {"unfiltered": tracks.unfiltered, "kept": tracks.kept}
    write_npz(run.path / TRACKS, {name: value for name, value in arrays.items() if value is not None})


def join_tracks(run: Run, windows: Sequence[Run], frames: Sequence[range], n_frames: int) -> None:
    """Join the trajectories of a recording's windows into the file of the whole, reading one window at a time.

    Those of frames that two windows share are there twice, as each window followed them.

    Parameters
    ----------
    run : Run
    windows : sequence of Run
        In which `tracks.npz` of each window is.
    frames : sequence of range
        Frames of each window, of those of the recording.
    n_frames : int
        Number of the recording's frames.
    """
    names = ("start", "end")
    lives = [(found["start"], found["end"]) for found in (read_npz(w.path / TRACKS, names, names) for w in windows)]
    lengths = [np.maximum(end - start + 1, 0) for start, end in lives]
    count, rows = sum(map(len, lengths)), int(sum(n.sum() for n in lengths))

    def parts(name: str) -> Iterator[np.ndarray]:
        for w, part in enumerate(windows):
            found = read_npz(part.path / TRACKS, (name,), (name,))[name]
            if name in _BY_FRAME:
                yield one_after_the_other(found, *lives[w])
            else:
                yield found + frames[w].start if name in ("start", "end", "placed") else found

    long, short = np.dtype(np.int64), np.dtype(np.float32)
    whole = ("n_views", "placed", "start", "end", "end_reason", "begin_reason")
    by_frame = ("positions", "sigma", "correlation", "n_views", "ray", *_OF_MOTION)
    arrays: dict[str, tuple[np.dtype, int | None, Iterable[np.ndarray]]] = {}
    for name in by_frame:
        arrays[name] = np.dtype(np.int16) if name in whole else short, rows, parts(name)
    for name in ("start", "end", "placed", "normals", "end_reason", "begin_reason"):
        arrays[name] = long if name in whole else short, count, parts(name)
    first = np.concatenate([[0], np.cumsum(np.concatenate(lengths))])
    given = {"layout": np.array("ragged"), "first": first, "n_frames": np.array(n_frames), "reasons": np.array(REASONS)}
    arrays |= {name: (value.dtype, None, [value]) for name, value in given.items()}
    write_npz_parts(run.path / TRACKS, arrays)


def read_trajectories(run: Run) -> Trajectories:
    """Read the trajectories only, of which but the positions must be there.

    Raises
    ------
    RunError
        If the file is missing, damaged or has no positions.
    """
    return _trajectories(run, _arrays(run, _OF_TRAJECTORIES))


def read_by_frame(run: Run) -> TracksByFrame:
    """Read all positions, frame by frame, however many trajectories there are.

    Raises
    ------
    RunError
        If the file is missing, damaged or has no positions.
    """
    file = run.path / TRACKS
    if str(read_npz(file, ("layout",)).get("layout", "")) != "ragged":
        return TracksByFrame.of(read_trajectories(run))
    needed = ("first", "start", "n_frames", "positions")
    found = read_npz(file, (*needed, "sigma"), needed)
    try:
        positions, first, start = found["positions"], found["first"], found["start"]
        frames = int(found["n_frames"])
        check_layout(first, start, frames, len(positions))
        sigma = found.get("sigma", np.full(len(positions), np.nan))
        check_arrays({"positions": positions, "sigma": sigma}, _ONE_AFTER_THE_OTHER)
        frame = frames_of(first, start, frames)
    except (GeometryError, IndexError, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise _useless(run, error) from None
    rows = np.flatnonzero(np.isfinite(positions).all(axis=1))
    rows = rows[np.argsort(frame[rows], kind="stable")]
    who = np.repeat(np.arange(len(start)), np.diff(first))[rows]
    begin = np.searchsorted(frame[rows], np.arange(frames + 1))
    return TracksByFrame(who, positions[rows], sigma[rows], begin, len(start))


def read_tracks(run: Run) -> Tracks:
    """Read trajectories with their motion, and what they were before the filters, as far as it is there.

    Raises
    ------
    RunError
        If the file is missing, damaged or has no positions or velocities.
    """
    found = _arrays(run, (*_OF_TRAJECTORIES, *_OF_MOTION, "unfiltered", "kept"), ("positions", "velocities"))
    trajectories = _trajectories(run, found)
    unknown = np.broadcast_to(np.nan, trajectories.positions.shape)
    defaults = (unknown, unknown, unknown[..., 0], unknown[..., 0])
    motion = PathDerivatives(*(found.get(n, d) for n, d in zip(_OF_MOTION, defaults, strict=True)))
    try:
        return Tracks(trajectories, motion, found.get("unfiltered"), found.get("kept"))
    except GeometryError as error:
        raise _useless(run, error) from None


def _arrays(run: Run, names: tuple[str, ...], needed: tuple[str, ...] = ("positions",)) -> dict[str, np.ndarray]:
    """Arrays of those names with the positions, (N, T, …) whatever the layout."""
    file = run.path / TRACKS
    if str(read_npz(file, ("layout",)).get("layout", "")) == "ragged":
        try:
            found = _spread(file, ("positions", *names), needed)
        except (KeyError, IndexError, ValueError, TypeError, OverflowError, MemoryError) as error:
            raise _useless(run, error) from None
    else:
        found = read_npz(file, ("positions", "sight", *names), needed)
    if "sight" in found:  # as files of older versions call it
        found.setdefault("ray", found["sight"])
    try:
        check_arrays(found, TRACKS_SCHEMA)
    except GeometryError as error:
        raise _useless(run, error) from None
    return found


def _spread(file: Path, names: tuple[str, ...], needed: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Give trajectories that stand one after the other all their frames, one array after the other; of many some."""
    layout = read_npz(file, ("first", "start", "n_frames"), ("first", "start", "n_frames"))
    first, start, frames = layout["first"], layout["start"], int(layout["n_frames"])
    found, rows = {}, None
    for name in (*names, "sight"):
        values = read_npz(file, (name,), (name,) if name in needed else ()).get(name)
        if rows is None and values is not None:  # positions
            check_layout(first, start, frames, len(values))
            chosen = some_of(first, start, frames)
            rows, begin = rows_of(first, chosen)
        if values is not None and name in _BY_FRAME:
            found[name] = spread_over_frames(values[rows], begin, start[chosen], frames, name in _COUNTED)
        elif values is not None:
            found[name] = values if name == "unfiltered" else values[chosen]
    return found


def _trajectories(run: Run, found: dict[str, np.ndarray]) -> Trajectories:
    try:
        known = {name: found[name] for name in _OF_TRAJECTORIES if name in found}
        return Trajectories.of_positions(found["positions"], **known)
    except GeometryError as error:
        raise _useless(run, error) from None


def _useless(run: Run, error: Exception) -> RunError:
    why = f"lacks {error}" if isinstance(error, KeyError) else reason(error)
    return RunError(f"{run.path / TRACKS}: {why}; delete it and run `geomocap track` again")
