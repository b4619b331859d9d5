"""What the bodies are found from: patches followed in the images, or nodes followed on the geometry."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.geometry import Geometry
from geomocap.pipeline.job import Job
from geomocap.segmentation.motion_paths import MotionPaths
from geomocap.tracking.nodes import track_nodes
from geomocap.tracking.selection import spread_out

SAMPLES = 1500  # motion paths that bodies are found from
LEAST_SAMPLES = 300  # fewer long trajectories than these don't cover a subject: nodes are tracked instead
LEAST_COVERAGE = 0.4  # nor do trajectories that are measured, on average, in a smaller share of the frames


def motion_paths(job: Job, geometry: Geometry) -> tuple[MotionPaths, str]:
    """Motion paths and what they are, "patches" or "nodes", as `segmentation.paths` asks for.

    Raises
    ------
    GeometryError
        If patches are asked for and there are too few.
    """
    wanted = job.config.segmentation.paths
    if wanted != "nodes" and (job.run.path / "tracks.npz").exists():
        tracked = job.run.read_npz("tracks.npz")
        chosen = spread_out(tracked["positions"], SAMPLES)
        positions = tracked["positions"][chosen]
        coverage = float(np.isfinite(positions[:, :, 0]).mean()) if len(chosen) else 0.0
        enough = len(chosen) >= LEAST_SAMPLES and coverage >= LEAST_COVERAGE
        if enough or (wanted == "patches" and len(chosen)):
            return MotionPaths(positions, sigma=_filled(tracked["sigma"][chosen])), "patches"
    if wanted == "patches":
        raise GeometryError(
            f"{job.run.path}: no surface patches could be followed in the images; set segmentation.paths = nodes"
        )
    features = geometry.features if job.config.nodes.colors else None
    nodes = track_nodes(geometry.points, len(geometry), job.config.nodes, features, job.progress, job.executor)
    return nodes.motion_paths(), "nodes"


def _filled(sigma: np.ndarray) -> np.ndarray:
    """Standard deviations with the median where a sample was not seen."""
    return np.where(np.isfinite(sigma), sigma, np.nanmedian(sigma))
