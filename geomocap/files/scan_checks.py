"""What scans can't be: points that no scanner gives, and frames that don't belong to the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError
from geomocap.progress import Progress, silent

LARGEST, SMALLEST = 1e5, 1e-5  # metres across; beyond, lengths are no metres
USUAL = (0.02, 50.0)  # metres across; beyond, they are likely in other units
STRAY = 1000.0  # times as far from the middle as most points: one that was never measured
OTHER_SIZE = 10.0  # times larger or smaller than the others: another unit, or another thing
JUMP = 10.0  # times its own size from one frame to the next
THIN = 1e-5  # of its length is the width of a line, and the thickness of a plane


@dataclass(frozen=True)
class ScanShape:
    """Where the points of a scan are and how they spread.

    Attributes
    ----------
    middle : (3,) float
        Median of the points, metres.
    size : float
        Diagonal of the box around the middle nine tenths of the points, metres.
    sides : (3,) float
        Standard deviations along their principal axes, the largest first, metres.
    """

    middle: np.ndarray
    size: float
    sides: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> ScanShape:
        """Describe finite points (N, 3)."""
        middle = np.median(points, axis=0)
        low, high = np.percentile(points, (5, 95), axis=0)
        about = points - points.mean(axis=0)
        sides = np.sqrt(np.maximum(np.linalg.eigvalsh(about.T @ about / len(points))[::-1], 0))
        return cls(middle, float(np.linalg.norm(high - low)), sides)


def check_points(points: np.ndarray, name: str) -> None:
    """Refuse finite points (N, 3), metres, that no scanner gives.

    Raises
    ------
    GeometryError
        If single points are far away from all others, or all are as far apart as no metres are.
    """
    if len(points) < 2:
        return
    with np.errstate(over="ignore", invalid="ignore"):
        away = np.abs(points - np.median(points, axis=0)).max(axis=1)
        most = float(np.percentile(away, 90, method="higher"))
        far = int(np.argmax(away))
        if most > 0 and away[far] > STRAY * most:
            raise GeometryError(
                f"{name}: point {far} lies {away[far]:.3g} m away from the others, which are within {most:.3g} m; "
                "remove it, or set it to NaN"
            )
        across = float(np.ptp(points, axis=0).max())
        if not SMALLEST <= across <= LARGEST:
            expected = f"expected {SMALLEST:g} to {LARGEST:g}"
            raise GeometryError(
                f"{name}: is {across:.3g} m across, {expected}; set scans.scale to the metres of its unit"
            )


def scan_doubts(
    points: Callable[[int], np.ndarray], names: tuple[str, ...], progress: Progress = silent
) -> tuple[str, ...]:
    """Compare the scans of a sequence, and say what is doubtful about them all.

    Parameters
    ----------
    points : callable
        `points(frame) -> (N, 3)`, metres, finite.
    names : tuple of str
        Of the frames.
    progress : callable, optional

    Raises
    ------
    GeometryError
        If one is of another size than the others, in another place than the one before it, or a line.
    """
    shapes = []
    for frame, name in enumerate(names):
        shapes.append(ScanShape.of(_checked(points(frame), name)))
        progress("scans", frame + 1, len(names))
    sizes = np.array([shape.size for shape in shapes])
    usual = float(np.median(sizes))
    doubts = []
    for name, shape in zip(names, shapes, strict=True):
        if usual > 0 and not usual / OTHER_SIZE <= shape.size <= usual * OTHER_SIZE:
            raise GeometryError(
                f"{name}: is {shape.size:.3g} m across, the scans are {usual:.3g} m usually; "
                "is it in another unit, or of something else?"
            )
        if shape.sides[1] <= THIN * shape.sides[0]:
            raise GeometryError(f"{name}: all its points lie in a line; there is no surface in it")
    for k in range(1, len(shapes)):
        step = float(np.linalg.norm(shapes[k].middle - shapes[k - 1].middle))
        if step > JUMP * usual:
            late = k + 1 < len(shapes) and np.linalg.norm(shapes[k + 1].middle - shapes[k].middle) < step / 2
            raise GeometryError(
                f"{names[k]}: lies {step:.3g} m away from the frame before it, {step / usual:.0f} times its size"
                f"{'; all from there on do' if late else ''}; is its origin another?"
            )
    if not USUAL[0] <= usual <= USUAL[1]:
        doubts.append(
            f"the scans are {usual:.3g} m across, which are likely no metres; set scans.scale, 0.001 for millimetres"
        )
    if flat := [name for name, shape in zip(names, shapes, strict=True) if shape.sides[2] <= THIN * shape.sides[0]]:
        more = f", and those of {len(flat) - 1} more scans" if len(flat) > 1 else ""
        doubts.append(f"{flat[0]}: its points{more} lie in a plane; how bodies turn is doubtful there")
    return tuple(doubts)


def check_spacing(spacing: float, measured: float, points: np.ndarray) -> None:
    """Refuse a given distance of neighbouring points that can't be that of points (N, 3); all metres.

    Raises
    ------
    GeometryError
    """
    across = float(np.ptp(points, axis=0).max())
    if not measured / 100 <= spacing <= across:
        raise GeometryError(
            f"scans.spacing is {spacing:.3g} m, but neighbouring points are {measured:.3g} m apart and the scan is "
            f"{across:.3g} m across; leave it out, or give it in the unit of the scans"
        )


def _checked(points: np.ndarray, name: str) -> np.ndarray:
    if not len(points):
        raise GeometryError(f"{name}: holds no points")
    return points
