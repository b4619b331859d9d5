"""What the bodies are found from: patches followed in the images, nodes on the geometry, both, or ellipsoids."""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.files.corrected_cameras import as_seen
from geomocap.files.results import read_trajectories
from geomocap.files.scan_tracks import scan_tracks
from geomocap.files.scans import Scans
from geomocap.model.frame_geometry import Geometry
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.trajectories import Trajectories
from geomocap.motion import SAMPLES, evenly_over_surface
from geomocap.nodes.node_tracking import track_nodes
from geomocap.nodes.surface_coverage import SMALLEST_PIECE, even_spacing, left_over, piece_reach, uncovered_fraction
from geomocap.pipeline.job import Job
from geomocap.pipeline.track_stage import frame_reader
from geomocap.segmentation.m3 import ellipsoid_paths
from geomocap.trajectories.selection import spread_out

ALONE_FRACTION = (
    0.5  # of the standard deviation of what a single camera sees, as most of that is depth and hardly counts
)
# Fraction of the surface that patches of single cameras may leave. Hulls of four cameras had 0.03 (a man) and 0.2 (a
# real recording) without patches; bodies from nodes explained silhouettes and paths worse there. Nothing between 0.2
# and 1 was measured: half is where nodes would say more of the surface than patches do.
LARGEST_BULK = 0.5
# Of the frames, in which trajectories that keep nodes from sliding, or say where bodies begin, are measured at least.
SHORT_FRACTION = 0.1


def motion_paths(job: Job, geometry: Geometry, has_tracks: bool) -> tuple[dict[str, MotionPaths], np.ndarray | None]:
    """Motion paths by what they are; where there is a choice, bodies tell which are best.

    Paths are evenly over the surface. All tracks that these were chosen from come along, as they show where one body
    ends and another begins: (N, T, 3) metres, NaN where unseen.

    Paths are "patches", "nodes", "both" (nodes held by patches and images), "pieces" (patches, and those nodes where
    these leave gaps), "points" or "ellipsoids". Nodes are followed only where patches leave a piece of the surface
    uncovered. Where single cameras follow the surface that is where these leave half of it; then "patches" and "both"
    are returned.

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
    points = _point_tracks(job, geometry)
    if points is not None:
        return {"points": MotionPaths(points[evenly_over_surface(points)])}, points
    if wanted == "ellipsoids":
        settings = job.config.segmentation
        found = ellipsoid_paths(geometry.points, len(geometry), geometry.spacing, settings, job.executor, job.progress)
        return {wanted: MotionPaths(found.ellipsoids.centers.swapaxes(0, 1))}, None
    tracked = read_trajectories(job.run) if has_tracks else None
    spacing = path_spacing(geometry)
    tracks = None if tracked is None else _tracks_of_several(tracked)
    patches = None if tracked is None or wanted == "both" else patch_paths(tracked, spacing)
    if wanted == "patches":
        if patches is None:
            raise GeometryError(
                f"{job.run.path}: no surface patches could be followed in the images; set segmentation.paths = nodes"
            )
        return {"patches": patches}, tracks
    if patches is not None:
        # what patches of single cameras leave uncovered is bulk of a hull of few cameras, and mostly no piece
        enough = SMALLEST_PIECE if patches.ray is None else LARGEST_BULK
        if uncovered_fraction(geometry.points, patches.positions, piece_reach(_first_surface(geometry))) < enough:
            return {"patches": patches}, tracks
    anchors = None if tracked is None else _anchors(tracked, spacing)
    held = _follow_nodes(job, geometry, anchors)
    if patches is None:
        return {"nodes" if tracked is None else "both": held}, tracks
    if patches.ray is not None:
        return {"patches": patches, "both": held}, tracks
    rest = np.flatnonzero(left_over(held.positions, patches.positions, spacing))
    return {"pieces": _joined(patches, held, rest[spread_out(held.positions[rest], spacing)])}, tracks


def carrying_tracks(job: Job, geometry: Geometry, has_tracks: bool) -> np.ndarray | None:
    """Tracks that carry the ellipsoids of M3, (N, T, 3), metres, NaN where unseen; None: none are asked for.

    Parameters
    ----------
    job : Job
    geometry : Geometry
    has_tracks : bool
        Whether the surface was tracked in the job's images.

    Raises
    ------
    GeometryError
        If patches or points are asked for and there are none.
    """
    wanted = job.config.segmentation.paths
    if wanted != "patches":
        return _point_tracks(job, geometry) if wanted == "points" else None
    tracked = read_trajectories(job.run) if has_tracks else None
    if tracked is None or not (lasting := _lasting(tracked)).any():
        raise GeometryError(
            f"{job.run.path}: no surface patches could be followed in the images; set segmentation.paths = auto"
        )
    return tracked.positions[lasting].astype(float)


def _tracks_of_several(tracked: Trajectories) -> np.ndarray | None:
    """Positions of trajectories that no single camera placed, (N, T, 3), metres; None: there are none."""
    chosen = np.flatnonzero(_lasting(tracked) & ~tracked.ray.any(axis=(1, 2)))
    return tracked.positions[chosen].astype(float) if len(chosen) else None


def _lasting(tracked: Trajectories) -> np.ndarray:
    """Which trajectories are measured in enough frames to say something of bodies, (N,) bool."""
    return np.asarray(tracked.lengths >= max(2, SHORT_FRACTION * tracked.n_frames))


def _follow_nodes(job: Job, geometry: Geometry, anchors: MotionPaths | None) -> MotionPaths:
    """Follow nodes of the geometry, which `anchors` and the images keep from sliding."""
    features = geometry.features if job.config.nodes.colors else None
    following = job.config.nodes
    if job.capture is not None:  # the hull changes its shape with the pose: what is rigid doesn't look so
        following = following.model_copy(update={"part_rounds": 0})
    images = None
    if job.capture is not None and anchors is not None:
        images = frame_reader(as_seen(job.run, job.capture), job.run, job.config.tracking, job.config.cloud)
    nodes = track_nodes(
        geometry.points,
        len(geometry),
        following,
        features,
        job.progress,
        job.executor,
        anchors,
        images,
        geometry.normals,
    )
    return nodes.motion_paths(anchors)  # images hold nodes, which the geometry doesn't know


def point_paths(job: Job, geometry: Geometry) -> MotionPaths | None:
    """Paths of points that scans have in common, evenly over the surface; None: they have none, or others are wanted.

    Raises
    ------
    GeometryError
        If these paths are asked for, and the scans have no points in common.
    """
    tracks = _point_tracks(job, geometry)
    return None if tracks is None else MotionPaths(tracks[evenly_over_surface(tracks)])


def _point_tracks(job: Job, geometry: Geometry) -> np.ndarray | None:
    """Tracks (N, T, 3), metres, of points that scans have in common; see `point_paths`."""
    wanted = job.config.segmentation.paths
    if wanted not in ("auto", "points") or not isinstance(geometry, Scans):
        return None
    return scan_tracks(geometry, wanted == "points" or geometry.tracked, job.progress)


def path_spacing(geometry: Geometry) -> float:
    """Distance of the paths that bodies are found from, metres, as if all over the surface; 0 without any surface."""
    surface = _first_surface(geometry)
    return even_spacing(surface, SAMPLES) if len(surface) else 0.0


def _first_surface(geometry: Geometry) -> np.ndarray:
    """Points of the first frame that has any, (M, 3), metres: the subject may come into view later."""
    frames = map(geometry.points, range(len(geometry)))
    return next((points for points in frames if len(points)), np.empty((0, 3)))


def patch_paths(tracked: Trajectories, spacing: float) -> MotionPaths | None:
    """Long trajectories, so far (metres) from each other; None: there are none."""
    chosen = spread_out(tracked.positions, spacing)
    return _paths_of(tracked, chosen) if len(chosen) else None


def _paths_of(tracked: Trajectories, chosen: np.ndarray) -> MotionPaths:
    """Motion paths of some trajectories, (K,) int."""
    sigma = tracked.sigma[chosen].astype(float)
    # standard deviations with the median where a sample was not seen
    sigma = np.where(np.isfinite(sigma), sigma, np.nanmedian(sigma))
    ray = tracked.ray[chosen].astype(float)
    alone = ray.any(axis=2)
    if not alone.any():
        return MotionPaths(tracked.positions[chosen], sigma=sigma)
    return MotionPaths(tracked.positions[chosen], sigma=np.where(alone, ALONE_FRACTION, 1.0) * sigma, ray=ray)


def _joined(patches: MotionPaths, nodes: MotionPaths, rest: np.ndarray) -> MotionPaths:
    """Patches followed by the nodes that are on the rest of the surface, (K,) int, each with its own precision."""
    if not len(rest):
        return patches
    positions = np.concatenate([patches.positions, nodes.positions[rest]])
    assert patches.sigma is not None and nodes.sigma is not None and patches.ray is None
    return MotionPaths(positions, sigma=np.concatenate([patches.sigma, nodes.sigma[rest]]))


def _anchors(tracked: Trajectories, spacing: float) -> MotionPaths | None:
    """Trajectories that nodes are held by; None: there are none."""
    chosen = spread_out(tracked.positions, spacing, SHORT_FRACTION)
    return _paths_of(tracked, chosen) if len(chosen) else None
