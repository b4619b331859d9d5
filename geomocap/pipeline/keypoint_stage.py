"""Key-points: regions that somebody placed on the surface, followed by the trajectories inside.

Written as `keypoints.npz`, `keypoints.trc` and, where its package is installed, `keypoints.c3d`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomocap.errors import RunError
from geomocap.export.c3d import write_c3d
from geomocap.export.export_errors import MissingPackageError
from geomocap.export.markers import Markers, keypoint_markers
from geomocap.export.run_export import run_up
from geomocap.export.trc import write_trc
from geomocap.files.run import Run
from geomocap.keypoints.keypoint_following import REACH, KeyPointPaths, Measured
from geomocap.keypoints.keypoint_regions import KeyPointFile, follow_regions
from geomocap.model.trajectories import LAST_FRAME, Trajectories
from geomocap.pipeline.derived import KEYPOINT_FILES
from geomocap.trajectories.smoothing import smooth_motion


@dataclass(frozen=True)
class FollowedKeyPoints:
    """What was written: the paths, the files, and why one is missing."""

    paths: KeyPointPaths
    files: tuple[Path, ...]
    skipped: tuple[str, ...] = ()


def keypoints(run: Run, file: KeyPointFile) -> FollowedKeyPoints:
    """Follow key-points through a run's trajectories and write them.

    Raises
    ------
    RunError
        If the run has no trajectories, there are no key-points, one is placed in a frame that isn't there or where no
        trajectories are, or the frame rate isn't known.
    """
    measured = Measured.of(run_trajectories(run))
    if not file.keypoint:
        raise RunError(f"{run.path}: no key-points are given; add [[keypoint]] tables, or place them with --edit")
    for p in file.keypoint:
        if p.frame >= len(measured.places):
            last = len(measured.places) - 1
            raise RunError(f"key-point {p.name}: placed in frame {p.frame}, but {run.path} has frames 0 to {last}")
    paths = follow_regions(measured, file.keypoint)
    for k, p in enumerate(file.keypoint):
        if paths.n_tracks[p.frame, k] == 0:
            reach = 1000 * REACH * p.radius
            raise RunError(
                f"key-point {p.name}: no trajectory within {reach:.0f} mm ({REACH:g} radii) of its centre in frame "
                f"{p.frame}; move it onto the surface, enlarge it, or place it in a frame where trajectories run there"
            )
    return write_results(run, file, paths)


def write_results(run: Run, file: KeyPointFile, paths: KeyPointPaths) -> FollowedKeyPoints:
    """Write followed key-points as `keypoints.npz`, `.trc` and `.c3d`.

    Raises
    ------
    RunError
        If the frame rate isn't known, or a file can't be written.
    """
    fps = run_fps(run)
    motion = smooth_motion(paths.positions.transpose(1, 0, 2), fps)
    names = file.names
    arrays = {
        "names": np.array(names),
        "positions": paths.positions,
        "radius": np.array([p.radius for p in file.keypoint]),
        "bridged": paths.bridged,
        "tracks": paths.n_tracks,
        "std": paths.std,
        "velocities": motion.velocities.transpose(1, 0, 2),
        "accelerations": motion.accelerations.transpose(1, 0, 2),
        "links": np.array([[names.index(n) for n in link] for link in file.links], int).reshape(-1, 2),
        "fps": np.array(fps),
    }
    run.write_npz("keypoints.npz", **arrays)
    markers = keypoint_markers(arrays, fps, run_up(run))
    return FollowedKeyPoints(paths, *_write_motion(run, markers))


def clear_results(run: Run) -> None:
    """Delete what `keypoints` wrote, so that nothing stale is left."""
    for name in KEYPOINT_FILES:
        (run.path / name).unlink(missing_ok=True)


def _write_motion(run: Run, markers: Markers) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    trc, c3d = run.path / "keypoints.trc", run.path / "keypoints.c3d"
    write_trc(trc, markers)
    try:
        write_c3d(c3d, markers)
    except MissingPackageError as error:
        c3d.unlink(missing_ok=True)
        return (run.path / "keypoints.npz", trc), (str(error),)
    return (run.path / "keypoints.npz", trc, c3d), ()


def run_fps(run: Run) -> float:
    """Return a run's frames per second, as its record or its skeleton says.

    Raises
    ------
    RunError
        If neither does.
    """
    if (run.path / "run.toml").is_file():
        fps = run.read_record().get("source", {}).get("fps")
        if isinstance(fps, int | float) and fps > 0:
            return float(fps)
    if (run.path / "skeleton.npz").is_file() and "fps" in (arrays := run.read_npz("skeleton.npz")):
        return float(arrays["fps"])
    raise RunError(f"{run.path}: its frame rate isn't known; run.toml has no source.fps above 0")


def run_trajectories(run: Run) -> Trajectories:
    """Read a run's trajectories; those of the surface's nodes if its bodies were found from them.

    That is so where the images had too little texture to follow patches of the surface, and for scans.

    Raises
    ------
    RunError
        If it has neither.
    """
    if (run.path / "diagnostics.npz").is_file():
        found = run.read_npz("diagnostics.npz")
        if "sample_positions" in found and str(found.get("paths", "")) in ("nodes", "both", "pieces", "points"):
            return trajectories_of({"positions": found["sample_positions"]}, run.path / "diagnostics.npz")
    if not (run.path / "tracks.npz").exists():
        raise RunError(
            f"{run.path}: has no tracks.npz; run `geomocap track CAPTURE {run.path}` or `geomocap run` first"
        )
    return trajectories_of(run.read_npz("tracks.npz"), run.path / "tracks.npz")


def trajectories_of(arrays: dict[str, np.ndarray], source: Path | str = "tracks.npz") -> Trajectories:
    """Make trajectories of the arrays of `tracks.npz`, of which only the positions must be there.

    Raises
    ------
    RunError
        If they aren't.
    """
    if "positions" not in arrays or arrays["positions"].ndim != 3 or arrays["positions"].shape[2] != 3:
        raise RunError(f"{source}: holds no array positions of shape (N, T, 3); run `geomocap track` again")
    positions = arrays["positions"]
    N, T = positions.shape[:2]
    nothing = np.zeros(N, int)
    return Trajectories(
        positions,
        np.full((N, T, 3, 3), np.nan),
        np.asarray(arrays.get("sigma", np.full((N, T), np.nan)), np.float64),
        arrays.get("correlation", np.full((N, T), np.nan)),
        arrays.get("n_views", np.isfinite(positions[:, :, 0]).astype(int)),
        arrays.get("ray", np.zeros((N, T, 3))),
        arrays.get("normals", np.zeros((N, 3))),
        arrays.get("placed", nothing),
        arrays.get("end_reason", np.full(N, LAST_FRAME)),
        arrays.get("begin_reason", np.full(N, LAST_FRAME)),
    )
