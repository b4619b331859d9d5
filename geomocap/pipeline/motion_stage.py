"""Method "motion": bodies and joints from motion paths, of images where they show texture, else of the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.bodies.point_labels import label_points
from geomocap.bodies.ray_depths import find_bodies_and_depths
from geomocap.files.results import write_diagnostics, write_ellipsoids, write_points, write_skeleton, write_warnings
from geomocap.files.run import Run
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids, fit_ellipsoids
from geomocap.model.frame_geometry import BodyPoints, Geometry
from geomocap.model.motion_paths import MotionPaths
from geomocap.pipeline.job import Job
from geomocap.pipeline.path_choice import motion_paths
from geomocap.pipeline.subject_stage import make_model
from geomocap.scheduling import map_items
from geomocap.skeleton.motion_skeleton import find_motion_skeleton
from geomocap.skeleton.refinement import refine_skeleton

_UNSURE_DEG = 30.0  # 3 to 8 with eight cameras; with four that show the bodies 12, in a cluttered room 29


def unsure_turns(bodies: MotionBodies) -> list[str]:
    """Say so if what lies side by side turns too differently for bodies and joints to be trusted."""
    unevenness = float(np.rad2deg(bodies.unevenness))
    if unevenness <= _UNSURE_DEG:
        return []
    return [
        f"neighbouring samples of the surface turn by {unevenness:.0f}° against each other (median; at most "
        f"{_UNSURE_DEG:.0f}° expected): number of bodies, joints and skeleton are not to be trusted; use more cameras, "
        "more texture or more frames a second"
    ]


def segment_by_motion(job: Job, geometry: Geometry, has_tracks: bool) -> int:
    """Find bodies and skeleton from motion paths, write them, and return the number of frames.

    `has_tracks` is what `motion_paths` takes.
    """
    frames = len(geometry)
    paths, source = motion_paths(job, geometry, has_tracks)
    bodies, paths = find_bodies_and_depths(paths, job.config.motion_bodies, job.progress)
    with job.run.timed("skeleton") as count:
        found = find_motion_skeleton(bodies, job.fps, job.config.motion_skeleton)
        count["items"] = frames
    with job.run.timed("refinement") as count:
        found, bodies = refine_skeleton(found, bodies, paths, job.config.refinement)
        count["items"] = frames
    label = _Label(geometry, job.run, bodies, paths)
    fitted = list(map_items(label, range(frames), job.executor, "labels", job.progress))
    write_ellipsoids(job.run, Ellipsoids.stack(fitted, np.arange(bodies.body_count, dtype=np.int32)))
    write_skeleton(job.run, found.skeleton)
    warnings = [*unsure_turns(bodies), *make_model(job, geometry, found, bodies)]
    if warnings:
        write_warnings(job.run, warnings)
    made = Diagnostics(
        paths=source,
        sample_positions=bodies.positions,
        sample_body=bodies.label,
        sample_residuals=bodies.residuals,
        reliability=bodies.reliability,
        joint_costs=found.costs,
        joint_is_hinge=np.array([joint.hinge for joint in found.joints], dtype=bool),
        joint_axes=np.array([joint.axis for joint in found.joints]).reshape(-1, 3),
        joint_std=np.array([joint.std for joint in found.joints]).reshape(-1, 3),
        curve_bodies=np.array([step.bodies for step in bodies.curve]),
        curve_strengths=np.array([step.strength for step in bodies.curve]),
        alternative_labels=bodies.alternatives(),
    )
    write_diagnostics(job.run, made)
    return frames


@dataclass(frozen=True)
class _Label:
    """Bodies of the points of one frame, written to the run, and an ellipsoid for each."""

    geometry: Geometry
    run: Run
    bodies: MotionBodies
    paths: MotionPaths

    def __call__(self, frame: int) -> Ellipsoids:
        points = self.geometry.points(frame)
        label = label_points(self.bodies, self.paths, frame, points)
        write_points(self.run.frame_file("bodies", frame), BodyPoints(points, label))
        return fit_ellipsoids(points, label, self.bodies.body_count, self.geometry.spacing)
