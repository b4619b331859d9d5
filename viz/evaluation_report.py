"""The page of an evaluation: figures, plots over time, and pictures of where the errors are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from geomocap.evaluation.body_scores import LabelledFrame, labelled_frame
from geomocap.evaluation.result import Curve, Evaluation
from geomocap.evaluation.truth import Truth
from geomocap.files.results import SKELETON, read_points, read_skeleton
from geomocap.files.run import Run
from geomocap.model.skeleton import Skeleton
from geomocap.progress import Progress, silent
from viz.body_colors import ACCENT, body_color, hex_color
from viz.drawing import DENSITY
from viz.figures import MUTED, plot
from viz.matching_review import error_sheet, surface_errors
from viz.report import Block, Report, Section, missing, picture, table, text, write_report
from viz.report import plot as plot_block

WORST_CURVES = 8
KEY_FIGURES = (
    ("bodies.adjusted_rand_index", "adjusted Rand index", "{:.3f}"),
    ("bodies.core_adjusted_rand_index", "the same, cores only", "{:.3f}"),
    ("joints.recall_at_5%h", "joints within 5 % of the height", "{:.0%}"),
    ("joints.mean_error", "mean joint error (mm)", "{:.1f}"),
    ("motion.body_rotation_error_deg", "mean rotation error", "{:.1f}°"),
    ("tracks.drift_median", "median drift of tracks (mm)", "{:.1f}"),
    ("markers.mean_error", "mean distance of matched markers (mm)", "{:.1f}"),
    ("alignment.time_offset_s", "time offset (s)", "{:.3f}"),
)


def evaluation_report(path: Path, result: Evaluation, run: Path, truth: Path, *, progress: Progress = silent) -> None:
    """Write the page of an evaluation, one self-contained HTML file.

    Parameters
    ----------
    path : Path
    result : Evaluation
    run, truth : Path
        What was compared; of a synthetic truth pictures of the errors are drawn.
    progress : Progress

    Raises
    ------
    RunError
        If the page can't be written.
    """
    progress("report", 0, 3)
    curves = list(result.curves)
    sections = [Section("Figures", "figures", tuple(_figures(result)))]
    progress("report", 1, 3)
    sections.append(Section("Over time", "time", tuple(_over_time(curves))))
    progress("report", 2, 3)
    synthetic = truth.is_dir() or truth.suffix.lower() == ".npz"
    sections.append(
        Section("Where the errors are", "errors", tuple(_pictures(result, run, truth) if synthetic else ()))
    )
    figures = result.rounded()
    key = tuple((form.format(figures[name]), label) for name, label, form in KEY_FIGURES if name in figures)
    lead = f"The run {run.name} beside the truth {truth.name}. Lengths are millimetres unless a name says otherwise."
    write_report(path, Report("Evaluation", lead, key, tuple(sections)))
    progress("report", 3, 3)


def _figures(result: Evaluation) -> list[Block]:
    blocks = [table(("figure", "value"), [(k, f"{v:g}") for k, v in result.rounded().items()], numbers=(1,))]
    if result.alignment is not None and (result.alignment.angle_deg > 0 or result.alignment.time_offset != 0):
        a = result.alignment
        moved = ", ".join(f"{x:.4f}" for x in a.translation)
        blocks.append(
            text(
                f"The truth was turned by {a.angle_deg:.2f}° and moved by ({moved}) m; its clock is "
                f"{a.time_offset:+.4f} s ahead of the run's."
            )
        )
    if result.matches:
        rows = [
            (m.found, m.true, f"{m.mean_mm:.1f}", f"{m.p95_mm:.1f}", str(m.frames))
            for m in sorted(result.matches, key=lambda m: m.mean_mm)
        ]
        blocks.append(table(("found", "true", "mean (mm)", "95 % (mm)", "frames"), rows, numbers=(2, 3, 4)))
    return blocks


def _over_time(curves: Sequence[Curve]) -> list[Block]:
    """Plot the summary curves one by one, and the worst of the joints and bodies together."""
    single = ("joint ", "body ")
    summaries = [c for c in curves if not c.name.startswith(single) and ": distance of" not in c.name and len(c.frames)]
    blocks = []
    if summaries:
        words = "Each figure in every frame that was judged; the dashed line is the mean."
        blocks.append(plot_block(curve_plots(summaries), "Figures over time", words))
    for title, chosen in (
        ("Joints and markers", [c for c in curves if ": distance of" in c.name]),
        ("Rotations of bodies", [c for c in curves if c.name.startswith("body ")]),
    ):
        worst = sorted((c for c in chosen if len(c.values)), key=lambda c: -float(np.mean(c.values)))[:WORST_CURVES]
        if worst:
            words = f"The {len(worst)} with the largest mean error, of {len(chosen)}."
            blocks.append(plot_block(together(worst), title, words))
    return blocks or [missing("Nothing was judged over time.")]


@plot
def curve_plots(curves: Sequence[Curve]) -> Figure:
    """Plot each curve in its own axes."""
    rows = (len(curves) + 1) // 2
    figure = Figure(figsize=(9.6, 1.9 * rows), dpi=100 * DENSITY, layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for ax, curve in zip(axes, curves, strict=False):
        marker = "." if len(curve.frames) < 40 else None
        ax.plot(curve.frames, curve.values, color=hex_color(ACCENT), marker=marker)
        ax.axhline(float(np.mean(curve.values)), color=MUTED, ls="--", lw=0.9)
        ax.set_title(f"{curve.name} ({curve.unit})" if curve.unit != "1" else curve.name)
        ax.set_xlabel("frame")
        _span(ax, [curve])
    for ax in axes[len(curves) :]:
        ax.set_axis_off()
    return figure


@plot
def together(curves: Sequence[Curve]) -> Figure:
    """Plot several curves of one unit in the same axes."""
    figure = Figure(figsize=(9.6, 2.9), dpi=100 * DENSITY, layout="constrained")
    ax = figure.subplots()
    for k, curve in enumerate(curves):
        ax.plot(curve.frames, curve.values, color=hex_color(body_color(k)), label=curve.name, lw=1.0)
    ax.set_xlabel("frame")
    ax.set_title(f"error ({curves[0].unit})")
    _span(ax, curves)
    ax.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=7)
    return figure


def _pictures(result: Evaluation, run: Path, truth_path: Path) -> list[Block]:
    truth, opened = Truth.read(truth_path), Run(run)
    blocks = []
    worst = worst_frame(result, opened)
    if worst is not None:
        words = (
            "Left: the found bodies, each in its colour. Middle: the true bodies that the points lie on. Right: "
            "distance of the points from the true surface. From the side that shows most of the subject."
        )
        frame = labelled_frame(opened, truth, worst)
        blocks.append(plot_block(body_errors(frame, truth, worst), f"Bodies in frame {worst}, the worst", words))
    if result.matches and opened.has(SKELETON):
        skeleton = read_skeleton(opened)
        words = (
            "True joints (rings) and found ones (dots) that were matched, with the error between them; crosses are "
            "found joints without a true one near."
        )
        at = _worst_of(result, "joints: mean distance")
        blocks.append(plot_block(joint_errors(result, skeleton, truth, at), f"Joints in frame {at}, the worst", words))
    clouds = [k for k in opened.frames("cloud") if k < len(truth.vertices)]
    if clouds:
        at = clouds[len(clouds) // 2]
        points = read_points(opened.frame_file("cloud", at)).positions
        errors = surface_errors(points, truth.vertices[at], truth.faces)
        words = "Measured points by their signed distance from the true surface: inside it blue, outside red."
        limit = max(float(np.quantile(np.abs(errors), 0.95)), 1e-4)
        blocks.append(picture(error_sheet(points, errors, limit), f"The cloud of frame {at}", words))
    return blocks or [missing("The run holds no clouds, no bodies and no matched joints.")]


def worst_frame(result: Evaluation, run: Run) -> int | None:
    """Return the judged frame with the lowest adjusted Rand index; None if there are no bodies."""
    for curve in result.curves:
        if curve.name == "bodies: adjusted Rand index":
            return int(curve.frames[np.argmin(curve.values)])
    frames = run.frames("bodies")
    return frames[0] if frames else None


def _worst_of(result: Evaluation, start: str) -> int:
    curve = next(c for c in result.curves if c.name.startswith(start))
    return int(curve.frames[np.argmax(curve.values)])


def _side_axes(vertices: np.ndarray) -> tuple[int, int]:
    """Return the horizontal axis with the larger diagonal, and z."""
    return int(np.argmax(np.ptp(vertices[:, :2], axis=0))), 2


@plot
def body_errors(frame: LabelledFrame, truth: Truth, number: int) -> Figure:
    """Draw found and true bodies and the distances from the true surface, seen from the side."""
    figure = Figure(figsize=(9.6, 5.6), dpi=100 * DENSITY, layout="constrained")
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    across, up = _side_axes(truth.vertices[number])
    order = np.argsort(frame.points[:, 1 - across] * (1 if across == 1 else -1))
    p, size = frame.points[order], 400.0 / np.sqrt(max(len(order), 1)) / 4
    for ax, labels, title in ((axes[0], frame.found, "found"), (axes[1], frame.true, "true")):
        colors = np.array([body_color(int(b)) for b in labels[order]]) / 255
        ax.scatter(p[:, across], p[:, up], s=size, c=colors, linewidths=0)
        ax.set_title(f"{title}: {len(np.unique(labels[labels >= 0]))} bodies")
    distance = 1000 * frame.distance[order]
    top = max(float(np.percentile(distance, 95)), 1.0)
    shown = axes[2].scatter(p[:, across], p[:, up], s=size, c=distance, cmap="magma_r", vmin=0, vmax=top, linewidths=0)
    axes[2].set_title("distance from the surface (mm)")
    figure.colorbar(shown, ax=axes[2], shrink=0.7)
    for ax in axes:
        _metric(ax, across)
    return figure


@plot
def joint_errors(result: Evaluation, skeleton: Skeleton, truth: Truth, frame: int) -> Figure:
    """Draw matched joints, found and true, over the true surface of a frame, from two sides."""
    figure = Figure(figsize=(9.6, 5.6), dpi=100 * DENSITY, layout="constrained")
    found = {str(n): p for n, p in zip(skeleton.joint_names, skeleton.joint_positions[frame], strict=True)}
    true = {str(n): p for n, p in zip(truth.joint_names, truth.joint_positions[frame], strict=True)}
    pairs = [(found[m.found], true[m.true]) for m in result.matches if m.found in found and m.true in true]
    matched = {m.found for m in result.matches}
    alone = np.array([p for n, p in found.items() if n not in matched]).reshape(-1, 3)
    v = truth.vertices[frame]
    for ax, across in zip(figure.subplots(1, 2, sharey=True), (0, 1), strict=True):
        ax.scatter(v[:, across], v[:, 2], s=2, c="#e1e4e8", linewidths=0)
        for a, b in pairs:
            ax.plot([a[across], b[across]], [a[2], b[2]], color="#c2571a", lw=1.2)
        f, t = (np.array(x) for x in zip(*pairs, strict=True))
        ax.scatter(t[:, across], t[:, 2], s=34, facecolors="none", edgecolors=hex_color(ACCENT), linewidths=1.1)
        ax.scatter(f[:, across], f[:, 2], s=9, color="#c2571a", zorder=3)
        ax.scatter(alone[:, across], alone[:, 2], s=16, color=MUTED, marker="x", linewidths=1.0)
        _metric(ax, across)
    return figure


def _span(ax: Axes, curves: Sequence[Curve]) -> None:
    """Show errors from zero on, and don't magnify what is next to nothing."""
    values = np.concatenate([c.values for c in curves])
    ax.set_ylim(min(0.0, float(values.min())), 1.1 * max(float(values.max()), 1.0))


def _metric(ax: Axes, across: int) -> None:
    ax.set_aspect("equal")
    ax.set_xlabel(f"{'xy'[across]} (m)")
