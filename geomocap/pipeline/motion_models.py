"""Models of motions that were found, and how well these explain the silhouettes and the paths they come from."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.evaluation.result_check import SeenOutlines, checked_mesh, model_overlap
from geomocap.model.frame_geometry import Geometry
from geomocap.motion import Motion
from geomocap.pipeline.job import Job
from geomocap.pipeline.outline_reading import outline_points_of
from geomocap.subject.model_building import BodyCloud, build_model
from geomocap.subject.outline_fit import OutlineFit
from geomocap.subject.subject_model import SubjectModel
from geomocap.subject.window_motion import motion_of

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
    return model_overlap(SeenOutlines.of(job.run, job.capture), checked_mesh(model), motion_of(motion.skeleton))


def misfit(motion: Motion, overlap: float) -> float:
    """How badly a motion explains the silhouettes, which its model overlaps so much, and the paths it was found from.

    Only its ratio to that of another motion of the same recording means something. Silhouettes alone say little of what
    lies before the trunk in all views, and of two bodies that are one; paths that contradict each other are wrong.
    """
    return (1.0 - overlap) * float(motion.bodies.residuals.mean()) ** _PATHS


def fitted_to_outlines(
    job: Job, model: SubjectModel, motion: Motion, tracks: np.ndarray | None
) -> tuple[SubjectModel, Motion]:
    """Refine a motion and the shape of its model so that this ends in the images where the silhouettes do.

    `tracks` as in `Motion.with_tracks`, if any.
    """
    rounds = job.config.refinement.outline_rounds
    outlines = outline_points_of(job) if rounds and job.config.refinement.rounds else None
    if outlines is None:
        return model, motion
    with job.run.timed("outlines") as count:
        fit = OutlineFit(checked_mesh(model), outlines)
        refined = motion.refined(job.config.refinement.model_copy(update={"rounds": rounds}), fit, tracks)
        count["items"] = outlines.frames
        return fit.model(model, refined.connected), refined


def unseen_frames(motion: Motion) -> list[str]:
    """Say in how many frames no path shows some body."""
    hidden = (motion.bodies.reliability == 0).any(axis=1)
    if not hidden.any():
        return []
    return [
        f"In {hidden.sum()} of {len(hidden)} frames no path shows some body; only silhouettes tell where it is there."
    ]
