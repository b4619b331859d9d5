"""Plots of a run: joint angles, paths, integrals, counts, timings. Each returns the bytes of a PNG."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from threading import Lock
from typing import Any, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from geomocap.model.ellipsoids import Ellipsoids
from geomocap.model.rotations import rotation_vectors
from geomocap.model.skeleton import Skeleton
from viz.body_colors import ACCENT, INK, body_color, hex_color
from viz.drawing import DENSITY
from viz.quality_figures import Bone, Coverage, PathFigures

P = ParamSpec("P")

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9aa1aa",
    "axes.labelcolor": "#4a525c",
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlecolor": hex_color(INK),
    "axes.grid": True,
    "grid.color": "#e7e9ec",
    "grid.linewidth": 0.7,
    "xtick.color": "#6a727c",
    "ytick.color": "#6a727c",
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
}
MUTED = "#9aa1aa"
WIDTH = 9.6
"""Width of every plot, inches."""
_ONE_AT_A_TIME = Lock()  # Matplotlib's styles and fonts are those of the process


def plot(draw: Callable[P, Figure]) -> Callable[P, bytes]:
    """Give a function that draws a figure the project's style, and turn the figure into a PNG."""

    def styled(*args: P.args, **kwargs: P.kwargs) -> bytes:
        with _ONE_AT_A_TIME, matplotlib.rc_context(STYLE):
            figure = draw(*args, **kwargs)
            if figure.get_layout_engine() is None:
                figure.tight_layout()  # one pass; layout="tight" takes two, to the same picture
            buffer = io.BytesIO()
            FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
            return buffer.getvalue()

    styled.__doc__ = draw.__doc__
    styled.__name__ = draw.__name__
    return styled


def figure_of(width: float, height: float) -> Figure:
    """Return an empty figure, sizes in inches."""
    return Figure(figsize=(width, height), dpi=100 * DENSITY)


def times_axis(count: int, fps: float | None) -> tuple[np.ndarray, str]:
    """Return the times of frames and what an axis of them is called."""
    return (np.arange(count) / fps, "time (s)") if fps else (np.arange(count), "frame")


def _at_least(ax: Axes, span: float) -> None:
    """Keep an axis from magnifying what is smaller than `span`."""
    low, high = ax.get_ylim()
    if high - low < span:
        ax.set_ylim((low + high - span) / 2, (low + high + span) / 2)


@plot
def joint_angles(skeleton: Skeleton, fps: float | None) -> Figure:
    """Plot each joint's rotation since the first frame: its size, and its parts about the parent's axes."""
    vectors = np.rad2deg(skeleton.joint_rotations())
    size = np.linalg.norm(vectors, axis=2)
    times, label = times_axis(len(vectors), fps)
    count = len(skeleton.joint_names)
    columns = min(4, max(2, count))
    rows = -(-count // columns)
    figure = figure_of(WIDTH, 1.45 * rows + 0.5)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    top = max(float(np.nanmax(size, initial=5.0)), 5.0)
    for j, ax in enumerate(axes.flat):
        if j >= count:
            ax.set_visible(False)
            continue
        color = hex_color(body_color(int(skeleton.joint_bodies[j, 1])))
        for part in range(3):
            ax.plot(times, vectors[:, j, part], color=MUTED, lw=0.7, alpha=0.8)
        ax.plot(times, size[:, j], color=color, lw=1.8)
        ax.set_title(skeleton.joint_names[j])
        ax.set_ylim(-1.05 * top, 1.05 * top)
    figure.supxlabel(label, fontsize=8.5, color="#4a525c")
    figure.supylabel("rotation since the first frame (°)", fontsize=8.5, color="#4a525c")
    return figure


@plot
def body_motion(skeleton: Skeleton, fps: float | None) -> Figure:
    """Plot how far the root body has turned and moved since the first frame, and the parts along the world's axes."""
    turned = np.rad2deg(rotation_vectors(skeleton.body_rotations[:, [skeleton.root]])[:, 0])
    moved = 1000 * (skeleton.root_positions - skeleton.root_positions[0])
    times, label = times_axis(skeleton.frame_count, fps)
    figure = figure_of(WIDTH, 2.5)
    axes = figure.subplots(1, 2)
    name = skeleton.body_names[skeleton.root]
    for ax, vectors, title in zip(axes, (turned, moved), ("turn (°)", "way (mm)"), strict=True):
        for part, axis, dashes in zip(vectors.T, "xyz", ("-", "--", ":"), strict=True):
            ax.plot(times, part, color=MUTED, lw=0.9, ls=dashes, label=axis)
        ax.plot(times, np.linalg.norm(vectors, axis=1), color=hex_color(body_color(skeleton.root)), lw=1.8)
        ax.set_title(f"{name}: {title}")
        ax.set_xlabel(label)
        _at_least(ax, 10.0)
        ax.legend(ncols=3, loc="best", fontsize=7)
    return figure


@plot
def path_curves(paths: PathFigures, body: np.ndarray, up: str, fps: float | None) -> Figure:
    """Plot the relative paths' coordinates and the distance curves to the seed, as in the M3 paper's figure 4."""
    times, label = times_axis(len(paths.relative), fps)
    figure = figure_of(WIDTH, 4.9)
    axes = figure.subplots(2, 2, sharex=True)
    order = [*(d for d in range(3) if "xyz"[d] != up), "xyz".index(up)]
    colors = [hex_color(body_color(int(b))) for b in body]
    for ax, d in zip(axes.flat, order, strict=False):
        for k, color in enumerate(colors):
            ax.plot(times, 1000 * paths.relative[:, k, d], color=color, lw=0.9, alpha=0.85)
        _at_least(ax, 10.0)
        ax.set_title(f"{'xyz'[d]} of the relative paths (mm)" + (", up" if "xyz"[d] == up else ""))
    last = axes[1, 1]
    for k, color in enumerate(colors):
        if k != paths.seed:
            last.plot(times, 1000 * paths.distance[:, k], color=color, lw=0.9, alpha=0.85)
    last.set_title(f"distance to the relative path of the seed, ellipsoid {paths.seed} (mm)")
    last.set_ylim(bottom=0)
    for ax in axes[1]:
        ax.set_xlabel(label)
    return figure


@plot
def integrals(paths: PathFigures, body: np.ndarray) -> Figure:
    """Plot the integrals of the distance curves: to the seed, sorted, and of all pairs, with the threshold."""
    figure = figure_of(WIDTH, 2.9)
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    values = 1000 * paths.integrals[paths.seed]
    order = [k for k in np.argsort(values, kind="stable") if k != paths.seed]
    left.bar(range(len(order)), values[order], color=[hex_color(body_color(int(body[k]))) for k in order], width=0.85)
    left.set_title(f"integrals to the seed, ellipsoid {paths.seed}, sorted (mm)")
    left.set_xticks([])
    left.set_xlabel("ellipsoids")
    left.grid(axis="x", visible=False)
    pairs = 1000 * paths.integrals[np.triu_indices(len(paths.integrals), 1)]
    pairs = pairs[np.isfinite(pairs)]
    if len(pairs):
        right.hist(pairs, bins=min(60, max(8, len(pairs) // 6)), color=hex_color(ACCENT), alpha=0.75)
    right.set_title("integrals of all pairs (mm)")
    right.set_ylabel("pairs")
    if paths.threshold is not None:
        text = f"threshold {1000 * paths.threshold:.1f} mm"
        left.axhline(1000 * paths.threshold, color=hex_color(INK), lw=1, ls="--")
        left.text(-0.4, 1000 * paths.threshold, text, va="bottom", fontsize=7.5, backgroundcolor="#ffffffb0")
        right.axvline(1000 * paths.threshold, color=hex_color(INK), lw=1, ls="--")
    return figure


@plot
def counts(numbers: Mapping[str, tuple[Sequence[int], np.ndarray]]) -> Figure:
    """Plot the number of points of each frame: {what: (frames, numbers)}."""
    figure = figure_of(WIDTH, 2.0)
    ax = figure.subplots()
    shades = [hex_color(ACCENT), "#c2571a", "#5b8c2a"]
    for (name, (frames, values)), color in zip(numbers.items(), shades, strict=False):
        ax.plot(frames, values, color=color, marker="." if len(values) < 40 else None, label=name)
    ax.set_xlabel("frame")
    ax.set_ylim(bottom=0)
    ax.legend(ncols=3, loc="lower right")
    return figure


@plot
def coverage(cover: Coverage) -> Figure:
    """Plot the fraction of each camera's image that the silhouette covers."""
    figure = figure_of(WIDTH, 2.6)
    ax = figure.subplots()
    shades = matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(cover.cameras)))
    for camera, fraction, cut, color in zip(cover.cameras, cover.fraction, cover.cut, shades, strict=True):
        ax.plot(cover.frames, 100 * fraction, color=color, label=camera)
        ax.plot(cover.frames[cut], 100 * fraction[cut], ls="", marker="x", ms=4, color=color)
    ax.set_xlabel("frame")
    ax.set_title("fraction of the image inside the silhouette (%); × where it reaches the image's border")
    ax.set_ylim(bottom=0)
    ax.legend(ncols=1, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


@plot
def ellipsoid_errors(ellipsoids: Ellipsoids) -> Figure:
    """Plot the ellipsoids' point counts and fitting errors over time."""
    figure = figure_of(WIDTH, 2.3)
    axes = figure.subplots(1, 2)
    colors = [hex_color(body_color(int(b))) for b in ellipsoids.bodies]
    for ax, values, title in (
        (axes[0], ellipsoids.counts, "points of each ellipsoid"),
        (axes[1], ellipsoids.errors, "fitting error D of each ellipsoid"),
    ):
        for k, color in enumerate(colors):
            ax.plot(values[:, k], color=color, lw=0.8, alpha=0.85)
        ax.set_title(title)
        ax.set_xlabel("frame")
        ax.set_ylim(bottom=0)
    return figure


@plot
def bone_lengths(bones: Sequence[Bone], fps: float | None) -> Figure:
    """Plot how far each bone's length is from its mean over time."""
    figure = figure_of(WIDTH, 2.5)
    ax = figure.subplots()
    for bone in bones:
        times, label = times_axis(len(bone.lengths), fps)
        color = hex_color(body_color(bone.body))
        ax.plot(times, 1000 * (bone.lengths - bone.mean), color=color, lw=1.0)
        ax.set_xlabel(label)
    _at_least(ax, 4.0)
    ax.set_title("bone length minus its mean (mm)")
    return figure


@plot
def timings(stages: dict[str, dict[str, float]]) -> Figure:
    """Plot the seconds of each stage."""
    names = list(stages)
    figure = figure_of(WIDTH, 0.3 * len(names) + 0.7)
    ax = figure.subplots()
    seconds = [float(stages[n]["seconds"]) for n in names]
    ax.barh(names, seconds, color=hex_color(ACCENT), height=0.62)
    for y, s in enumerate(seconds):
        ax.text(s, y, f"  {s:.2f} s", va="center", fontsize=8)
    ax.invert_yaxis()
    ax.margins(x=0.12)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("seconds")
    return figure
