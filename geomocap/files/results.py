"""The results of a run, read and written: each file here and nowhere else, as the nouns of `geomocap.model`.

Files may hold less than a stage writes, as other programs make them: what the contract of a run's folder doesn't name
is then unknown (NaN, -1, None), and what it does name is asked for in one clear line. Frame geometry is in
`frame_files`, trajectories are in `tracks_file`, what clouds say of themselves is in `cloud_records`; all is had here.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from geomocap.errors import GeometryError, RunError
from geomocap.files.array_schema import Expected, check_arrays
from geomocap.files.atomic import write_text
from geomocap.files.cloud_records import CloudRecord, read_cloud_record, write_cloud_record
from geomocap.files.frame_files import ply_count, read_points, read_voxels, write_points, write_voxels
from geomocap.files.images import read_image
from geomocap.files.npz import read_npz, write_npz
from geomocap.files.result_schemas import DIAGNOSTICS_SCHEMA, ELLIPSOIDS_SCHEMA, KEYPOINTS_SCHEMA, SKELETON_SCHEMA
from geomocap.files.run import Run
from geomocap.files.tracks_file import TRACKS, join_tracks, read_by_frame, read_tracks, read_trajectories, write_tracks
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.model.hierarchy import parents_first
from geomocap.model.keypoint_paths import KeyPointPaths, KeyPoints
from geomocap.model.skeleton import Skeleton, body_names, joint_names
from geomocap.model.trajectories import TracksByFrame, Trajectories
from geomocap.reading import read_json, reason

ELLIPSOIDS, SKELETON, KEYPOINTS = "ellipsoids.npz", "skeleton.npz", "keypoints.npz"
DIAGNOSTICS, WARNINGS = "diagnostics.npz", "diagnostics.json"

__all__ = [
    "DIAGNOSTICS",
    "ELLIPSOIDS",
    "KEYPOINTS",
    "SKELETON",
    "TRACKS",
    "WARNINGS",
    "CloudRecord",
    "join_tracks",
    "ply_count",
    "read_by_frame",
    "read_cloud_record",
    "read_diagnostics",
    "read_ellipsoids",
    "read_followed",
    "read_followed_by_frame",
    "read_keypoint_paths",
    "read_points",
    "read_silhouette",
    "read_skeleton",
    "read_tracks",
    "read_trajectories",
    "read_voxels",
    "read_warnings",
    "write_cloud_record",
    "write_diagnostics",
    "write_ellipsoids",
    "write_keypoint_paths",
    "write_points",
    "write_skeleton",
    "write_tracks",
    "write_voxels",
    "write_warnings",
]


@contextmanager
def _named(file: Path) -> Iterator[None]:
    """Say of what can't be understood which file it is in."""
    try:
        yield
    except (GeometryError, ValueError, TypeError, IndexError, KeyError, OverflowError) as error:
        raise RunError(f"{file}: {reason(error)}; delete it and run again") from None


# --- ellipsoids ---


def write_ellipsoids(run: Run, ellipsoids: Ellipsoids) -> None:
    """Write the ellipsoids (T, K, …) of a sequence with their bodies, `ellipsoids.npz`."""
    names = ("centers", "radii", "rotations", "counts", "errors")
    arrays = {name: getattr(ellipsoids, name) for name in names}
    write_npz(run.path / ELLIPSOIDS, {**arrays, "body": ellipsoids.bodies})


def read_ellipsoids(run: Run) -> Ellipsoids:
    """Read the ellipsoids of a sequence, `ellipsoids.npz`.

    Raises
    ------
    RunError
        If the file is missing, damaged, or lacks centres, radii or rotations.
    """
    file = run.path / ELLIPSOIDS
    found = read_npz(file, needed=("centers", "radii", "rotations"))
    with _named(file):
        check_arrays(found, ELLIPSOIDS_SCHEMA)
        count = found["centers"].shape[:-1]
        return Ellipsoids(
            found["centers"],
            found["radii"],
            found["rotations"],
            found.get("counts", np.ones(count, np.int32)),
            found.get("errors", np.full(count, np.nan)),
            found["body"].astype(int) if "body" in found else None,
        )


# --- skeleton ---


def write_skeleton(run: Run, skeleton: Skeleton) -> None:
    """Write a skeleton with its motion, `skeleton.npz`."""
    derived = {"root_positions": skeleton.root_positions, "local_rotations": skeleton.local_rotations}
    arrays = {f.name: np.asarray(getattr(skeleton, f.name)) for f in fields(skeleton)}
    write_npz(run.path / SKELETON, {**arrays, **derived})


def read_skeleton(run: Run) -> Skeleton:
    """Read a skeleton with its motion, `skeleton.npz`; its joints may come in any order.

    Raises
    ------
    RunError
        If the file is missing or damaged, lacks an array, arrays don't fit together, or the joints make no tree.
    """
    file = run.path / SKELETON
    needed = ("joint_positions", "joint_bodies", "body_rotations", "body_positions", "fps")
    found = read_npz(file, needed=needed)
    with _named(file):
        check_arrays(found, {"joint_bodies": Expected("J 2", "whole")} if found["joint_bodies"].size else {})
        pairs = found["joint_bodies"].astype(np.int32).reshape(-1, 2)
        joints, places = len(pairs), found["joint_positions"].astype(float)
        if not joints:
            places = np.zeros((len(found["body_positions"]), 0, 3))
        check_arrays({**found, "joint_positions": places, "joint_bodies": pairs}, SKELETON_SCHEMA)
        if places.ndim != 3 or places.shape[1] != joints or found["body_positions"].ndim != 3:
            raise GeometryError(f"joint_positions has shape {places.shape}, expected (T, {joints}, 3)")
        count = found["body_positions"].shape[1]
        names = found.get("body_names", body_names(count))
        root, order = parents_first(pairs, count)
        pairs = pairs[order]
        return Skeleton(
            places[:, order],
            pairs,
            found["joint_names"][order] if "joint_names" in found else joint_names(pairs, names),
            names,
            found["body_rotations"].astype(float),
            found["body_positions"].astype(float),
            root,
            found["offsets"][order] if "offsets" in found else np.full((joints, 3), np.nan),
            found.get("body_offsets", np.full((count, 3), np.nan)),
            bool(found.get("fixed_joints", False)),
            float(found["fps"]),
        )


# --- key-points ---


def write_keypoint_paths(run: Run, points: KeyPoints) -> Path:
    """Write followed key-points, `keypoints.npz`; return the file."""
    paths = points.paths
    arrays = {
        "names": np.array(points.names, dtype=np.str_),
        "positions": paths.positions,
        "radius": points.radius,
        "bridged": paths.bridged,
        "tracks": paths.n_tracks,
        "std": paths.std,
        "velocities": points.velocities,
        "accelerations": points.accelerations,
        "links": points.links,
        "fps": points.fps,
    }
    write_npz(run.path / KEYPOINTS, {k: np.asarray(v) for k, v in arrays.items() if v is not None})
    return run.path / KEYPOINTS


def read_keypoint_paths(run: Run) -> KeyPoints:
    """Read a run's followed key-points, `keypoints.npz`.

    Raises
    ------
    RunError
        If the file is missing, damaged, or lacks names, positions or radii.
    """
    file = run.path / KEYPOINTS
    found = read_npz(file, needed=("names", "positions", "radius"))
    with _named(file):
        check_arrays(found, KEYPOINTS_SCHEMA)
        positions, count = found["positions"], found["positions"].shape[:2]
        paths = KeyPointPaths(
            positions,
            found.get("bridged", np.zeros(count, bool)),
            found.get("tracks", np.zeros(count, int)),
            found.get("std", np.full(count, np.nan)),
        )
        return KeyPoints(
            tuple(str(name) for name in found["names"]),
            found["radius"],
            paths,
            found.get("links", np.zeros((0, 2), int)),
            found.get("velocities"),
            found.get("accelerations"),
            float(found["fps"]) if "fps" in found else None,
        )


# --- how it came about ---


def write_diagnostics(run: Run, diagnostics: Diagnostics) -> None:
    """Write how bodies and skeleton came about, `diagnostics.npz`."""
    values = {f.name: getattr(diagnostics, f.name) for f in fields(diagnostics)}
    write_npz(run.path / DIAGNOSTICS, {name: np.asarray(v) for name, v in values.items() if v is not None})


def read_diagnostics(run: Run) -> Diagnostics:
    """Read how bodies and skeleton came about, `diagnostics.npz`; nothing is known if there is no such file.

    Raises
    ------
    RunError
        If the file is damaged.
    """
    file = run.path / DIAGNOSTICS
    if not file.is_file():
        return Diagnostics()
    names = [f.name for f in fields(Diagnostics)]
    found = read_npz(file, only=names)
    with _named(file):
        check_arrays(found, DIAGNOSTICS_SCHEMA)
        values: dict[str, Any] = dict(found)
        for name, kind in (("paths", str), ("first_frame", int), ("threshold", float)):
            if name in values:
                values[name] = kind(values[name])
        return Diagnostics(**values)


def write_warnings(run: Run, warnings: Sequence[str]) -> None:
    """Write what the report says in its beginning, `diagnostics.json`."""
    write_text(run.path / WARNINGS, json.dumps({"warnings": list(warnings)}, indent=1))


def read_warnings(run: Run) -> list[str]:
    """Read what stages have to say to the user, `diagnostics.json`; none if there is no such file.

    Raises
    ------
    RunError
        If the file is damaged.
    """
    file = run.path / WARNINGS
    if not file.is_file():
        return []
    found = read_json(file, RunError)
    warnings = found.get("warnings", []) if isinstance(found, dict) else None
    if not isinstance(warnings, list):
        raise RunError(f"{file}: damaged (no list of warnings); delete it and run again")
    return [str(w) for w in warnings]


# --- whatever was followed ---


def read_followed(run: Run) -> Trajectories:
    """Read a run's trajectories; those of the surface's nodes if its bodies were found from them.

    That is so where the images had too little texture to follow patches of the surface, and for scans. Of very many
    some are read.

    Raises
    ------
    RunError
        If it has neither.
    """
    nodes = _followed_nodes(run)
    return read_trajectories(run) if nodes is None else nodes


def read_followed_by_frame(run: Run) -> TracksByFrame:
    """Read what `read_followed` does, frame by frame: all of it, however long the recording is."""
    nodes = _followed_nodes(run)
    return read_by_frame(run) if nodes is None else TracksByFrame.of(nodes)


def _followed_nodes(run: Run) -> Trajectories | None:
    found = read_diagnostics(run)
    if found.sample_positions is not None and found.paths in ("nodes", "both", "pieces", "points"):
        with _named(run.path / DIAGNOSTICS):
            return Trajectories.of_positions(found.sample_positions)
    if not run.has(TRACKS):
        raise RunError(f"{run.path}: has no {TRACKS}; run `geomocap track CAPTURE {run.path}` or `geomocap run` first")
    return None


def read_silhouette(run: Run, camera: str, frame: int) -> np.ndarray:
    """Read a silhouette, (H, W) uint8, 0 or 255."""
    return read_image(run.silhouette_file(camera, frame), gray=True)
