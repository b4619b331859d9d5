"""The subject's own model, made from a take: `model.npz`."""

from __future__ import annotations

import numpy as np

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.errors import GeometryError
from geomocap.files.frame_files import read_points
from geomocap.model.frame_geometry import Geometry
from geomocap.pipeline.job import Job
from geomocap.skeleton.motion_skeleton import MotionSkeleton
from geomocap.subject.model_building import BodyCloud, build_model
from geomocap.subject.subject_model import MODEL_FILE, write_model


def make_model(job: Job, geometry: Geometry, found: MotionSkeleton, bodies: MotionBodies) -> list[str]:
    """Make and write the model of a run whose points have their bodies; return in words why, if it can't be made."""

    def read(frame: int) -> BodyCloud:
        labelled = read_points(job.run.frame_file("bodies", frame))
        colors = geometry.features(frame) if geometry.features is not None else None
        return BodyCloud(labelled.positions, labelled.body, colors)

    hinge = np.array([joint.hinge for joint in found.joints], dtype=bool)
    try:
        with job.run.timed("model") as count:
            model = build_model(found, bodies, hinge, read, geometry.spacing, job.up_axis)
            count["items"] = len(model.points)
    except GeometryError as error:
        return [str(error)]
    write_model(job.run.path / MODEL_FILE, model)
    return []
