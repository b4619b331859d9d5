"""Method "motion": bodies and joints from motion paths, of images where they show texture, else of the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.bodies.point_labels import Voters, label_points
from geomocap.files.corrected_cameras import camera_warnings
from geomocap.files.results import write_diagnostics, write_ellipsoids, write_points, write_skeleton, write_warnings
from geomocap.files.run import Run
from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids, fit_ellipsoids
from geomocap.model.frame_geometry import BodyPoints, Geometry
from geomocap.motion import Motion, MotionSettings, find_motion
from geomocap.pipeline.job import Job
from geomocap.pipeline.motion_models import (
    fitted_to_outlines,
    make_model,
    misfit,
    silhouette_overlap,
    unseen_bodies,
)
from geomocap.pipeline.outline_reading import outlines_of
from geomocap.pipeline.path_choice import motion_paths
from geomocap.scheduling import map_items
from geomocap.subject.subject_model import MODEL_FILE, SubjectModel, write_model


@dataclass(frozen=True)
class _Candidate:
    """What was found from one kind of motion paths.

    Attributes
    ----------
    motion : Motion
    model : SubjectModel or str
        In words why, if it can't be made.
    overlap : float, optional
        Of the model with the silhouettes; None where nothing depends on it.
    """

    motion: Motion
    model: SubjectModel | str
    overlap: float | None

    @property
    def misfit(self) -> float:
        """See `motion_models.misfit`; infinite without a model."""
        return np.inf if self.overlap is None else misfit(self.motion, self.overlap)


def segment_by_motion(job: Job, geometry: Geometry, has_tracks: bool, has_silhouettes: bool) -> int:
    """Find bodies and skeleton from motion paths, write them, and return the number of frames.

    Where there are several kinds of paths, what explains silhouettes and paths best is taken. `has_tracks` is what
    `motion_paths` takes; where the run has silhouettes, these refine what was found.
    """
    frames, config = len(geometry), job.config
    choice, tracks = motion_paths(job, geometry, has_tracks)
    settings = MotionSettings(
        bodies=config.motion_bodies, skeleton=config.motion_skeleton, refinement=config.refinement, nodes=config.nodes
    )
    with job.run.timed("motion") as count:
        outlines = outlines_of(job) if any(paths.ray is not None for paths in choice.values()) else None
        found_from = {
            source: find_motion(paths, fps=job.fps, settings=settings, progress=job.progress, outlines=outlines)
            for source, paths in choice.items()
        }
        if tracks is not None:
            found_from = {source: motion.with_tracks(tracks) for source, motion in found_from.items()}
        count["items"] = frames
    candidates = {source: _candidate(job, geometry, motion, len(choice) > 1) for source, motion in found_from.items()}
    source = min(candidates, key=lambda which: candidates[which].misfit)
    best = candidates[source]
    motion, model = best.motion, best.model
    if has_silhouettes and not isinstance(model, str):
        motion, model = fitted_to_outlines(job, motion, model, tracks)
    bodies, found = motion.bodies, motion.connected
    warnings = [*camera_warnings(job.run), *motion.warnings, *unseen_bodies(motion)]
    label = _Label(geometry, job.run, motion.voters)
    ellipsoids = list(map_items(label, range(frames), job.executor, "labels", job.progress))
    job.run.note("segmentation", [job.run.frame_file("bodies", k) for k in range(frames)])
    write_ellipsoids(job.run, Ellipsoids.stack(ellipsoids, np.arange(bodies.body_count, dtype=np.int32)))
    write_skeleton(job.run, found.skeleton)
    if isinstance(model, str):
        warnings.append(model)
    else:
        write_model(job.run.path / MODEL_FILE, model)
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
        joint_axes=np.array([joint.axis for joint in found.joints]).reshape(-1, 3),
        joint_std=np.array([joint.std for joint in found.joints]).reshape(-1, 3),
        curve_bodies=np.array([step.bodies for step in bodies.curve]),
        curve_strengths=np.array([step.strength for step in bodies.curve]),
        alternative_labels=bodies.alternatives(),
    )
    write_diagnostics(job.run, made)
    return frames


def _candidate(job: Job, geometry: Geometry, motion: Motion, several: bool) -> _Candidate:
    """Make the model of a motion, and see how well it explains the silhouettes where there are other motions."""
    model = make_model(job, geometry, motion)
    if job.capture is None or isinstance(model, str) or not several:
        return _Candidate(motion, model, None)
    return _Candidate(motion, model, silhouette_overlap(job, model, motion))


@dataclass(frozen=True)
class _Label:
    """Bodies of the points of one frame, written to the run, and an ellipsoid for each."""

    geometry: Geometry
    run: Run
    voters: Voters

    def __call__(self, frame: int) -> Ellipsoids:
        points = self.geometry.points(frame)
        label = label_points(self.voters, frame, points)
        write_points(self.run.frame_file("bodies", frame), BodyPoints(points, label))
        return fit_ellipsoids(points, label, len(self.voters.shapes), self.geometry.spacing)
