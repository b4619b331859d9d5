"""Motion of bodies that no path follows in some frames, from the surfaces of these frames."""

from __future__ import annotations

from geomocap.errors import GeometryError
from geomocap.evaluation.result_check import model_overlap
from geomocap.model.frame_geometry import Geometry
from geomocap.model.motion_paths import MotionPaths
from geomocap.motion import Motion
from geomocap.nodes.surface_coverage import SMALLEST_PIECE
from geomocap.pipeline.following_stage import model_skeleton, write_followed
from geomocap.pipeline.job import Job
from geomocap.pipeline.window_following import surfaces_of
from geomocap.skeleton.kinematics import Linkage, joint_motion, posed
from geomocap.subject.model_following import fit_motion
from geomocap.subject.subject_model import MODEL_FILE, read_model


def fit_unseen(job: Job, geometry: Geometry, motion: Motion, paths: MotionPaths) -> Linkage | None:
    """Fit the run's model to the surfaces of all frames, if no path shows some body in some frame; write what changes.

    The fit is kept if the model then overlaps the silhouettes more, by at least what the smallest piece of a surface
    is: a surface alone knows less than paths do where these are. `paths` are those that the motion was found from.

    Returns
    -------
    Linkage or None
        Joints and axes in the pose of frame 0; None where the motion that was found stays.
    """
    path = job.run.path / MODEL_FILE
    if job.capture is None or not path.is_file() or (motion.bodies.reliability > 0).all():
        return None
    model, found = read_model(path), motion.skeleton
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
    before = model_overlap(job.run, job.capture, model, found)
    after = model_overlap(job.run, job.capture, model.reposed(followed.bodies, 0), skeleton)
    if after < before + SMALLEST_PIECE:
        return None
    write_followed(job, geometry, model, followed.bodies)
    return posed(model.linkage, followed.bodies, 0)
