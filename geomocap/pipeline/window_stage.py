"""A long recording: bodies are found in the window that shows most, and their model is followed through the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
    read_warnings,
    write_diagnostics,
    write_warnings,
)
from geomocap.model.frame_geometry import Geometry, GeometryPart
from geomocap.pipeline.following_stage import poor_frames, write_followed
from geomocap.pipeline.job import Job
from geomocap.pipeline.motion_stage import segment_by_motion
from geomocap.pipeline.window_following import follow_windows, shows_most
from geomocap.skeleton.kinematics import posed
from geomocap.subject.model_following import FollowedSequence
from geomocap.subject.subject_model import MODEL_FILE, read_model
from geomocap.subject.window_motion import motion_of


def segment_windows(
    job: Job, geometry: Geometry, windows: Sequence[range], has_tracks: bool, has_silhouettes: bool
) -> int:
    """Find bodies in one window, follow them through all, write what a segmentation writes; return the frames' number.

    Raises
    ------
    GeometryError
        If the window's bodies make no model that could be followed.
    """
    key = shows_most(job, geometry, windows)
    part = job.part(windows[key])
    sound = job.run.sound("segmentation")
    if not {part.run.path / name for name in (SKELETON, MODEL_FILE, DIAGNOSTICS)} <= sound:
        segment_by_motion(part, GeometryPart(geometry, windows[key]), has_tracks, has_silhouettes)
        if not part.run.has(MODEL_FILE):
            raise GeometryError(
                f"frames {windows[key].start} to {windows[key].stop - 1}: {' '.join(read_warnings(part.run))} "
                "Without a model a long recording can't be followed; set windows.frames to its length"
            )
        files = (ELLIPSOIDS, SKELETON, DIAGNOSTICS, MODEL_FILE, WARNINGS)
        job.run.note("segmentation", [f for name in files if (f := part.run.path / name).is_file()])
    model, found = read_model(part.run.path / MODEL_FILE), read_diagnostics(part.run)
    with job.run.timed("follow") as count:
        start = FollowedSequence(motion_of(read_skeleton(part.run)), np.zeros(len(windows[key])), 0)
        followed = follow_windows(job, geometry, model, windows, key, start, has_tracks)
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
    told += poor_frames(followed.distance / model.diagonal, job.config.following.poor_fit)
    if told:
        write_warnings(job.run, list(dict.fromkeys(told)))
    return len(geometry)
