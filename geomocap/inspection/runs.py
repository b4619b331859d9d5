"""Runs, described."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from geomocap.errors import GeomocapError
from geomocap.export.run_export import FILES
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.files.atomic import remains
from geomocap.files.camera_file import read_camera_doubts
from geomocap.files.results import (
    ELLIPSOIDS,
    KEYPOINTS,
    SKELETON,
    TRACKS,
    read_by_frame,
    read_ellipsoids,
    read_keypoint_paths,
    read_skeleton,
    read_warnings,
)
from geomocap.files.run import Run
from geomocap.files.run_records import source_path
from geomocap.inspection.description import Description, count, shortened
from geomocap.subject.subject_model import MODEL_FILE, read_model


def describe_run(path: Path) -> Description:
    """Describe a run folder."""
    told, run = Description(path, "run"), Run(path)
    record: dict[str, Any] = {}
    try:
        record = run.read_record()
    except GeomocapError as error:
        told.problem(error)
    source = record.get("source", {})
    if source:
        told.fact("made from", f"{source.get('kind', '?')} {source_path(path, source)}")
        told.fact("up", source.get("up", "z"))
    if "geomocap" in record:
        told.fact("version", record["geomocap"].get("version", "?"))
    for camera in sorted(p for p in (path / "silhouettes").glob("*") if p.is_dir()):
        told.fact(f"silhouettes of {camera.name}", count(len(list(camera.glob("*.png"))), "frame"))
    for kind in ("voxels", "cloud", "bodies"):
        frames = run.frames(kind)
        if frames:
            told.fact(kind, f"{count(len(frames), 'frame')}, {frames[0]:06d} to {frames[-1]:06d}")
            missing = sorted(set(range(frames[0], frames[-1] + 1)) - set(frames))
            if missing:
                told.problem(
                    f"{kind}/ lacks {count(len(missing), 'frame')} from {missing[0]:06d} on; start the run again"
                )
    kinds = (
        (ELLIPSOIDS, _ellipsoids),
        (SKELETON, _skeleton),
        (TRACKS, _tracks),
        (KEYPOINTS, _keypoints),
        (MODEL_FILE, _model),
    )
    for name, tell in kinds:
        if run.has(name):
            try:
                tell(run, told)
            except GeomocapError as error:
                told.problem(error)
    files = [f for f in FILES.values() if (path / f).is_file()]
    told.fact("motion files", shortened(files) if files else "none")
    _warnings(run, told)
    _stages(run, told)
    return told


def _warnings(run: Run, told: Description) -> None:
    """Say what made the results doubtful when they were made."""
    try:
        for warning in (*read_camera_doubts(run).warnings, *read_warnings(run)):
            told.doubt(warning)
    except GeomocapError as error:
        told.problem(error)


def _ellipsoids(run: Run, told: Description) -> None:
    found = read_ellipsoids(run)
    bodies = count(len(np.unique(found.bodies[found.bodies >= 0])), "body", "bodies")
    told.fact("ellipsoids", f"{len(found)} in {count(found.frame_count, 'frame')}, of {bodies}")


def _skeleton(run: Run, told: Description) -> None:
    skeleton = read_skeleton(run)
    motion = motion_from_skeleton(skeleton)
    joints, rotations = skeleton.joint_positions, skeleton.body_rotations
    bodies = count(skeleton.body_count, "body", "bodies")
    told.fact("skeleton", f"{count(skeleton.joint_count, 'joint')} between {bodies}")
    told.fact("motion", f"{motion.n_frames} frames at {motion.fps:g} per second, {motion.n_frames / motion.fps:.2f} s")
    shifting = int((motion.moving & (motion.joints >= 0)).sum())
    if shifting:
        told.fact("joints not fixed in their bodies", f"{shifting}; files shift them in every frame")
    gaps = 1 - np.isfinite(joints).all(axis=-1).mean() if joints.size else 0.0
    if gaps:
        told.problem(f"joints lack a position in {100 * gaps:.1f} % of the frames; files fill them in")
    if not np.isfinite(rotations).all():
        told.problem("body rotations hold NaN; files turn evenly across them")
    elif np.abs(rotations[0] - np.eye(3)).max() > 1e-3:
        told.problem("body rotations don't begin at the identity: they aren't rotations since the first frame")


def _model(run: Run, told: Description) -> None:
    model = read_model(run.path / MODEL_FILE)
    bodies = count(model.body_count, "body", "bodies")
    told.fact(
        "subject's model", f"{count(len(model.points), 'surface point')} on {bodies}, {model.diagonal:.2f} m across"
    )


def _tracks(run: Run, told: Description) -> None:
    found = read_by_frame(run)
    length = np.bincount(found.who, minlength=found.count)
    average = length.mean() if found.count else 0.0
    told.fact("tracks", f"{found.count} points in {found.n_frames} frames, on average {average:.1f} frames long")
    if (length == 0).any():
        told.problem(f"{(length == 0).sum()} tracks have no position in any frame")


def _keypoints(run: Run, told: Description) -> None:
    points = read_keypoint_paths(run)
    told.fact("key-points", shortened(list(points.names)))
    present = np.isfinite(points.paths.positions).all(axis=-1)
    for k, name in enumerate(points.names):
        if not present[:, k].all():
            told.problem(f"key-point {name} has no position in {(~present[:, k]).sum()} of {len(present)} frames")


def _stages(run: Run, told: Description) -> None:
    for name, timing in run.read_timings().items():
        told.fact(f"time of {name}", f"{timing['seconds']:.1f} s, {timing['items_per_second']:.2f} items/s")
    for name in run.unfinished():
        told.problem(f"stage {name} isn't finished; start the run again and it goes on")
    for name, fault in run.faults().items():
        told.problem(f"{name} is {fault}; start the run again and it is made again")
    for left in remains(run.folders()):
        told.problem(f"{left.relative_to(run.path)} was left by a killed run; the next run removes it")
