"""Method "motion": bodies and joints from motion paths, of images where they show texture, else of the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError
from geomocap.evaluation.result_check import model_overlap
from geomocap.files.corrected_cameras import camera_warnings
from geomocap.files.results import write_diagnostics, write_ellipsoids, write_points, write_skeleton, write_warnings
from geomocap.files.run import Run
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids, fit_ellipsoids
from geomocap.model.frame_geometry import BodyPoints, Geometry
from geomocap.motion import Motion, MotionSettings, find_motion
from geomocap.pipeline.job import Job
from geomocap.pipeline.motion_fit import fit_unseen
from geomocap.pipeline.outline_reading import outlines_of
from geomocap.pipeline.path_choice import motion_paths
from geomocap.pipeline.subject_stage import make_model
from geomocap.scheduling import map_items
from geomocap.subject.model_building import BodyCloud, build_model

# Of the overlap of a model and the silhouettes. In nine hard captures bodies that were there raised it by 0.0045 to
# 0.035 each, those that were not by 0.002 at most.
_BODY_PRICE = 0.003


def segment_by_motion(job: Job, geometry: Geometry, has_tracks: bool) -> int:
    """Find bodies and skeleton from motion paths, write them, and return the number of frames.

    `has_tracks` is what `motion_paths` takes.
    """
    frames, config = len(geometry), job.config
    choice = motion_paths(job, geometry, has_tracks)
    settings = MotionSettings(
        bodies=config.motion_bodies, skeleton=config.motion_skeleton, refinement=config.refinement, nodes=config.nodes
    )
    with job.run.timed("motion") as count:
        outlines = outlines_of(job) if any(paths.ray is not None for paths in choice.values()) else None
        found_from = {
            source: find_motion(paths, fps=job.fps, settings=settings, progress=job.progress, outlines=outlines)
            for source, paths in choice.items()
        }
        source = _best(job, found_from, geometry)
        motion = found_from[source]
        count["items"] = frames
    bodies, found = motion.bodies, motion.connected
    label = _Label(geometry, job.run, motion)
    ellipsoids = list(map_items(label, range(frames), job.executor, "labels", job.progress))
    job.run.note("segmentation", [job.run.frame_file("bodies", k) for k in range(frames)])
    write_ellipsoids(job.run, Ellipsoids.stack(ellipsoids, np.arange(bodies.body_count, dtype=np.int32)))
    write_skeleton(job.run, found.skeleton)
    warnings = [*camera_warnings(job.run), *motion.warnings, *make_model(job, geometry, motion)]
    axes = np.array([joint.axis for joint in found.joints]).reshape(-1, 3)
    fitted = fit_unseen(job, geometry, motion, choice[source])
    if fitted is not None:
        unseen = int((motion.bodies.reliability == 0).any(axis=1).sum())
        warnings.append(f"In {unseen} of {frames} frames no path shows some body; the model was fitted to the surface.")
        axes = fitted.axes
    if warnings:
        write_warnings(job.run, warnings)
    made = Diagnostics(
        paths=source,
        sample_positions=bodies.positions,
        sample_body=bodies.label,
        sample_residuals=bodies.residuals,
        body_confidence=bodies.confidence,
        reliability=bodies.reliability,
        joint_costs=found.costs,
        joint_is_hinge=motion.joint_is_hinge,
        joint_axes=axes,
        joint_std=np.array([joint.std for joint in found.joints]).reshape(-1, 3),
        curve_bodies=np.array([step.bodies for step in bodies.curve]),
        curve_strengths=np.array([step.strength for step in bodies.curve]),
        alternative_labels=bodies.alternatives(),
    )
    write_diagnostics(job.run, made)
    return frames


def _best(job: Job, found: dict[str, Motion], geometry: Geometry) -> str:
    """Which motion's model, drawn into the cameras, explains their silhouettes best.

    Each further body has to raise that by `_BODY_PRICE`.
    """
    if len(found) < 2 or job.capture is None:
        return next(iter(found))
    capture = job.capture

    def overlap(source: str) -> float:
        motion = found[source]

        def read(frame: int) -> BodyCloud:
            points = geometry.points(frame)
            return BodyCloud(points, motion.label(frame, points))

        try:
            model = build_model(motion.connected, motion.bodies, read, geometry.spacing, job.up_axis)
        except GeometryError:
            return 0.0
        return model_overlap(job.run, capture, model, motion.skeleton)

    explained = {source: overlap(source) for source in found}
    return max(found, key=lambda source: explained[source] - _BODY_PRICE * found[source].body_count)


@dataclass(frozen=True)
class _Label:
    """Bodies of the points of one frame, written to the run, and an ellipsoid for each."""

    geometry: Geometry
    run: Run
    motion: Motion

    def __call__(self, frame: int) -> Ellipsoids:
        points = self.geometry.points(frame)
        label = self.motion.label(frame, points)
        write_points(self.run.frame_file("bodies", frame), BodyPoints(points, label))
        return fit_ellipsoids(points, label, self.motion.body_count, self.geometry.spacing)
