"""Another sequence of a known subject: its model instead of bodies and joints found anew."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from geomocap.files.atomic import fingerprint
from geomocap.files.corrected_cameras import camera_warnings
from geomocap.files.results import (
    WARNINGS,
    read_trajectories,
    write_diagnostics,
    write_ellipsoids,
    write_points,
    write_skeleton,
    write_warnings,
)
from geomocap.files.run import Run, stage_key
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids, fit_ellipsoids
from geomocap.model.frame_geometry import BodyPoints, Geometry, GeometryPart
from geomocap.model.skeleton import Skeleton, bone_fixed_skeleton
from geomocap.pipeline.derived import FROM_BODIES
from geomocap.pipeline.job import Job
from geomocap.pipeline.path_choice import patch_paths, path_spacing, point_paths
from geomocap.pipeline.track_stage import tracks
from geomocap.pipeline.window_following import follow_windows, shows_most, surfaces_of
from geomocap.scheduling import map_items
from geomocap.skeleton.kinematics import BodyMotion, posed, since
from geomocap.subject.model_following import FollowedSequence, follow_model
from geomocap.subject.subject_model import MODEL_FILE, SubjectModel, read_model, write_model


def segment_with_model(job: Job, geometry: Geometry, source_key: str) -> str:
    """Follow the job's model, write what a segmentation writes, and return the stage's key."""
    assert job.model is not None
    model = read_model(job.model).turned_up(job.up_axis)
    patches = None
    wanted = job.config.segmentation.paths
    if job.capture is not None and job.capture.has_images and wanted != "nodes":
        patches = tracks(job)
    windows = job.windows
    key = stage_key(
        __name__,
        "following",
        source_key,
        patches,
        wanted,
        fingerprint([job.model]),
        job.config.following.model_dump(),
        job.fps,
        job.up,
        windows,
    )
    outputs = ["ellipsoids.npz", "bodies", "diagnostics.npz", "skeleton.npz", MODEL_FILE]
    work = partial(_follow, job, geometry, model, windows, patches is not None)
    return job.stage("segmentation", key, outputs, work, [WARNINGS], FROM_BODIES)


def _follow(job: Job, geometry: Geometry, model: SubjectModel, windows: list[range], patches: bool) -> int:
    frames = len(geometry)
    with job.run.timed("model") as count:
        if len(windows) <= 1:
            followed = _follow_piece(job, geometry, model, patches)
        else:
            key = shows_most(job, geometry, windows)
            start = _follow_piece(job.part(windows[key]), GeometryPart(geometry, windows[key]), model, patches)
            followed = follow_windows(job, geometry, model, windows, key, start, patches)
        count["items"] = frames
    write_followed(job, geometry, model, followed.bodies)
    made = Diagnostics(
        paths="model",
        fit_distance=followed.distance,
        first_frame=followed.first_frame,
        joint_is_hinge=model.joint_hinge,
        joint_axes=posed(model.linkage, followed.bodies, 0).axes,
    )
    write_diagnostics(job.run, made)
    told = _fit_warnings(model, followed, job.config.following.poor_fit)
    write_warnings(job.run, [*camera_warnings(job.run), *told])
    return frames


def _follow_piece(job: Job, geometry: Geometry, model: SubjectModel, patches: bool) -> FollowedSequence:
    """Look for a model in a recording, or a window of one, and follow it."""
    if patches:
        paths = patch_paths(read_trajectories(job.run), path_spacing(geometry))
    else:
        paths = point_paths(job, geometry)
    read, settings = surfaces_of(geometry, model), job.config.following
    return follow_model(model, read, len(geometry), geometry.spacing, job.up_axis, paths, settings, job.progress)


def write_followed(job: Job, geometry: Geometry, model: SubjectModel, bodies: BodyMotion) -> None:
    """Write bodies of all points, ellipsoids, skeleton, and the model, by a model's motion."""
    frames = range(len(geometry))
    fitted = list(map_items(_Label(geometry, job.run, model, bodies), frames, job.executor, "labels", job.progress))
    job.run.note("segmentation", [job.run.frame_file("bodies", k) for k in frames])
    write_ellipsoids(job.run, Ellipsoids.stack(fitted, np.arange(model.body_count, dtype=np.int32)))
    write_skeleton(job.run, model_skeleton(model, bodies, job.fps))
    write_model(job.run.path / MODEL_FILE, model.widened(bodies).reposed(bodies, 0))


def model_skeleton(model: SubjectModel, bodies: BodyMotion, fps: float) -> Skeleton:
    """Skeleton of a model that moves."""
    linkage, motion = posed(model.linkage, bodies, 0), since(bodies, 0)
    start = bodies.part(slice(0, 1)).carry(model.points, model.skin_bodies, model.skin_weights)[0]
    owners = model.skin.body
    own = linkage.hierarchy.body_joints
    places = [start[owners == b] for b in range(model.body_count)]
    middle = np.stack([p.mean(axis=0) if len(p) else linkage.joints[own[b]] for b, p in enumerate(places)])
    centers = np.einsum("tbij,bj->tbi", motion.rotations, middle) + motion.translations
    joints = linkage.joint_positions(motion)
    found = bone_fixed_skeleton(linkage.hierarchy, linkage.joints, motion.rotations, joints, centers, middle, fps)
    return replace(found, joint_names=model.joint_names, body_names=model.body_names)


def _fit_warnings(model: SubjectModel, followed: FollowedSequence, poor: float) -> list[str]:
    fraction = followed.distance / model.diagonal
    if float(np.median(fraction)) > poor:
        return [
            "The model fits poorly: its surface and that of the sequence are "
            f"{1000 * np.median(followed.distance):.0f} mm apart ({100 * np.median(fraction):.1f} % of its diagonal; "
            f"up to {100 * poor:g} % is usual). Is it the same subject, at the same scale?"
        ]
    return poor_frames(fraction, poor)


def poor_frames(fraction: np.ndarray, poor: float) -> list[str]:
    """Say in words in which frames a model's surface is farther from the frame's, (T,) diagonals, than `poor`."""
    bad = np.flatnonzero(fraction > poor)
    if not len(bad):
        return []
    listed = ", ".join(str(t) for t in bad[:5]) + (" …" if len(bad) > 5 else "")
    return [f"The model fits poorly in {len(bad)} of {len(fraction)} frames ({listed}); look at these."]


@dataclass(frozen=True)
class _Label:
    """Bodies of the points of one frame, written to the run, and an ellipsoid for each."""

    geometry: Geometry
    run: Run
    model: SubjectModel
    bodies: BodyMotion

    def __call__(self, frame: int) -> Ellipsoids:
        points = self.geometry.points(frame)
        skin = self.model.skin
        placed = self.bodies.part(slice(frame, frame + 1)).carry(skin.rest, skin.bodies, skin.fractions)[0]
        label = skin.body[cKDTree(placed).query(points)[1]].astype(np.int32)
        write_points(self.run.frame_file("bodies", frame), BodyPoints(points, label))
        return fit_ellipsoids(points, label, self.model.body_count, self.geometry.spacing)
