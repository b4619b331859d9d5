"""Models of motions that were found, and how well these explain the silhouettes and the paths they come from."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.evaluation.result_check import SeenOutlines, checked_mesh, model_overlap
from geomocap.model.frame_geometry import Geometry
from geomocap.model.skeleton import body_names
from geomocap.motion import Motion
from geomocap.outline_refinement import fit_to_outlines
from geomocap.pipeline.job import Job
from geomocap.pipeline.outline_reading import outline_points_of
from geomocap.subject.model_building import BodyCloud, build_model
from geomocap.subject.subject_model import SubjectModel
from geomocap.subject.window_motion import motion_of

# Power of what the paths miss, beside what the model's drawn surface misses of the silhouettes. Of two results each of
# fourteen sets of paths, of thirteen captures, the better was taken with any power from 0.15 to 0.48 in twelve, with
# 0.5 in eleven, with 0 in nine; in one of the others neither was better. All had been looked at before it was set.
_PATHS = 0.3
# Of the frames. In 18 of 25 hard captures no body was hidden for more than 0.08, and mean errors of rotations were 2°
# to 9°, once 17°; in the others one was for 0.17 to 0.57, and they were 13° to 60°. All were looked at first.
_LONG_UNSEEN = 0.1


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
    job: Job, motion: Motion, model: SubjectModel, tracks: np.ndarray | None
) -> tuple[Motion, SubjectModel]:
    """Refine a motion and its model by the silhouettes of the job; see `geomocap.fit_to_outlines`."""
    settings = job.config.refinement
    outlines = outline_points_of(job) if settings.outline_rounds and settings.rounds else None
    if outlines is None:
        return motion, model
    with job.run.timed("outlines") as count:
        try:
            motion, model = fit_to_outlines(motion, model, outlines, settings=settings, tracks=tracks)
        except GeometryError:
            return motion, model  # its points make no surface that could be drawn
        count["items"] = outlines.frames
    return motion, model


def unseen_bodies(motion: Motion) -> list[str]:
    """Say which bodies no path shows for long."""
    hidden = (motion.bodies.reliability == 0).sum(axis=0)
    frames = len(motion.bodies.reliability)
    names = body_names(len(hidden))
    long = [f"{names[k]} in {hidden[k]}" for k in np.flatnonzero(hidden > _LONG_UNSEEN * frames)]
    if not long:
        return []
    return [
        f"No path shows {', '.join(long)} of {frames} frames: there neighbours and motion before and after tell where "
        "it is, and silhouettes, if any; its turns are guesses."
    ]
