"""The subject's own model, made from a sequence: `model.npz`."""

from __future__ import annotations

from geomocap.errors import GeometryError
from geomocap.files.frame_files import read_points
from geomocap.model.frame_geometry import Geometry
from geomocap.motion import Motion
from geomocap.pipeline.job import Job
from geomocap.subject.model_building import BodyCloud, build_model
from geomocap.subject.subject_model import MODEL_FILE, write_model


def make_model(job: Job, geometry: Geometry, motion: Motion) -> list[str]:
    """Make and write the model of a run whose points have their bodies; return in words why, if it can't be made."""

    def read(frame: int) -> BodyCloud:
        labelled = read_points(job.run.frame_file("bodies", frame))
        colors = geometry.features(frame) if geometry.features is not None else None
        return BodyCloud(labelled.positions, labelled.body, colors)

    try:
        with job.run.timed("model") as count:
            model = build_model(motion.connected, motion.bodies, read, geometry.spacing, job.up_axis)
            count["items"] = len(model.points)
    except GeometryError as error:
        return [str(error)]
    write_model(job.run.path / MODEL_FILE, model)
    return []
