"""Key-points in the report: seen from the front and from the top with their links, their speeds, over the pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from geomocap.scheduling import map_items, threads
from viz.body_colors import INK, body_color, hex_color
from viz.drawing import DENSITY, resize, sheet
from viz.figures import WIDTH, figure_of, plot, times_axis
from viz.keypoint_marks import Marks, marked
from viz.run_contents import Results
from viz.viewpoints import ViewStage

_STICKS = 12  # frames whose links are drawn


@plot
def paths(marks: Marks, stage: ViewStage) -> Figure:
    """Plot the ways of key-points from the front and from the top, with their links at some moments."""
    ahead = np.cross(stage.up, stage.broad)
    along = [marks.positions @ axis for axis in (stage.broad, stage.up, ahead)]
    spans = [max(float(np.nanmax(a) - np.nanmin(a)), 0.05) if np.isfinite(a).any() else 1.0 for a in along]
    height = 0.45 * WIDTH * max(spans[1], spans[2]) / spans[0]
    figure = figure_of(WIDTH, float(np.clip(height, 2.6, 6.5)) + 0.6)
    left, right = figure.subplots(1, 2)
    for ax, other, title in ((left, along[1], "from the front"), (right, along[2], "from the top")):
        _draw_ways(ax, marks, along[0], other)
        ax.set_title(title)
        ax.set_aspect("equal", adjustable="box", anchor="N")
        ax.set_xlabel("across (m)")
    left.set_ylabel("up (m)")
    right.set_ylabel("ahead (m)")
    return figure


def _draw_ways(ax: Axes, marks: Marks, x: np.ndarray, y: np.ndarray) -> None:
    T = len(x)
    for t in sorted({round(p) for p in np.linspace(0, T - 1, min(_STICKS, T))}):
        for a, b in marks.links:
            ax.plot(x[t, [a, b]], y[t, [a, b]], color="#7d858f", lw=0.9, alpha=0.25 + 0.6 * t / max(T - 1, 1))
    measured = np.where(marks.bridged, np.nan, 1.0)
    for k, name in enumerate(marks.names):
        color = hex_color(body_color(k))
        ax.plot(x[:, k], y[:, k], color=color, lw=0.9, ls=(0, (1, 1.2)))
        ax.plot(x[:, k] * measured[:, k], y[:, k], color=color, lw=1.9)
        known = np.flatnonzero(np.isfinite(x[:, k]))
        if len(known):
            last = known[-1]
            ax.plot(x[last, k], y[last, k], "o", ms=4.5, color=color)
            at = (x[last, k], y[last, k])
            ax.annotate(name, at, (5, 3), textcoords="offset points", fontsize=8, color=hex_color(INK))


@plot
def speeds(marks: Marks, velocities: np.ndarray, fps: float | None) -> Figure:
    """Plot the speed of each key-point over time; dotted where it is bridged.

    Parameters
    ----------
    marks : Marks
    velocities : (T, K, 3) float, m/s
    fps : float, optional
    """
    figure = figure_of(WIDTH, 2.8)
    ax = figure.subplots()
    times, label = times_axis(len(velocities), fps)
    size = np.linalg.norm(velocities, axis=2)
    for k, name in enumerate(marks.names):
        color = hex_color(body_color(k))
        ax.plot(times, size[:, k], color=color, lw=0.9, ls=(0, (1, 1.2)))
        ax.plot(times, np.where(marks.bridged[:, k], np.nan, size[:, k]), color=color, label=name)
    ax.set_title("speed (m/s); dotted: bridged")
    ax.set_xlabel(label)
    ax.set_ylim(bottom=0)
    ax.legend(ncols=1 + (len(marks.names) > 14), loc="center left", bbox_to_anchor=(1, 0.5), fontsize=7.5)
    return figure


def overlay_sheet(results: Results, marks: Marks, frames: Sequence[int], most: int = 4) -> np.ndarray | None:
    """Return the key-points drawn over the pictures of the cameras that see most of them, frames side by side."""
    capture = results.capture
    if capture is None or not capture.is_calibrated or not marks.names:
        return None
    frames = [f for f in frames if f < len(marks.positions)]
    seen = []
    for pixels, size in zip(capture.rig.project(marks.positions.reshape(-1, 3)), capture.rig.sizes, strict=True):
        with np.errstate(invalid="ignore"):
            seen.append(int(((pixels > 0) & (pixels < size)).all(axis=1).sum()))
    best = sorted(np.argsort(-np.array(seen), kind="stable")[:most].tolist())

    def row(c: int) -> list[np.ndarray | None]:
        camera = capture.cameras[c]
        tiles: list[np.ndarray | None] = []
        for frame in frames:
            image = capture.frame(camera, frame)
            scale = min(1.0, 420 * DENSITY / max(image.shape[:2]))
            small = resize(image, (round(image.shape[1] * scale), round(image.shape[0] * scale)))
            tiles.append(marked(small, capture.rig.select([camera]), marks, frame))
        return tiles

    with threads() as executor:
        rows = list(map_items(row, best, executor))
    return sheet(rows, [capture.cameras[c] for c in best], [f"frame {f}" for f in frames], framed=True)
