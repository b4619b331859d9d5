"""Key-points: regions that somebody placed on the surface, followed by the trajectories inside.

Written as `keypoints.npz`, `keypoints.trc` and, where its package is installed, `keypoints.c3d`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from geomocap.errors import RunError
from geomocap.export.c3d import write_c3d
from geomocap.export.export_errors import MissingPackageError
from geomocap.export.markers import keypoint_markers
from geomocap.export.run_export import run_up
from geomocap.export.trc import write_trc
from geomocap.files.results import SKELETON, read_followed_by_frame, read_skeleton, write_keypoint_paths
from geomocap.files.run import Run
from geomocap.keypoints.keypoint_regions import KeyPointFile, follow_placed
from geomocap.model.keypoint_paths import KeyPoints
from geomocap.pipeline.derived import KEYPOINT_FILES

_STAGE = "keypoints"


@dataclass(frozen=True)
class FollowedKeyPoints:
    """What was written: the key-points, the files, and why one is missing."""

    points: KeyPoints
    files: tuple[Path, ...]
    skipped: tuple[str, ...] = ()


def keypoints(run: Run, file: KeyPointFile) -> FollowedKeyPoints:
    """Follow key-points through a run's trajectories and write them as `keypoints.npz`, `.trc` and `.c3d`.

    Raises
    ------
    RunError
        If the run has no trajectories, the frame rate isn't known, or a file can't be written.
    GeometryError
        If there are no key-points, or one is placed in a frame that isn't there or where no trajectories are.
    """
    points = follow_placed(read_followed_by_frame(run), file, run_fps(run))
    stored, trc, c3d = write_keypoint_paths(run, points), run.path / "keypoints.trc", run.path / "keypoints.c3d"
    markers = keypoint_markers(points, run_fps(run), run_up(run))
    write_trc(trc, markers)
    try:
        write_c3d(c3d, markers)
    except MissingPackageError as error:
        c3d.unlink(missing_ok=True)
        found = FollowedKeyPoints(points, (stored, trc), (str(error),))
    else:
        found = FollowedKeyPoints(points, (stored, trc, c3d))
    run.begin(_STAGE, _STAGE, ())  # always made anew, so that its key says nothing
    run.finish(_STAGE, [file.name for file in found.files])
    return found


def clear_results(run: Run) -> None:
    """Delete what `keypoints` wrote, so that nothing stale is left."""
    for name in KEYPOINT_FILES:
        (run.path / name).unlink(missing_ok=True)
    run.forget(_STAGE)


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
    if run.has(SKELETON):
        return read_skeleton(run).fps
    raise RunError(f"{run.path}: its frame rate isn't known; run.toml has no source.fps above 0")
