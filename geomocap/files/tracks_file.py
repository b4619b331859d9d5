"""The trajectories of a run, `tracks.npz`, in either layout: all frames of each, or one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np

from geomocap.errors import GeometryError, RunError
from geomocap.files.array_schema import check_arrays
from geomocap.files.npz import read_npz, write_npz
from geomocap.files.ragged_arrays import spread_over_frames
from geomocap.files.result_schemas import TRACKS_SCHEMA
from geomocap.files.run import Run
from geomocap.model.trajectories import REASONS, PathDerivatives, Tracks, Trajectories
from geomocap.reading import reason

TRACKS = "tracks.npz"
_OF_TRAJECTORIES = ("sigma", "correlation", "n_views", "ray", "normals", "placed", "end_reason", "begin_reason")
_OF_MOTION = ("velocities", "accelerations", "velocity_std", "acceleration_std")
_LAYOUT = ("layout", "first", "start", "end", "n_frames", "sight")
_BY_FRAME = ("positions", "sigma", "correlation", "n_views", "ray", "sight", *_OF_MOTION)
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


def read_trajectories(run: Run) -> Trajectories:
    """Read the trajectories only, of which but the positions must be there.

    Raises
    ------
    RunError
        If the file is missing, damaged or has no positions.
    """
    return _trajectories(run, _arrays(run, _OF_TRAJECTORIES))


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
    found = read_npz(run.path / TRACKS, ("positions", *_LAYOUT, *names), needed)
    if str(found.get("layout", "")) == "ragged":
        try:
            found |= _dense(found)
        except (KeyError, IndexError, ValueError, TypeError, OverflowError, MemoryError) as error:
            raise _useless(run, error) from None
    if "sight" in found:  # as files of older versions call it
        found.setdefault("ray", found["sight"])
    try:
        check_arrays(found, TRACKS_SCHEMA)
    except GeometryError as error:
        raise _useless(run, error) from None
    return found


def _dense(found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Give trajectories that stand one after the other all their frames."""
    layout = found["first"], found["start"], int(found["n_frames"])
    return {name: spread_over_frames(found[name], *layout, name in _COUNTED) for name in _BY_FRAME if name in found}


def _trajectories(run: Run, found: dict[str, np.ndarray]) -> Trajectories:
    try:
        known = {name: found[name] for name in _OF_TRAJECTORIES if name in found}
        return Trajectories.of_positions(found["positions"], **known)
    except GeometryError as error:
        raise _useless(run, error) from None


def _useless(run: Run, error: Exception) -> RunError:
    why = f"lacks {error}" if isinstance(error, KeyError) else reason(error)
    return RunError(f"{run.path / TRACKS}: {why}; delete it and run `geomocap track` again")
