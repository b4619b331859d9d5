"""A run's joints against another system's markers or joints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from geomocap.evaluation.alignment import align_trajectories
from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.marker_track import MarkerTrack
from geomocap.evaluation.result import Alignment, Curve, Evaluation, EvaluationError, Match
from geomocap.export.bvh import read_bvh
from geomocap.export.c3d import read_c3d
from geomocap.export.conventions import Axis, Convention, Unit
from geomocap.export.markers import Markers
from geomocap.export.trc import read_trc
from geomocap.reading import read_toml

OTHER_UNITS = 20.0  # times as large, or as small: the lengths are in other units


def read_motion_file(path: Path, *, unit: Unit = "m", up: Axis | None = None) -> Markers:
    """Read markers, or the joints of a BVH, in metres and the file's axes.

    Parameters
    ----------
    path : Path
        C3D, TRC or BVH.
    unit : "m", "cm" or "mm"
        Of a BVH, which can't say it itself.
    up : "x", "y" or "z", optional
        The file's axis that points up, where it isn't the format's custom.

    Raises
    ------
    MotionError
        If it can't be read.
    EvaluationError
        If it is of another kind.
    """
    ending = path.suffix.lower()
    if ending == ".c3d":
        return read_c3d(path, up=up)
    if ending == ".trc":
        return read_trc(path, up=up or "y")
    if ending == ".bvh":
        motion = read_bvh(path, up=up or "y", unit=unit)
        return Markers(motion.names, motion.forward_kinematics()[1], motion.fps, motion.up)
    raise EvaluationError(f"{path}: no truth; expected a folder with truth.npz, or a .c3d, .trc or .bvh file")


def read_matches(path: Path) -> dict[str, str]:
    """Read a TOML of `joint = "marker"` lines.

    Raises
    ------
    EvaluationError
        If it can't be read or a marker stands twice.
    """
    table = read_toml(path, EvaluationError)
    for joint, marker in table.items():
        if not isinstance(marker, str):
            raise EvaluationError(f"{path}: {joint} = {marker!r}; expected the name of a marker in quotes")
        if list(table.values()).count(marker) > 1:
            raise EvaluationError(f"{path}: {marker} stands for two joints; each marker matches one")
    return table


def compare_markers(
    found: Markers, other: Markers, settings: EvaluationSettings, *, matches: Mapping[str, str] | None = None
) -> Evaluation:
    """Compare found joints with another system's markers.

    The other system's axes are turned so that up is up. With `settings.find_offset` and `settings.align` its clock and
    world are brought onto the run's first. Joints and markers are matched by name where a table says so or they share
    names, otherwise one to one by their mean distance.

    Parameters
    ----------
    found, other : Markers
    settings : EvaluationSettings
    matches : mapping of found to other name, optional

    Raises
    ------
    EvaluationError
        If they don't overlap in time, are in other units, or nothing matches.
    """
    truth = Convention(other.up, "m").world_points(other.positions, found.up)
    _check_present(found, "the run")
    _check_present(other, "the other system")
    diagonal, theirs = _diagonal(found.positions), _diagonal(truth)
    if not 1 / OTHER_UNITS < theirs / diagonal < OTHER_UNITS:
        raise EvaluationError(
            f"the other system's points span {theirs:.4g} m, the run's {diagonal:.4g} m; one of them is in other units"
        )
    pairs = _named_pairs(found.names, other.names, matches)
    times = np.arange(found.n_frames) / found.fps
    track = MarkerTrack(truth, other.fps)
    alignment = align_trajectories(found.positions, times, track, settings, diagonal, pairs)
    moved = track.at(times + alignment.time_offset) @ alignment.rotation.T + alignment.translation
    both = np.isfinite(moved).all(-1).any(1) & np.isfinite(found.positions).all(-1).any(1)
    if both.sum() < 2:
        raise EvaluationError(
            f"run and truth overlap in {int(both.sum())} frames at a time offset of {alignment.time_offset:.3f} s; "
            "state or look for the offset (--offset, --find_offset)"
        )
    distance = pair_distances(found.positions, moved)
    if pairs is None:
        pairs = match_by_distance(distance, settings.match_within * diagonal)
    pairs = [(i, j) for i, j in pairs if np.isfinite(distance[:, i, j]).any()]
    if not pairs:
        raise EvaluationError(
            f"no joint lies within {settings.match_within * diagonal * 1000:.0f} mm of a marker; the worlds or clocks "
            "differ (--align, --find_offset), or name the pairs in a TOML (--matches)"
        )
    return _judge(found, other, distance, pairs, alignment, settings, diagonal)


def pair_distances(found: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances (T, J, K) between all joints (T, J, 3) and markers (T, K, 3); NaN where one is missing."""
    return np.linalg.norm(found[:, :, None] - other[:, None], axis=-1)


def match_by_distance(distance: np.ndarray, limit: float) -> list[tuple[int, int]]:
    """Match one to one so that the sum of mean distances over time is least; none beyond `limit` metres."""
    seen = np.isfinite(distance).sum(axis=0)
    mean = np.where(seen > 0, np.nansum(distance, axis=0) / np.maximum(seen, 1), np.inf)
    row, column = linear_sum_assignment(np.minimum(mean, limit))
    return [(int(i), int(j)) for i, j in zip(row, column, strict=True) if mean[i, j] < limit]


def _named_pairs(
    found: tuple[str, ...], other: tuple[str, ...], matches: Mapping[str, str] | None
) -> list[tuple[int, int]] | None:
    """Pairs by table or by equal names; None if names say nothing."""
    if matches is not None:
        for joint, marker in matches.items():
            if joint not in found:
                raise EvaluationError(f"matches: the run has no joint {joint}; it has {', '.join(found)}")
            if marker not in other:
                raise EvaluationError(f"matches: the truth has no marker {marker}; it has {', '.join(other)}")
        return [(found.index(i), other.index(j)) for i, j in matches.items()]
    same = [(i, other.index(n)) for i, n in enumerate(found) if n in other]
    return same if len(same) >= 3 else None


def _check_present(markers: Markers, whose: str) -> None:
    if not markers.present.any():
        raise EvaluationError(f"{whose} has no position in any frame; there is nothing to compare")


def _diagonal(positions: np.ndarray) -> float:
    """Median over time of the largest side of the box around the points, metres."""
    seen = np.isfinite(positions).all(axis=-1)
    frames = seen.sum(axis=1) > 0
    boxes = np.nanmax(positions[frames], axis=1) - np.nanmin(positions[frames], axis=1)
    return max(float(np.median(boxes.max(axis=1))), 1e-6)


def _judge(
    found: Markers,
    other: Markers,
    distance: np.ndarray,
    pairs: list[tuple[int, int]],
    alignment: Alignment,
    settings: EvaluationSettings,
    diagonal: float,
) -> Evaluation:
    each = np.stack([distance[:, i, j] for i, j in pairs]) * 1000
    seen = np.isfinite(each)
    all_of_them = each[seen]
    figures: dict[str, float] = {
        "markers.found": len(found.names),
        "markers.true": len(other.names),
        "markers.matched": len(pairs),
        "markers.frames_compared": int(seen.any(axis=0).sum()),
        "markers.mean_error": float(all_of_them.mean()),
        "markers.median_error": float(np.median(all_of_them)),
        "markers.p95_error": float(np.percentile(all_of_them, 95)),
        "markers.mean_error_%diagonal": float(all_of_them.mean() / 10 / diagonal),
    }
    if settings.find_offset:
        figures["alignment.time_offset_s"] = alignment.time_offset
        figures["alignment.time_offset_frames"] = alignment.time_offset * found.fps
    if settings.align:
        figures["alignment.rotation_deg"] = alignment.angle_deg
        figures["alignment.translation"] = float(np.linalg.norm(alignment.translation) * 1000)
    frames = np.flatnonzero(seen.any(axis=0))
    mean = np.nanmean(each[:, frames], axis=0)
    curves = [Curve("markers: mean distance of the matched ones", "mm", frames, mean)]
    matches = []
    for (i, j), d, s in zip(pairs, each, seen, strict=True):
        matches.append(
            Match(found.names[i], other.names[j], float(d[s].mean()), float(np.percentile(d[s], 95)), int(s.sum()))
        )
        curves.append(Curve(f"{other.names[j]}: distance of {found.names[i]}", "mm", np.flatnonzero(s), d[s]))
    return Evaluation(figures, tuple(curves), tuple(matches), alignment)
