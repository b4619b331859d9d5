"""Sequences of scans, described."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomocap.errors import GeometryError, GeomocapError
from geomocap.files.scan_checks import scan_doubts
from geomocap.files.scan_geometry import ScanSurface
from geomocap.files.scan_settings import ScanSettings
from geomocap.files.scan_tracks import scan_tracks
from geomocap.files.scans import Scans, open_scans
from geomocap.inspection.capture_description import MOST_NAMED
from geomocap.inspection.description import Description, count


def describe_scans(path: Path, scale: float = 1.0) -> Description:
    """Describe a folder or file of scans, all of which are read; `scale` are metres per unit of theirs."""
    told = Description(path, "scans")
    try:
        scans = open_scans(path, ScanSettings(scale=scale))
    except GeomocapError as error:
        told.problem(error)
        return told
    told.fact("frames", len(scans))
    surfaces = _read(scans, told)
    if not surfaces:
        return told
    sizes = [len(s.points) for s in surfaces]
    meshes = [len(s.faces) for s in surfaces if s.faces is not None]
    if meshes:
        told.fact("meshes", f"{_between(sizes)} vertices, {_between(meshes)} triangles")
    else:
        told.fact("points", f"{_between(sizes)} in a frame")
    missing = float(np.mean([np.isnan(s.points).any(axis=1).mean() for s in surfaces]))
    if missing:
        told.fact("missing points", f"{missing:.1%} (NaN)")
    low = np.min([np.nanmin(s.points, axis=0) for s in surfaces], axis=0)
    high = np.max([np.nanmax(s.points, axis=0) for s in surfaces], axis=0)
    taken = " m" if scale != 1 else ", taken for metres (--metres-per-unit)"
    told.fact("box around all", " × ".join(f"{side:.4g}" for side in high - low) + taken)
    if len(scans) == 1:
        told.fact("motion", "none: one scan gets its ellipsoids")
    elif not told.problems:
        common = scans.tracked or scan_tracks(scans) is not None
        told.fact("points in common", "yes, they are taken as tracks" if common else "no, the surface is followed")
        _compare(scans, surfaces, told)
    return told


def _compare(scans: Scans, surfaces: list[ScanSurface], told: Description) -> None:
    """Say what a segmentation would refuse or warn of."""
    try:
        doubts = scan_doubts(lambda frame: scans.points_of(surfaces[frame], frame), scans.names)
    except GeometryError as error:
        told.problem(error)
        return
    for doubt in doubts:
        told.doubt(doubt)


def _read(scans: Scans, told: Description) -> list[ScanSurface]:
    """Read all frames; the first that are wrong are named."""
    surfaces, wrong = [], []
    for frame in range(len(scans)):
        try:
            surfaces.append(scans.surface(frame))
        except GeomocapError as error:
            wrong.append(str(error))
    for line in wrong[:MOST_NAMED]:
        told.problem(line)
    if len(wrong) > MOST_NAMED:
        told.problem(f"{scans.source}: {count(len(wrong) - MOST_NAMED, 'more scan')} that can't be used")
    return surfaces


def _between(numbers: list[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"
