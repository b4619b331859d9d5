"""What the bodies are found from: patches followed in the images, nodes on the geometry, both, or ellipsoids."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.files.results import read_trajectories
from geomocap.files.scan_tracks import scan_tracks
from geomocap.files.scans import Scans
from geomocap.model.frame_geometry import Geometry
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.trajectories import Trajectories
from geomocap.nodes.node_tracking import track_nodes
from geomocap.pipeline.job import Job
from geomocap.segmentation.m3 import ellipsoid_paths
from geomocap.trajectories.selection import spread_out

SAMPLES = 2000  # motion paths that bodies are found from
ALONE_FRACTION = (
    0.5  # of the standard deviation of what a single camera sees, as most of that is depth and hardly counts
)
LEAST_SAMPLES = 300  # fewer long trajectories than these don't cover a subject: nodes are tracked instead
LEAST_COVERAGE = 0.4  # nor do trajectories that are measured, on average, in a smaller fraction of the frames
ANCHORS = 2000  # trajectories that keep nodes from sliding
ANCHOR_FRACTION = 0.1  # those are measured in this fraction of the frames at least


def motion_paths(job: Job, geometry: Geometry, has_tracks: bool) -> tuple[MotionPaths, str]:
    """Motion paths and what they are: "patches", "nodes", "both" (nodes held by patches), "points" or "ellipsoids".

    Parameters
    ----------
    job : Job
    geometry : Geometry
    has_tracks : bool
        Whether the surface was tracked in the job's images; any other `tracks.npz` in the run is none of the job's.

    Raises
    ------
    GeometryError
        If patches or points are asked for and there are none.
    """
    wanted = job.config.segmentation.paths
    given = point_paths(job, geometry)
    if given is not None:
        return given, "points"
    if wanted == "ellipsoids":
        settings = job.config.segmentation
        found = ellipsoid_paths(geometry.points, len(geometry), geometry.spacing, settings, job.executor, job.progress)
        return MotionPaths(found.ellipsoids.centers.swapaxes(0, 1)), wanted
    tracked = read_trajectories(job.run) if has_tracks else None
    if tracked is not None and wanted != "both":
        paths = patch_paths(tracked)
        if paths is not None and (wanted == "patches" or _covers(paths)):
            return paths, "patches"
    if wanted == "patches":
        raise GeometryError(
            f"{job.run.path}: no surface patches could be followed in the images; set segmentation.paths = nodes"
        )
    features = geometry.features if job.config.nodes.colors else None
    anchors = None if tracked is None else _anchors(tracked)
    following = job.config.nodes
    if job.capture is not None:  # the hull changes its shape with the pose: what is rigid doesn't look so
        following = following.model_copy(update={"part_rounds": 0})
    nodes = track_nodes(geometry.points, len(geometry), following, features, job.progress, job.executor, anchors)
    return nodes.motion_paths(), "nodes" if anchors is None else "both"


def point_paths(job: Job, geometry: Geometry) -> MotionPaths | None:
    """Paths of points that scans have in common, evenly over the surface; None: they have none, or others are wanted.

    Raises
    ------
    GeometryError
        If these paths are asked for, and the scans have no points in common.
    """
    wanted = job.config.segmentation.paths
    if wanted not in ("auto", "points") or not isinstance(geometry, Scans):
        return None
    tracks = scan_tracks(geometry, wanted == "points" or geometry.tracked, job.progress)
    return None if tracks is None else MotionPaths(tracks[spread_out(tracks, SAMPLES)])


def patch_paths(tracked: Trajectories) -> MotionPaths | None:
    """Long trajectories, evenly over the surface; None: there are none."""
    chosen = spread_out(tracked.positions, SAMPLES)
    if not len(chosen):
        return None
    sigma = tracked.sigma[chosen].astype(float)
    # standard deviations with the median where a sample was not seen
    sigma = np.where(np.isfinite(sigma), sigma, np.nanmedian(sigma))
    ray = tracked.ray[chosen].astype(float)
    alone = ray.any(axis=2)
    if not alone.any():
        return MotionPaths(tracked.positions[chosen], sigma=sigma)
    return MotionPaths(tracked.positions[chosen], sigma=np.where(alone, ALONE_FRACTION, 1.0) * sigma, ray=ray)


def _covers(paths: MotionPaths) -> bool:
    return paths.count >= LEAST_SAMPLES and float(paths.seen.mean()) >= LEAST_COVERAGE


def _anchors(tracked: Trajectories) -> np.ndarray | None:
    """Trajectories (P, T, 3), metres, that nodes are held by; None: there are none."""
    chosen = spread_out(tracked.positions, ANCHORS, ANCHOR_FRACTION)
    return tracked.positions[chosen] if len(chosen) else None
