"""A model that is followed through the windows of a long recording, both ways from one in which its motion is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomocap.files.results import read_trajectories
from geomocap.files.run import Run
from geomocap.files.run_window import POSES, RunWindow, read_poses, write_poses
from geomocap.model.frame_geometry import Geometry, GeometryPart
from geomocap.model.motion_paths import MotionPaths
from geomocap.pipeline.job import Job
from geomocap.pipeline.path_choice import patch_paths, path_spacing
from geomocap.scheduling import map_items
from geomocap.skeleton.kinematics import BodyMotion, JointMotion
from geomocap.subject.following_settings import FollowingSettings
from geomocap.subject.model_following import FollowedSequence, follow_model
from geomocap.subject.subject_model import SubjectModel
from geomocap.subject.window_motion import joined_motion, pose_of

_LOOKS = 12  # frames of a window whose shapes are compared


def surfaces_of(geometry: Geometry, model: SubjectModel) -> Callable[[int], tuple[np.ndarray, np.ndarray | None]]:
    """Return what reads a frame's points, and their colours if the model has some, as `follow_model` takes it."""
    features = geometry.features if len(model.colors) else None
    return lambda frame: (geometry.points(frame), None if features is None else features(frame))


def shows_most(job: Job, geometry: Geometry, windows: Sequence[range]) -> int:
    """Which window shows most of how the subject moves: the one in which its shape changes most."""
    return int(np.argmax(list(map_items(_Shown(geometry), windows, job.executor, "windows", job.progress))))


@dataclass(frozen=True)
class _Shown:
    """How much the subject's shape changes within a window, metres: standard deviation of its principal extents."""

    geometry: Geometry

    def __call__(self, window: range) -> float:
        frames = np.unique(np.linspace(window.start, window.stop - 1, _LOOKS).round().astype(int))
        sizes = [np.sqrt(np.linalg.eigvalsh(np.cov(self.geometry.points(int(t)).T))) for t in frames]
        return float(np.linalg.norm(np.std(sizes, axis=0)))


def follow_windows(
    job: Job,
    geometry: Geometry,
    model: SubjectModel,
    windows: Sequence[range],
    key: int,
    start: FollowedSequence,
    has_tracks: bool,
) -> FollowedSequence:
    """Follow a model both ways from the window in which its motion is known; windows that are done stay.

    Each window begins with the pose that the one before found in the middle of what they share; there one motion goes
    over evenly into the other.

    Parameters
    ----------
    job : Job
    geometry : Geometry
        Of the whole recording.
    model : SubjectModel
    windows : sequence of range
    key : int
        The window in which the motion is known.
    start : FollowedSequence
        That motion.
    has_tracks : bool
        Whether the windows have trajectories.
    """
    sound, settings = frozenset(job.run.sound("segmentation")), job.config.following
    ways = [range(key, len(windows)), range(key, -1, -1)]
    chains = [
        _Chain(job.run, geometry, model, tuple(windows[k] for k in way), start.bodies, settings, has_tracks, sound)
        for way in ways
        if len(way) > 1
    ]
    for _ in map_items(_Chain.follow, chains, job.executor, "follow", job.progress):
        pass
    motions, distance = [], np.zeros(len(geometry))
    for k, window in enumerate(windows):
        motion, of_window = start.bodies, start.distance
        if k != key:
            rotations, translations, of_window = read_poses(job.part(window).run)
            motion = BodyMotion(rotations, translations)
        motions.append(motion)
        distance[window.start : window.stop] = of_window
    first = windows[key].start + start.first_frame
    return FollowedSequence(joined_motion(model.linkage, windows, motions), distance, first)


@dataclass(frozen=True)
class _Chain:
    """Windows through which a model is followed one after the other, from the first, in which it is known."""

    run: Run
    geometry: Geometry
    model: SubjectModel
    windows: tuple[range, ...]
    start: BodyMotion
    settings: FollowingSettings
    has_tracks: bool
    sound: frozenset[Path]

    def follow(self) -> None:
        """Follow the model through the windows that aren't done, and write its poses there."""
        before, motion = self.windows[0], self.start
        for window in self.windows[1:]:
            run = RunWindow.of(self.run, window)
            if run.path / POSES in self.sound:
                rotations, translations, _ = read_poses(run)
                motion = BodyMotion(rotations, translations)
            else:
                shared = range(max(before.start, window.start), min(before.stop, window.stop))
                middle = shared[len(shared) // 2]
                known = middle - window.start, pose_of(self.model.linkage, motion, middle - before.start)
                followed = self._window(window, known)
                motion = followed.bodies
                file = write_poses(run, motion.rotations, motion.translations, followed.distance)
                run.note("segmentation", [file])
            before = window

    def _window(self, window: range, known: tuple[int, JointMotion]) -> FollowedSequence:
        geometry = GeometryPart(self.geometry, window)
        paths: MotionPaths | None = None
        if self.has_tracks:
            paths = patch_paths(read_trajectories(RunWindow.of(self.run, window)), path_spacing(geometry))
        model, spacing = self.model, geometry.spacing
        read = surfaces_of(geometry, model)
        return follow_model(model, read, len(window), spacing, model.up, paths, self.settings, known=known)
