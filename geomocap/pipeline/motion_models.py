"""Models of motions that were found, and how well these explain the silhouettes and the paths they come from."""

from __future__ import annotations

from geomocap.errors import GeometryError
from geomocap.evaluation.result_check import model_overlap
from geomocap.model.frame_geometry import Geometry
from geomocap.model.motion_paths import MotionPaths
from geomocap.motion import Motion
from geomocap.nodes.surface_coverage import SMALLEST_PIECE
from geomocap.pipeline.following_stage import model_skeleton
from geomocap.pipeline.job import Job
from geomocap.pipeline.window_following import surfaces_of
from geomocap.skeleton.kinematics import BodyMotion, joint_motion
from geomocap.subject.model_building import BodyCloud, build_model
from geomocap.subject.model_following import fit_motion
from geomocap.subject.subject_model import SubjectModel

# Power of what the paths miss, beside what the model's drawn surface misses of the silhouettes. Of two results each of
# fourteen sets of paths, of thirteen captures, the better was taken with any power from 0.15 to 0.48 in twelve, with
# 0.5 in eleven, with 0 in nine; in one of the others neither was better. All had been looked at before it was set.
_PATHS = 0.3


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
    return model_overlap(job.run, job.capture, model, motion.skeleton)


def misfit(motion: Motion, overlap: float) -> float:
    """How badly a motion explains the silhouettes, which its model overlaps so much, and the paths it was found from.

    Only its ratio to that of another motion of the same recording means something. Silhouettes alone say little of what
    lies before the trunk in all views, and of two bodies that are one; paths that contradict each other are wrong.
    """
    return (1.0 - overlap) * float(motion.bodies.residuals.mean()) ** _PATHS


def fitted_to_surfaces(
    job: Job, geometry: Geometry, model: SubjectModel, motion: Motion, paths: MotionPaths, before: float | None = None
) -> BodyMotion | None:
    """Fit a motion's model to the surfaces of all frames if no path shows some body in some frame.

    The fit is kept if the model then overlaps the silhouettes more, by at least what the smallest piece of a surface
    is: a surface alone knows less than paths do where these are. `paths` are those that the motion was found from,
    `before` the overlap without a fit, where it is known. None: nothing is to be fitted, or the fit isn't kept.
    """
    if job.capture is None or (motion.bodies.reliability > 0).all():
        return None
    found = motion.skeleton
    if before is None:
        before = silhouette_overlap(job, model, motion)
    start = joint_motion(model.linkage, found.body_rotations, found.root_positions)
    try:
        with job.run.timed("fit") as count:
            followed = fit_motion(
                model, start, surfaces_of(geometry, model), geometry.spacing, paths, job.config.following, job.progress
            )
            count["items"] = len(geometry)
    except GeometryError:  # a frame shows next to nothing of the subject
        return None
    skeleton = model_skeleton(model, followed.bodies, job.fps)
    after = model_overlap(job.run, job.capture, model.reposed(followed.bodies, 0), skeleton)
    return None if after < before + SMALLEST_PIECE else followed.bodies
