"""Anybody's geometry as a sequence of point sets: meshes, point clouds, voxel grids, arrays.

A folder is a sequence of files of one format in the order of their numbers, without gaps; one file is one scan, and an
NPZ file may hold a whole sequence. A point with a coordinate that is NaN is a missing one in every format and left out.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from geomocap.errors import GeometryError
from geomocap.files.atomic import fingerprint
from geomocap.files.scan_checks import check_points, check_spacing
from geomocap.files.scan_geometry import (
    ARRAY_ENDINGS,
    SCAN_ENDINGS,
    Places,
    ScanSurface,
    holds_tracks,
    places_on,
    read_array,
    read_surface,
)
from geomocap.files.scan_settings import ScanSettings
from geomocap.model.axis_order import seem_swapped
from geomocap.model.even_choice import evenly_chosen
from geomocap.model.surface import point_spacing
from geomocap.reading import list_folder

_LOOKED_AT = 24  # frames
_ORDER = "(T frames, N points, 3)"
_FARTHEST = 1e5  # diagonals from the origin; ten times farther the equations of motion lose their last digits


@dataclass(frozen=True)
class Scans:
    """A sequence of scans, read one at a time.

    Attributes
    ----------
    source : Path
        The file or folder.
    names : tuple of str
        What each frame came from.
    read : callable
        `read(frame) -> ScanSurface`, scan units.
    settings : ScanSettings
    tracked : bool
        Whether the points are known to be the same in all frames.
    """

    source: Path
    names: tuple[str, ...]
    read: Callable[[int], ScanSurface]
    settings: ScanSettings
    tracked: bool = False

    features = None
    normals = None

    def __len__(self) -> int:
        return len(self.names)

    def points(self, frame: int) -> np.ndarray:
        """Return the points of one frame, (N, 3) float, metres, without those that are NaN; of a mesh, samples.

        Raises
        ------
        GeometryError
            As `surface` does.
        """
        return self.points_of(self.surface(frame), frame)

    def points_of(self, surface: ScanSurface, frame: int) -> np.ndarray:
        """Return the points of a frame whose surface has been read, as `points` does."""
        if surface.faces is None:
            return surface.points[~np.isnan(surface.points).any(axis=1)]
        return self.places(surface, frame).of(surface.points)

    def surface(self, frame: int) -> ScanSurface:
        """Return what the scan of one frame holds, metres.

        Raises
        ------
        GeometryError
            If the scan can't be read, holds no points, infinite coordinates, only points that coincide, or points too
            far from the origin for their diagonal.
        """
        try:
            return self._checked_surface(frame)
        except GeometryError as error:
            raise self.with_order(error) from None

    def with_order(self, error: GeometryError) -> GeometryError:
        """Return an error that says, of an array, which order of axes is expected: another one may be what is wrong."""
        if not self.in_array or _ORDER in str(error):
            return error
        taken = f"{len(self)} frames of {len(self.read(0).points)} points"
        if self.doubts:
            return GeometryError(f"{self.doubts[0]}; if that is right: {str(error).removeprefix(f'{self.source}, ')}")
        return GeometryError(f"{error}; expected {_ORDER}, the array is taken as {taken}")

    @property
    def in_array(self) -> bool:
        """Whether frames are those of one array that doesn't say its axes itself."""
        return self.source.suffix.lower() in ARRAY_ENDINGS and not self.tracked and len(self) > 1

    @property
    def doubts(self) -> tuple[str, ...]:
        """Say so if an array (T, N, 3) seems to hold the axes of frames and points the other way round."""
        if not self.in_array:
            return ()
        points = np.stack([self.read(frame).points for frame in evenly_chosen(len(self), _LOOKED_AT)])
        if not seem_swapped(points.swapaxes(0, 1)):
            return ()
        return (
            f"{self.source}: frames and points seem to be swapped; expected {_ORDER}, it is taken as "
            f"{len(self)} frames of {points.shape[1]} points",
        )

    def _checked_surface(self, frame: int) -> ScanSurface:
        name = self.names[frame]
        surface = self.read(frame).scaled(self.settings.scale)
        points = surface.points
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise GeometryError(f"{name}: expected points of shape (N, 3), got {points.shape}")
        missing = np.isnan(points).any(axis=1)
        if missing.all():
            raise GeometryError(f"{name}: all {len(points)} points are missing (NaN); a frame needs some")
        points = points[~missing]
        if infinite := int(np.isinf(points).any(axis=1).sum()):
            raise GeometryError(f"{name}: {infinite} points are infinite; remove them, or set them to NaN")
        if len(points) > 1 and (points == points[0]).all():
            raise GeometryError(f"{name}: all {len(points)} points coincide; is the file right?")
        check_points(points, name)
        if len(points) > 1:
            with np.errstate(over="ignore"):  # infinitely far is too far, too
                away, diagonal = np.linalg.norm(points.mean(axis=0)), np.linalg.norm(np.ptp(points, axis=0))
            if away > _FARTHEST * diagonal:
                raise GeometryError(
                    f"{name}: points lie {away / diagonal:.1e} times their diagonal from the origin, over "
                    f"{_FARTHEST:.0e}: motions would get lost in rounding; subtract the same offset from all scans"
                )
        return surface

    def places(self, mesh: ScanSurface, frame: int) -> Places:
        """Choose the places on a frame's mesh at which it is sampled.

        Raises
        ------
        GeometryError
            If it has no area.
        """
        try:
            return places_on(mesh, self.settings.samples, self.settings.seed)
        except GeometryError as error:
            raise GeometryError(f"{self.names[frame]}: {error}") from None

    @cached_property
    def spacing(self) -> float:
        """Distance of neighbouring points, metres: as set, or the first scan's mean distance to the nearest one."""
        points = self.points(0)
        if self.settings.spacing is None:
            return point_spacing(points, np.mean)
        given = self.settings.spacing * self.settings.scale
        if len(points) > 1:
            check_spacing(given, point_spacing(points, np.mean), points)
        return given

    def fingerprint(self) -> str:
        """Digest of the files' names, sizes and times."""
        return fingerprint([self.source])


def open_scans(source: str | Path, settings: ScanSettings) -> Scans:
    """Open a file or a folder of scans; of a folder nothing but names is read yet.

    Raises
    ------
    GeometryError
        If there is nothing that can be read, or a folder's files are no single sequence without gaps.
    """
    source = Path(source)
    if source.is_dir():
        files = _sequence(source)
        return Scans(source, tuple(str(f) for f in files), lambda k: read_surface(files[k]), settings)
    if not source.is_file():
        raise GeometryError(f"{source}: no such file or folder of scans")
    if source.suffix.lower() in ARRAY_ENDINGS:
        array = read_array(source)
        frames = array if array.ndim == 3 else array[None]
        if not len(frames):
            raise GeometryError(f"{source}: holds no frames; expected points of shape (T, N, 3), got {array.shape}")
        names = tuple(f"{source}, frame {k}" for k in range(len(frames)))
        return Scans(source, names, lambda k: ScanSurface(frames[k]), settings, holds_tracks(source))
    return Scans(source, (str(source),), lambda _: read_surface(source), settings)


def _sequence(folder: Path) -> list[Path]:
    """List a folder's scans in the order of their numbers; refuse what is not one sequence."""
    files = [
        p for p in list_folder(folder, GeometryError) if p.suffix.lower() in SCAN_ENDINGS and not p.name.startswith(".")
    ]
    if not files:
        raise GeometryError(f"{folder}: holds no scans ({', '.join(e[1:] for e in SCAN_ENDINGS)})")
    formats = sorted({p.suffix.lower()[1:] for p in files})
    if len(formats) > 1:
        raise GeometryError(f"{folder}: holds scans of several formats ({', '.join(formats)}); keep one of them")
    files.sort(key=_by_number)
    patterns = {tuple(re.split(r"\d+", p.stem.lower())): p.name for p in reversed(files)}
    if len(patterns) > 1 and any(len(texts) > 1 for texts in patterns):
        first, second, *_ = sorted(patterns.values())
        raise GeometryError(f"{folder}: {first} and {second} are of different sequences; keep one sequence in a folder")
    _check_gaps(folder, files)
    return files


def _check_gaps(folder: Path, files: list[Path]) -> None:
    """Refuse numbers that are missing or there twice: frames are evenly spaced in time."""
    numbers = [tuple(int(n) for n in re.findall(r"\d+", p.stem)) for p in files]
    for k, (a, b) in enumerate(pairwise(numbers)):
        if a and a == b:
            raise GeometryError(f"{folder}: {files[k].name} and {files[k + 1].name} have the same number; remove one")
    varying = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1]
    if len(varying) != 1:  # no numbers, a single file, or dates with times, which may jump
        return
    number = varying[0]
    step = min(b - a for a, b in pairwise(number))
    for k, (a, b) in enumerate(pairwise(number)):
        if b - a >= 2 * step:
            raise GeometryError(
                f"{folder}: number {a + step} is missing between {files[k].name} and {files[k + 1].name}; "
                "add it, or number the files without gaps"
            )


def _by_number(path: Path) -> list[tuple[int, int, str]]:
    """Sort key under which frame10 comes after frame9."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts]
