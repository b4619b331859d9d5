"""A long recording: bodies are found in the window that shows most, and their model is followed through the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomocap.errors import GeometryError
from geomocap.files.corrected_cameras import camera_warnings
from geomocap.files.results import (
    DIAGNOSTICS,
    ELLIPSOIDS,
    SKELETON,
    WARNINGS,
    read_diagnostics,
    read_skeleton,
    read_trajectories,
    read_warnings,
    write_diagnostics,
    write_warnings,
)
from geomocap.files.run import Run
from geomocap.files.run_window import POSES, RunWindow, read_poses, write_poses
from geomocap.model.frame_geometry import Geometry, GeometryPart
from geomocap.model.motion_paths import MotionPaths
from geomocap.pipeline.following_stage import fit_warnings, write_followed
from geomocap.pipeline.job import Job
from geomocap.pipeline.motion_stage import segment_by_motion
from geomocap.pipeline.path_choice import patch_paths
from geomocap.scheduling import map_items
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, posed
from geomocap.subject.following_settings import FollowingSettings
from geomocap.subject.model_following import FollowedSequence, follow_model
from geomocap.subject.subject_model import MODEL_FILE, SubjectModel, read_model
from geomocap.subject.window_motion import joined_motion, motion_of, pose_of

_LOOKS = 12  # frames of a window whose shapes are compared


def segment_windows(job: Job, geometry: Geometry, windows: Sequence[range], has_tracks: bool) -> int:
    """Find bodies in one window, follow them through all, write what a segmentation writes; return the frames' number.

    Raises
    ------
    GeometryError
        If the window's bodies make no model that could be followed.
    """
    shown = map_items(_Shown(geometry), windows, job.executor, "windows", job.progress)
    key = int(np.argmax(list(shown)))
    part = job.part(windows[key])
    sound = job.run.sound("segmentation")
    if not {part.run.path / name for name in (SKELETON, MODEL_FILE, DIAGNOSTICS)} <= sound:
        segment_by_motion(part, GeometryPart(geometry, windows[key]), has_tracks)
        if not part.run.has(MODEL_FILE):
            raise GeometryError(
                f"frames {windows[key].start} to {windows[key].stop - 1}: {' '.join(read_warnings(part.run))} "
                "Without a model a long recording can't be followed; set windows.frames to its length"
            )
        files = (ELLIPSOIDS, SKELETON, DIAGNOSTICS, MODEL_FILE, WARNINGS)
        job.run.note("segmentation", [f for name in files if (f := part.run.path / name).is_file()])
    model, found = read_model(part.run.path / MODEL_FILE), read_diagnostics(part.run)
    with job.run.timed("follow") as count:
        start = motion_of(read_skeleton(part.run))
        followed = _through_windows(job, geometry, model, windows, key, start, has_tracks)
        count["items"] = len(geometry) - len(windows[key])
    bodies = followed.bodies
    write_followed(job, geometry, model, bodies)
    made = replace(
        found,
        sample_positions=None,
        sample_body=None,
        sample_residuals=None,
        alternative_labels=None,
        reliability=None,
        fit_distance=followed.distance,
        first_frame=followed.first_frame,
        joint_axes=posed(model.linkage, bodies, 0).axes,
    )
    write_diagnostics(job.run, made)
    told = [*camera_warnings(job.run), *read_warnings(part.run)]
    told += fit_warnings(model, followed, job.config.following.poor_fit)
    if told:
        write_warnings(job.run, list(dict.fromkeys(told)))
    return len(geometry)


@dataclass(frozen=True)
class _Shown:
    """How much the subject's shape changes within a window, metres: what moves against what shows itself so."""

    geometry: Geometry

    def __call__(self, window: range) -> float:
        frames = np.unique(np.linspace(window.start, window.stop - 1, _LOOKS).round().astype(int))
        sizes = [np.sqrt(np.linalg.eigvalsh(np.cov(self.geometry.points(int(t)).T))) for t in frames]
        return float(np.linalg.norm(np.std(sizes, axis=0)))


def _through_windows(
    job: Job,
    geometry: Geometry,
    model: SubjectModel,
    windows: Sequence[range],
    key: int,
    start: BodyMotion,
    has_tracks: bool,
) -> FollowedSequence:
    """Follow a model both ways from the window in which its motion is known."""
    sound = job.run.sound("segmentation")
    ways = [list(range(key, len(windows))), list(range(key, -1, -1))]
    chains = [
        _Chain(job.run, geometry, model, [windows[k] for k in way], start, job.config.following, has_tracks, sound)
        for way in ways
        if len(way) > 1
    ]
    for _ in map_items(_follow_chain, chains, job.executor, "follow", job.progress):
        pass
    motions, distances = [], []
    for k, window in enumerate(windows):
        if k == key:
            motions.append(start)
            distances.append(np.zeros(len(window)))
            continue
        rotations, translations, distance = read_poses(job.part(window).run)
        motions.append(BodyMotion(rotations, translations))
        distances.append(distance)
    distance = np.zeros(len(geometry))
    for window, of_window in zip(windows, distances, strict=True):
        distance[window.start : window.stop] = of_window
    return FollowedSequence(joined_motion(model.linkage, windows, motions), distance, windows[key].start)


@dataclass(frozen=True)
class _Chain:
    """Windows through which a model is followed one after the other, from the first, in which it is known."""

    run: Run
    geometry: Geometry
    model: SubjectModel
    windows: list[range]
    start: BodyMotion
    settings: FollowingSettings
    has_tracks: bool
    sound: set


def _follow_chain(chain: _Chain) -> None:
    before, motion = chain.windows[0], chain.start
    for window in chain.windows[1:]:
        run = RunWindow.of(chain.run, window)
        if run.path / POSES in chain.sound:
            rotations, translations, _ = read_poses(run)
            motion = BodyMotion(rotations, translations)
        else:
            shared = range(max(before.start, window.start), min(before.stop, window.stop))
            middle = shared[len(shared) // 2]
            known = middle - window.start, pose_of(chain.model.linkage, motion, middle - before.start)
            followed = _follow_window(chain, window, known)
            motion = followed.bodies
            file = write_poses(run, motion.rotations, motion.translations, followed.distance)
            run.note("segmentation", [file])
        before = window


def _follow_window(chain: _Chain, window: range, known: tuple[int, JointMotion]) -> FollowedSequence:
    geometry = GeometryPart(chain.geometry, window)
    features = geometry.features if len(chain.model.colors) else None

    def read(frame: int) -> tuple[np.ndarray, np.ndarray | None]:
        return geometry.points(frame), None if features is None else features(frame)

    paths: MotionPaths | None = None
    if chain.has_tracks:
        paths = patch_paths(read_trajectories(RunWindow.of(chain.run, window)))
    model, spacing = chain.model, geometry.spacing
    return follow_model(model, read, len(window), spacing, model.up, paths, chain.settings, known=known)
