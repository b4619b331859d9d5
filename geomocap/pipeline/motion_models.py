"""Models of motions that were found, and how well these explain the silhouettes and the paths they come from."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.evaluation.result_check import SeenOutlines, checked_mesh, model_overlap
from geomocap.model.frame_geometry import Geometry, GeometryPart
from geomocap.model.motion_paths import MotionPaths
from geomocap.motion import Motion
from geomocap.nodes.surface_coverage import SMALLEST_PIECE
from geomocap.pipeline.job import Job
from geomocap.pipeline.window_following import surfaces_of
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, body_motion, joint_motion
from geomocap.subject.model_building import BodyCloud, build_model
from geomocap.subject.model_following import fit_motion
from geomocap.subject.subject_model import SubjectModel
from geomocap.subject.window_motion import joined_motion, motion_of

# Power of what the paths miss, beside what the model's drawn surface misses of the silhouettes. Of two results each of
# fourteen sets of paths, of thirteen captures, the better was taken with any power from 0.15 to 0.48 in twelve, with
# 0.5 in eleven, with 0 in nine; in one of the others neither was better. All had been looked at before it was set.
_PATHS = 0.3
_GOING_OVER = 3  # frames in which a motion goes over into the fit, and back; no other number was tried


def make_model(job: Job, geometry: Geometry, motion: Motion) -> SubjectModel | str:
    """Make the model of a motion's subject; in words why, if it can't be made."""

    def read(frame: int) -> BodyCloud:
        points = geometry.points(frame)
        colors = geometry.features(frame) if geometry.features is not None else None
        return BodyCloud(points, motion.label(frame, points), colors)

    try:
        with job.run.timed("model") as count:
            model = build_model(motion.connected, motion.bodies, read, geometry.spacing, job.up_axis)
            count["items"] = len(model.points)
    except GeometryError as error:
        return str(error)
    return model


def silhouette_overlap(job: Job, model: SubjectModel, motion: Motion) -> float:
    """Overlap of a motion's model, drawn into the cameras, with the silhouettes: intersection over union, mean."""
    assert job.capture is not None
    return model_overlap(SeenOutlines.of(job.run, job.capture), checked_mesh(model), motion_of(motion.skeleton))


def misfit(motion: Motion, overlap: float) -> float:
    """How badly a motion explains the silhouettes, which its model overlaps so much, and the paths it was found from.

    Only its ratio to that of another motion of the same recording means something. Silhouettes alone say little of what
    lies before the trunk in all views, and of two bodies that are one; paths that contradict each other are wrong.
    """
    return (1.0 - overlap) * float(motion.bodies.residuals.mean()) ** _PATHS


def fitted_to_surfaces(
    job: Job, geometry: Geometry, model: SubjectModel, motion: Motion, paths: MotionPaths
) -> tuple[BodyMotion, int] | None:
    """Fit a motion's model to the surfaces where no path shows some body: its motion then, and in how many frames.

    A surface alone knows less than paths do where these are: the other frames stay as they were found. (Overlap of a
    person on a treadmill, four cameras, by a fit of all frames: 0.735 → 0.774 where paths didn't show some body, 0.828
    → 0.803 elsewhere; of a stag, a dwarf and a horse it fell everywhere.) A stretch of frames is taken from the fit if
    the model then overlaps their silhouettes more, by at least what the smallest piece of a surface is. `paths` are
    those that the motion was found from. None: nothing is to be fitted, or no fit is kept.
    """
    unseen = (motion.bodies.reliability == 0).any(axis=1)
    if job.capture is None or not unseen.any():
        return None
    found = joint_motion(model.linkage, motion.skeleton.body_rotations, motion.skeleton.root_positions)
    bodies, kept = body_motion(model.linkage, found), 0
    with job.run.timed("fit") as count:
        seen, mesh = SeenOutlines.of(job.run, job.capture), checked_mesh(model)
        for stretch in _stretches(unseen):
            fit = _fitted(job, geometry, model, found, stretch, paths)
            if fit is None:
                continue
            after = _put_in(model.linkage, bodies, stretch, fit)
            least = model_overlap(seen, mesh, bodies, stretch) + SMALLEST_PIECE
            if model_overlap(seen, mesh, after, stretch) >= least:
                bodies, kept = after, kept + len(stretch)
        count["items"] = int(unseen.sum())
    return (bodies, kept) if kept else None


def _stretches(unseen: np.ndarray) -> list[range]:
    """Stretches of frames that are marked, (T,) bool, with those between them that are too few to go over in."""
    found: list[range] = []
    for t in np.flatnonzero(unseen).tolist():
        if found and t - found[-1].stop < 2 * _GOING_OVER:
            found[-1] = range(found[-1].start, t + 1)
        else:
            found.append(range(t, t + 1))
    return found


def _around(stretch: range, frames: int) -> range:
    """Return a stretch with the frames in which one motion goes over into the other."""
    return range(max(stretch.start - _GOING_OVER, 0), min(stretch.stop + _GOING_OVER, frames))


def _fitted(
    job: Job, geometry: Geometry, model: SubjectModel, found: JointMotion, stretch: range, paths: MotionPaths
) -> BodyMotion | None:
    """Fit the model in and around a stretch; None if a frame shows next to nothing of the subject."""
    part = _around(stretch, len(geometry))
    frames = slice(part.start, part.stop)
    read, settings = surfaces_of(GeometryPart(geometry, part), model), job.config.following
    start, seen = found.part(frames), paths.part(frames)
    try:
        return fit_motion(model, start, read, geometry.spacing, seen, settings, job.progress).bodies
    except GeometryError:
        return None


def _put_in(linkage: Linkage, bodies: BodyMotion, stretch: range, fit: BodyMotion) -> BodyMotion:
    """Put the fit of a stretch into a motion."""
    frames = len(bodies.rotations)
    windows = [range(stretch.start), _around(stretch, frames), range(stretch.stop, frames)]
    motions = [bodies.part(slice(windows[0].stop)), fit, bodies.part(slice(stretch.stop, None))]
    some = [k for k, window in enumerate(windows) if len(window)]
    return joined_motion(linkage, [windows[k] for k in some], [motions[k] for k in some])
