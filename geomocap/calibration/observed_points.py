"""Observed points from a CSV file, so that any two marked points a known distance apart serve as a bar.

Two kinds of table are read:

- ours, with the columns `frame, camera, point, x, y` (and `sigma`, optional, pixels). Coordinates are COLMAP's: the
  centre of the top-left pixel is (0.5, 0.5).
- caliscope's, with the columns `sync_index, cam_id, keypoint_id, img_loc_x, img_loc_y`. Coordinates are OpenCV's, half
  a pixel is added; camera 0 is called `cam_0`.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomocap.calibration.target_observations import TargetObservations, stack_candidates
from geomocap.errors import CalibrationError

OURS = ("frame", "camera", "point", "x", "y")
CALISCOPE = ("sync_index", "cam_id", "keypoint_id", "img_loc_x", "img_loc_y")


@dataclass(frozen=True)
class Observed:
    """Observed points, one a row.

    Attributes
    ----------
    frames : (N,) int
    cameras : (N,) str
    points : (N,) str
        Names of the points.
    pixels : (N, 2) float
        COLMAP pixels.
    sigmas : (N,) float
        Standard deviation of a coordinate, pixels; NaN where not given.
    """

    frames: np.ndarray
    cameras: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    sigmas: np.ndarray


def read_observed(path: Path) -> Observed:
    """Read a table of observed points.

    Raises
    ------
    CalibrationError
        If it can't be read, has other columns, or a row that is no observation.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            columns = tuple(c.strip() for c in reader.fieldnames or ())
            reader.fieldnames = list(columns)
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: no readable CSV ({error})") from None
    if set(OURS) <= set(columns):
        frame, camera, point, x, y = OURS
        shift, prefix = 0.0, ""
    elif set(CALISCOPE) <= set(columns):
        frame, camera, point, x, y = CALISCOPE
        shift, prefix = 0.5, "cam_"
    else:
        raise CalibrationError(
            f"{path}: columns {', '.join(columns) or 'none'}; expected {', '.join(OURS)} or {', '.join(CALISCOPE)}"
        )
    frames, cameras, points, pixels, sigmas = [], [], [], [], []
    for number, row in enumerate(rows, start=2):
        try:
            frames.append(int(float(row[frame])))
            cameras.append(prefix + row[camera].strip())
            points.append(row[point].strip())
            pixels.append((float(row[x]) + shift, float(row[y]) + shift))
            sigmas.append(float(row.get("sigma") or "nan"))
        except (ValueError, AttributeError, TypeError, KeyError, OverflowError):
            raise CalibrationError(f"{path}: line {number} is no observation: {row}") from None
        if not np.isfinite(pixels[-1]).all():
            raise CalibrationError(f"{path}: line {number}: x and y must be numbers")
    if not rows:
        raise CalibrationError(f"{path}: holds no observations")
    return Observed(
        np.array(frames), np.array(cameras), np.array(points), np.array(pixels).reshape(-1, 2), np.array(sigmas)
    )


def observations_of(
    observed: Observed,
    pairs: Sequence[tuple[str, str]] | None = None,
    sizes: Mapping[str, tuple[int, int]] | None = None,
    sigma: float = 0.5,
    cameras: Sequence[str] | None = None,
) -> TargetObservations:
    """Take two points of a table as the ends of a bar.

    Parameters
    ----------
    observed : Observed
    pairs : sequence of (str, str), optional
        Names of the two points; the only two of the table if not given. Several pairs the same distance apart (both
        diagonals of a board, say) count as bar positions of their own: their frame numbers go on from the first's.
    sizes : mapping of camera name to (width, height), optional
        Image sizes; without them the smallest common size that holds all observations is taken.
    sigma : float
        Standard deviation of a coordinate where the table does not say it, pixels.
    cameras : sequence of str, optional
        The cameras to use, in this order.

    Raises
    ------
    CalibrationError
        If the points are not there, or observations lie outside the images.
    """
    names = tuple(np.unique(observed.points))
    if pairs is None:
        if len(names) != 2:
            shown = ", ".join(names[:12])
            raise CalibrationError(f"the table has {len(names)} points ({shown}); say which two are the bar's ends")
        pairs = [(names[0], names[1])]
    for name in (n for pair in pairs for n in pair):
        if name not in names:
            raise CalibrationError(f"the table has no point {name}; it has {', '.join(names[:12])}")
    wanted = tuple(cameras) if cameras is not None else tuple(sorted(np.unique(observed.cameras)))
    stride = int(observed.frames.max()) + 1
    found: dict[tuple[int, int], np.ndarray] = {}
    for c, camera in enumerate(wanted):
        of_camera = observed.cameras == camera
        for k, pair in enumerate(pairs):
            own = np.flatnonzero(of_camera & np.isin(observed.points, pair))
            for t in np.unique(observed.frames[own]):
                at = own[observed.frames[own] == t]
                at = at[np.argsort(observed.points[at] != pair[0], kind="stable")]
                s = np.where(np.isfinite(observed.sigmas[at]), observed.sigmas[at], sigma)
                found[c, int(t) + k * stride] = np.column_stack([observed.pixels[at], s, np.zeros(len(at))])
        if not any(key[0] == c for key in found):
            raise CalibrationError(f"camera {camera}: the table has no observation of the bar's ends")
    frames = np.unique([t for _, t in found])
    indexed = {(c, int(np.searchsorted(frames, t))): values for (c, t), values in found.items()}
    return stack_candidates(wanted, _sizes(observed, wanted, sizes), frames, indexed)


def _sizes(observed: Observed, cameras: tuple[str, ...], sizes: Mapping[str, tuple[int, int]] | None) -> np.ndarray:
    if sizes is None:
        largest = observed.pixels.max(axis=0)
        common = [(640, 480), (1280, 720), (1280, 1024), (1920, 1080), (2560, 1440), (3840, 2160), (4096, 4096)]
        size = next((s for s in common if largest[0] <= s[0] and largest[1] <= s[1]), None)
        if size is None:
            raise CalibrationError(f"observations reach ({largest[0]:.0f}, {largest[1]:.0f}); give the image sizes")
        return np.array([size] * len(cameras))
    out = []
    for camera in cameras:
        if camera not in sizes:
            raise CalibrationError(f"camera {camera}: its image size is not known")
        own = observed.pixels[observed.cameras == camera]
        if (own < 0).any() or (own > np.array(sizes[camera])).any():
            w, h = sizes[camera]
            x, y = own[np.argmax((own - np.array(sizes[camera])).max(axis=1))]
            raise CalibrationError(
                f"camera {camera}: an observation at ({x:.0f}, {y:.0f}) is outside its image of {w}×{h}; "
                "were the points measured at another size?"
            )
        out.append(sizes[camera])
    return np.array(out)
