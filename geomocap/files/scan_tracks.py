"""Points that scans have in common: meshes of one topology and points in the same order in all frames are tracks."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError
from geomocap.files.scan_geometry import ScanSurface
from geomocap.files.scans import Scans
from geomocap.progress import Progress, silent

_MOST = 8000  # points followed
_NEIGHBOURS = 6
_STRETCHED = 2.0  # times their distance: neighbours on a surface stay nearer than that,
_TOGETHER = 0.9  # this fraction of them, in every frame
_COMPLETE = 0.9  # fraction of points that each frame must have: pixels of a depth image come and go, and are no tracks


def scan_tracks(scans: Scans, certain: bool = False, progress: Progress = silent) -> np.ndarray | None:
    """Find the positions of the same points of the surface in all scans.

    Meshes must have the same triangles in all frames, other scans the same number of points. Unless it is certain that
    the points in one place of the order are the same in all frames, they must be there in nearly all, and what is side
    by side in the first frame must stay so.

    Parameters
    ----------
    scans : Scans
    certain : bool
        Take the points to be the same without looking.
    progress : callable, optional

    Returns
    -------
    (N, T, 3) float or None
        Metres, NaN where missing: places on the first frame's mesh, or points, of which some are chosen where they are
        many. None: the points aren't the same.

    Raises
    ------
    GeometryError
        If a scan can't be used, or it is certain and yet the numbers of points or the triangles differ.
    """
    first = scans.surface(0)
    places = None if first.faces is None else scans.places(first, 0)
    count = len(first.points if places is None else places.fractions)
    chosen = np.arange(count)
    if count > _MOST:
        chosen = np.sort(np.random.default_rng(scans.settings.seed).choice(count, _MOST, replace=False))
    tracks = np.empty((len(chosen), len(scans), 3))
    for t in range(len(scans)):
        surface = scans.surface(t)
        if not _same_order(first, surface):
            if not certain:
                return None
            what = f"{len(surface.points)} points" if first.faces is None else "other triangles or vertices"
            have = f"{len(first.points)}" if first.faces is None else "those of the first frame"
            raise GeometryError(
                f"{scans.names[t]}: {what}, expected {have}; segmentation.paths = points takes the same points in all "
                "frames, set it to nodes for scans without"
            )
        tracks[:, t] = (surface.points if places is None else places.of(surface.points))[chosen]
        if not certain and not _together(tracks[:, 0], tracks[:, t]):
            return None
        if t:
            progress("scans", t + 1, len(scans))
    seen = np.asarray(np.isfinite(tracks).all(axis=2))
    tracks[~seen] = np.nan
    return tracks[seen.any(axis=1)]


def _same_order(first: ScanSurface, other: ScanSurface) -> bool:
    if first.points.shape != other.points.shape:
        return False
    if first.faces is None or other.faces is None:
        return first.faces is other.faces
    return np.array_equal(first.faces, other.faces)


def _together(first: np.ndarray, now: np.ndarray) -> bool:
    """Whether nearly all points (N, 3) of the first frame are there now, and neighbours still are neighbours."""
    seen, still = np.isfinite(first).all(axis=1), np.isfinite(now).all(axis=1)
    if min(seen.mean(), still.mean()) < _COMPLETE or seen.sum() <= _NEIGHBOURS:
        return False
    start = first[seen]
    distance, near = (found[:, 1:] for found in cKDTree(start).query(start, _NEIGHBOURS + 1))
    end = np.where(still[:, None], now, np.nan)[seen]
    stretched = np.linalg.norm(end[near] - end[:, None], axis=2)
    both = np.isfinite(stretched) & (distance > 0)
    return bool(both.any() and (stretched[both] <= _STRETCHED * distance[both]).mean() >= _TOGETHER)
