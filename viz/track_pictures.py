"""Pictures of tracked surface points: trajectories by displacement, velocities as arrows, filters off and on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import matplotlib
import numpy as np

from geomocap.model.trajectories import Tracks
from viz.body_colors import ACCENT
from viz.drawing import DENSITY, FAINT, faded, resize, sheet, write_on
from viz.run_contents import Results
from viz.viewpoints import View, ViewStage, camera_view

REMOVED = (200, 30, 50)
"""What the filters cut off or removed."""

_TRAIL = 12  # frames of a trajectory that are drawn
_ARROW = 0.1  # s of motion that an arrow stands for
_CELL = 9 * DENSITY  # px; in a cell of the picture only the nearest points are drawn
_BEHIND = 0.06  # m behind the nearest one is hidden
_ARROWS = 450
_CORNER = (7 * DENSITY, 7 * DENSITY)


def trajectory_sheet(
    results: Results, stage: ViewStage, tracks: Tracks, frames: Sequence[int], longest_side: int = 560 * DENSITY
) -> np.ndarray | None:
    """Draw the trajectories of the last frames before each of `frames`, coloured by displacement: (H, W, 3) uint8."""
    trails = [_trail(tracks.trajectories.positions, results.place(f)) for f in frames]
    top = _top(np.concatenate([_displacement(t)[1] for t in trails]))
    row = []
    for frame, trail in zip(frames, trails, strict=True):
        canvas, view = _background(results, stage, tracks, frame, longest_side)
        which, shift = _displacement(trail)
        canvas = _draw_trails(canvas, view, trail[which], _colors(shift / top))
        row.append(write_on(canvas, f"frame {frame}", _CORNER, 13 * DENSITY, bold=True, plate=(255, 255, 255)))
    return _with_scale(sheet([row], framed=True), f"displacement over {_TRAIL} frames", 1000 * top, "mm")


def velocity_sheet(
    results: Results, stage: ViewStage, tracks: Tracks, frames: Sequence[int], longest_side: int = 560 * DENSITY
) -> np.ndarray | None:
    """Draw velocities as arrows, coloured by speed: (H, W, 3) uint8."""
    speeds = [np.linalg.norm(tracks.motion.velocities[:, results.place(f)], axis=1) for f in frames]
    top = _top(np.concatenate(speeds))
    row = []
    for frame, speed in zip(frames, speeds, strict=True):
        canvas, view = _background(results, stage, tracks, frame, longest_side)
        which = np.flatnonzero(np.isfinite(speed))
        start = tracks.trajectories.positions[which, results.place(frame)]
        which = which[_front(view, start)]
        which = which[:: max(1, len(which) // _ARROWS)]
        start = tracks.trajectories.positions[which, results.place(frame)]
        end = start + _ARROW * tracks.motion.velocities[which, results.place(frame)]
        colors = _colors(speed[which] / top)
        (a, _), (b, _) = view.project(start), view.project(end)
        for p, q, color in zip(a, b, colors, strict=True):
            if np.isfinite([p, q]).all():
                tip = 4.0 * DENSITY / max(float(np.linalg.norm(q - p)), 4.0 * DENSITY)
                cv2.arrowedLine(canvas, _pixel(p), _pixel(q), color, DENSITY, cv2.LINE_AA, tipLength=tip)
        row.append(write_on(canvas, f"frame {frame}", _CORNER, 13 * DENSITY, bold=True, plate=(255, 255, 255)))
    return _with_scale(sheet([row], framed=True), f"speed; arrows show {_ARROW:g} s of motion", top, "m/s")


def filter_sheet(
    results: Results, stage: ViewStage, tracks: Tracks, frame: int, longest_side: int = 760 * DENSITY
) -> np.ndarray | None:
    """Draw the trajectories round a frame without filters, what they cut or remove in red, and with them."""
    if tracks.unfiltered is None or tracks.kept is None:
        return None
    unfiltered = tracks.unfiltered.astype(float)
    place = results.place(frame)
    left = np.zeros(len(unfiltered), bool)
    left[tracks.kept] = np.isfinite(tracks.trajectories.positions[:, place, 0])
    tiles = []
    for name, positions in (("filters off", unfiltered), ("filters on", tracks.trajectories.positions)):
        canvas, view = _background(results, stage, tracks, frame, longest_side)
        trail = _trail(positions, place)
        measured = np.isfinite(positions[:, place, 0])
        bad = measured & ~left if positions is unfiltered else np.zeros(len(positions), bool)
        good = measured & ~bad
        canvas = _draw_trails(canvas, view, trail[good], [ACCENT] * int(good.sum()))
        canvas = _draw_trails(canvas, view, trail[bad], [REMOVED] * int(bad.sum()), hide=False)
        words = f"{name}: {int(measured.sum())} points" + (
            f", {int(bad.sum())} cut or removed here" if bad.any() else ""
        )
        tiles.append(write_on(canvas, words, _CORNER, 13 * DENSITY, bold=True, plate=(255, 255, 255)))
    return sheet([tiles], framed=True)


def _background(
    results: Results, stage: ViewStage, tracks: Tracks, frame: int, longest_side: int
) -> tuple[np.ndarray, View]:
    """Return the picture to draw on: the image of the camera that sees most, cut, or a white free view."""
    capture = results.capture
    if capture is None or not capture.is_calibrated:
        size = (longest_side * 3 // 4, longest_side)
        return np.full((size[1], size[0], 3), 255, np.uint8), stage.at(stage.view(30, 10, size), results.place(frame))
    seen = tracks.trajectories.positions[np.isfinite(tracks.trajectories.positions[:, :, 0])][::50]
    fractions = []
    for c in range(len(capture.rig)):
        view = camera_view(capture.rig, c)
        pixel, _ = view.project(seen)
        with np.errstate(invalid="ignore"):
            inside = ((pixel > 0) & (pixel < view.size)).all(axis=1)
        spread = np.nanstd(pixel, axis=0).prod() if inside.any() else 0.0
        fractions.append(inside.mean() * spread)
    camera = int(np.argmax(fractions))
    name = capture.rig.names[camera]
    whole = camera_view(capture.rig, camera)
    pixel, _ = whole.project(seen)
    low = np.maximum(np.nanpercentile(pixel, 0.5, axis=0) - 0.04 * max(whole.size), 0)
    high = np.minimum(np.nanpercentile(pixel, 99.5, axis=0) + 0.04 * max(whole.size), whole.size)
    scale = longest_side / float((high - low).max())
    cut = _Enlarged(whole, low, scale, (int((high - low)[0] * scale), int((high - low)[1] * scale)))
    x, y = low.astype(int)
    part = capture.frame(name, frame)[y : int(high[1]), x : int(high[0])]
    return faded(resize(np.ascontiguousarray(part), cut.size), 0.55), cut


@dataclass(frozen=True)
class _Enlarged:
    """A part of a view, enlarged."""

    whole: View
    low: np.ndarray
    scale: float
    size: tuple[int, int]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixel, depth = self.whole.project(points)
        return (pixel - self.low) * self.scale, depth

    def rays(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.whole.rays(np.asarray(pixels, float) / self.scale + self.low)


def _trail(positions: np.ndarray, place: int) -> np.ndarray:
    return positions[:, max(place - _TRAIL, 0) : place + 1]


def _displacement(trail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trajectories measured in the last frame and before, and how far they came: indices, (N,) metres."""
    known = np.isfinite(trail[:, :, 0])
    which = np.flatnonzero(known[:, -1] & (known.sum(axis=1) > 1))
    first = known[which].argmax(axis=1)
    return which, np.linalg.norm(trail[which, -1] - trail[which, first], axis=1)


def _draw_trails(
    canvas: np.ndarray, view: View, trails: np.ndarray, colors: Sequence[tuple[int, int, int]], hide: bool = True
) -> np.ndarray:
    if not len(trails):
        return canvas
    known = np.isfinite(trails[:, :, 0])
    last = trails[np.arange(len(trails)), trails.shape[1] - 1 - known[:, ::-1].argmax(axis=1)]
    show = np.flatnonzero(_front(view, last)) if hide else np.arange(len(trails))
    pixels = np.full((*known.shape, 2), np.nan)
    pixels[known] = view.project(trails[known])[0]
    drawn = np.isfinite(pixels[:, :, 0]) & np.isfinite(pixels[:, :, 1])
    for n in show.tolist():
        points = np.round(8 * (pixels[n, drawn[n]] - 0.5)).astype(np.int32)
        cv2.polylines(canvas, [points], False, colors[n], DENSITY, cv2.LINE_AA, shift=3)
    ends, _ = view.project(last)
    for n in show.tolist():
        if np.isfinite(ends[n]).all():
            cv2.circle(canvas, _pixel(ends[n]), DENSITY, colors[n], -1, cv2.LINE_AA)
    return canvas


def _front(view: View, points: np.ndarray) -> np.ndarray:
    """Which points lie in front: no other one nearer in the same or a neighbouring cell of the picture."""
    pixel, depth = view.project(points)
    show = np.zeros(len(points), bool)
    known = np.flatnonzero(np.isfinite(pixel).all(axis=1))
    if not len(known):
        return show
    cell = np.floor(pixel[known] / _CELL).astype(int)
    cell -= cell.min(axis=0) - 1
    nearest = np.full(cell.max(axis=0) + 2, np.inf, np.float32)
    np.minimum.at(nearest, tuple(cell.T), depth[known].astype(np.float32))
    nearest = cv2.erode(nearest, np.ones((3, 3), np.uint8))
    show[known] = depth[known] < nearest[tuple(cell.T)] + _BEHIND
    return show


def _top(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return max(float(np.percentile(known, 98)), 1e-6) if len(known) else 1.0


def _colors(fractions: np.ndarray) -> list[tuple[int, int, int]]:
    """Colours of a scale for fractions from 0 to 1."""
    table = np.rint(255 * np.asarray(matplotlib.colormaps["turbo"](np.clip(fractions, 0, 1)))[:, :3]).astype(int)
    return [(r, g, b) for r, g, b in table.tolist()]


def _with_scale(image: np.ndarray, words: str, top: float, unit: str) -> np.ndarray:
    """Put a colour scale below a picture."""
    d = DENSITY
    strip = np.empty((34 * d, image.shape[1], 4), np.uint8)
    strip[:] = (*FAINT, 0)
    length = min(240 * d, image.shape[1] // 3)
    strip[11 * d : 23 * d, 50 * d : 50 * d + length, :3] = np.array(_colors(np.linspace(0, 1, length)), np.uint8)[None]
    strip[11 * d : 23 * d, 50 * d : 50 * d + length, 3] = 255
    strip = write_on(strip, "0", (40 * d, 17 * d), 12 * d, FAINT, anchor="rm")
    strip = write_on(strip, f"{top:.3g} {unit}  {words}", (58 * d + length, 17 * d), 12 * d, FAINT, anchor="lm")
    return np.concatenate([image, strip])


def _pixel(place: np.ndarray) -> tuple[int, int]:
    return round(float(place[0]) - 0.5), round(float(place[1]) - 0.5)
