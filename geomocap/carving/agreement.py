"""Do the silhouettes of a frame agree with each other and with the working volume? Each failure is one clear line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from geomocap.carving.carving_settings import ENCLOSING, HullSettings
from geomocap.carving.hull import hull
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.subject_bounds import CELLS, space_seen, subject_cells
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import CalibrationError, GeometryError

LOW_COVERAGE = 0.5  # silhouettes of which half the cameras explain less than this are suspicious
CLEAR_GAIN = 0.3  # and a camera is to blame if without it the others' coverage is that much higher
ALL = HullSettings(outside="empty")  # a point counts where all cameras see it


def check_cameras(views: PinholeViews, settings: HullSettings) -> None:
    """Check that the cameras look at one common region; silhouettes are not looked at.

    Raises
    ------
    CalibrationError
        If nothing is seen by all cameras, naming the camera that looks away where there is one; where what is outside a
        view may be unseen, only if nothing is seen by as many cameras as must have a say.
    """
    if len(views) < 2:
        return
    if settings.outside != "empty":
        least = settings.views_of(len(views))
        if not _fraction_view(views, HullSettings(outside="unseen", min_views=least)):
            raise CalibrationError(f"no point is seen by {least} of {', '.join(views.names)}; check their poses")
        return
    if _fraction_view(views):
        return
    away = [name for c, name in enumerate(views.names) if len(views) > 2 and _fraction_view(views.without(c))]
    if len(away) == 1:
        raise CalibrationError(
            f"camera {away[0]} looks away: it sees nothing of what the other cameras all see; check its pose, or leave "
            "it out"
        )
    raise CalibrationError(
        f"no point is seen by all cameras ({', '.join(views.names)}); check their poses, or set carving.hull.outside "
        "to 'auto'"
    )


def check_silhouettes(
    views: PinholeViews, frame: int, settings: HullSettings, given: Mapping[str, Path] | None = None
) -> None:
    """Check that no more cameras have an empty silhouette than the settings bear.

    These are `tolerance`; where what is outside a view may be unseen, all but half the cameras (two at least, four are
    enough).

    Parameters
    ----------
    views : PinholeViews
    frame : int
        For messages.
    settings : HullSettings
    given : mapping of camera name to Path, optional
        The masks that the silhouettes were taken from, for messages.

    Raises
    ------
    GeometryError
        If more are empty.
    """
    empty = [views.names[c] for c in np.flatnonzero(views.blind())]
    left = len(views) - len(empty)
    auto = settings.outside == "auto"
    if len(empty) <= settings.tolerance or (auto and left >= max(2, min(ENCLOSING, (len(views) + 1) // 2))):
        return
    cause = "its image and background"
    if given is not None:
        cause = f"{', '.join(str(given[n]) for n in empty)} (expected: 255 where the subject is)"
    remedy = "name the frames that show it in capture.toml (frames = [first, last])"
    if left >= 2 and not auto:
        remedy = f"set carving.hull.outside = 'auto', name only the other cameras in capture.toml, or {remedy}"
    raise GeometryError(
        f"frame {frame}: the silhouette of camera {', '.join(empty)} is empty, or nearly so; check {cause}; where the "
        f"subject is out of view, {remedy}"
    )


def check_agreement(views: PinholeViews, frame: int, settings: HullSettings) -> None:
    """Check that the silhouettes of a frame have a common volume that explains them.

    Raises
    ------
    GeometryError
        If not, naming the camera that contradicts the others: the one without which they agree best.
    """
    fraction = silhouette_coverage(views, settings)
    reached = float(np.median(fraction))
    if reached >= LOW_COVERAGE:
        if not fraction.all():
            raise GeometryError(
                f"frame {frame}: camera {views.names[int(fraction.argmin())]} looks away: what the others see "
                "is nowhere in its silhouette; check its calibration, synchronization and silhouettes, or leave it out"
            )
        return
    without = np.zeros(len(views))
    for c in range(len(views)) if len(views) > 2 else ():
        without[c] = np.median(silhouette_coverage(views.without(c), settings))
    worst = int(without.argmax())
    if without[worst] >= reached + CLEAR_GAIN:
        raise GeometryError(
            f"frame {frame}: the silhouettes of camera {views.names[worst]} contradict the others "
            f"(the common volume explains {reached:.0%} of the silhouettes with it, {without[worst]:.0%} without it); "
            "check its calibration, synchronization and silhouettes, or leave it out"
        )
    if not fraction.any():
        raise GeometryError(
            f"frame {frame}: the silhouettes of {', '.join(views.names)} have no common volume; check calibration, "
            "synchronization and silhouettes"
        )


def silhouette_coverage(views: PinholeViews, settings: HullSettings) -> np.ndarray:
    """Fraction of each silhouette that the hull explains, (C,) float from 0 to 1; 1 for an empty silhouette.

    The hull is the coarse one of `subject_cells`, so that thin parts count as explained.

    Raises
    ------
    GeometryError
        If the volume has no end: the cameras see the subject from one side only.
    """
    cells, origin, edge = subject_cells(views, settings)
    centers, half = origin + (cells + 0.5) * edge, edge / 2
    C, H, W = views.masks.shape
    fraction, blind = np.ones(C), views.blind()
    for c, (P, mask) in enumerate(zip(views.projections, views.masks, strict=True)):
        n = centers @ P[:, :3].T + P[:, 3]
        near = n[:, 2] - half * np.abs(P[2, :3]).sum()
        front = near > 0
        uv = n[front, :2] / n[front, 2:]
        reach = half * np.abs(P[:2, :3] - uv[:, :, None] * P[2, :3]).sum(axis=2) / near[front, None]
        low = np.clip(np.floor(uv - reach), 0, [W, H]).astype(int)
        high = np.clip(np.floor(uv + reach) + 1, 0, [W, H]).astype(int)
        # rectangles of all cells by their corners in a difference image
        corners = np.zeros((H + 1, W + 1), np.int64)
        np.add.at(corners, (low[:, 1], low[:, 0]), 1)
        np.add.at(corners, (high[:, 1], high[:, 0]), 1)
        np.add.at(corners, (low[:, 1], high[:, 0]), -1)
        np.add.at(corners, (high[:, 1], low[:, 0]), -1)
        covered = corners.cumsum(axis=0).cumsum(axis=1)[:H, :W] > 0
        if not blind[c]:
            fraction[c] = covered[mask != 0].mean()
    return fraction


def check_inside(surface: np.ndarray, grid: Grid, frame: int, max_cut: float = 0.0) -> None:
    """Check that the carved subject lies within the working volume.

    Parameters
    ----------
    surface : (N, 3) int
        Surface voxels.
    grid : Grid
    frame : int
        For messages.
    max_cut : float
        Fraction of the surface voxels that may lie on the grid's border.

    Raises
    ------
    GeometryError
        If there are no voxels at all, or too many on the border: the subject is cut off there.
    """
    if len(surface) == 0:
        raise GeometryError(
            f"frame {frame}: subject outside the volume from {_show(grid.low)} to {_show(grid.high)}: no voxel is left"
            "; check carving.volume and the silhouettes"
        )
    sides = []
    cut = np.zeros(len(surface), bool)
    for axis, name in enumerate("xyz"):
        for side, index in (("low", 0), ("high", grid.shape[axis] - 1)):
            on_border = surface[:, axis] == index
            cut |= on_border
            if on_border.any():
                sides.append(f"{side} {name}")
    fraction = float(cut.mean())
    if fraction > max_cut:
        raise GeometryError(
            f"frame {frame}: subject outside the volume from {_show(grid.low)} to {_show(grid.high)}: it is cut off at "
            f"{', '.join(sides)} ({fraction:.1%} of its surface); enlarge carving.volume or allow it by carving.max_cut"
        )


def _fraction_view(views: PinholeViews, settings: HullSettings = ALL) -> bool:
    """Whether some point is seen by enough cameras, looking on several scales round where their axes meet."""
    everything = views.everything()
    center, reach = space_seen(everything)
    for scale in (0.1, 0.5, 1.0, 3.0, 10.0):
        grid = Grid.of_box(center - scale * reach, center + scale * reach, resolution=CELLS)
        if hull(everything, grid, settings).bits.any():
            return True
    return False


def _show(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in point) + ")"
