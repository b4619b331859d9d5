"""How the bodies were told apart: elimination curve, alternatives, where each was measured, kinds of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from viz.body_colors import ACCENT, INK, body_color, body_colors, hex_color
from viz.drawing import sheet
from viz.figures import WIDTH, figure_of, plot
from viz.rendering import Model
from viz.report import Block, table
from viz.run_contents import Results
from viz.sheets import VIEWS, picture, tile_size
from viz.viewpoints import ViewStage
from viz.volumes import gems, spacing

MOST_ALTERNATIVES = 5


@plot
def elimination_curve(bodies: np.ndarray, strengths: np.ndarray, found: int) -> Figure:
    """Plot how strong the weakest body is at each number of bodies, with the criterion and what was chosen."""
    figure = figure_of(WIDTH, 2.5)
    ax = figure.subplots()
    ax.plot(bodies, strengths, color=hex_color(ACCENT), marker="o", ms=3.5)
    ax.axhline(1.0, color=hex_color(INK), lw=1, ls="--")
    ax.text(float(bodies.max()), 1.0, "criterion", va="bottom", ha="left", fontsize=7.5)
    ax.axvline(found, color="#c2571a", lw=1.2)
    ax.text(found, float(np.nanmax(strengths)), f" {found} found", va="top", color="#c2571a", fontsize=8)
    ax.invert_xaxis()
    ax.set_ylim(bottom=0)
    ax.set_xlabel("number of bodies, taken away one by one")
    ax.set_title("strength of the weakest body (1: just enough to be one)")
    return figure


@plot
def reliability(fraction: np.ndarray, names: Sequence[str], fps: float | None) -> Figure:
    """Plot the fraction of each body's samples that were measured and follow it, (T, B), over time."""
    figure = figure_of(WIDTH, min(0.9 + 0.13 * fraction.shape[1], 6.0))
    ax = figure.subplots()
    end = len(fraction) / fps if fps else len(fraction)
    image = ax.imshow(
        fraction.T, aspect="auto", vmin=0, vmax=1, cmap="viridis", extent=(0, end, fraction.shape[1] - 0.5, -0.5)
    )
    ax.grid(visible=False)
    ax.set_xlabel("time (s)" if fps else "frame")
    step = -(-len(names) // 40)  # so many names find room beside each other
    ax.set_yticks(range(0, len(names), step), names[::step], fontsize=6.5)
    ax.set_title("fraction of a body's samples that are measured and follow it")
    figure.colorbar(image, ax=ax, pad=0.01)
    return figure


def alternatives_sheet(results: Results, stage: ViewStage) -> np.ndarray | None:
    """Return the samples in the colours of their bodies: as found, and as other criteria would part them.

    None where the run didn't follow samples.
    """
    found = results.diagnostics
    chosen = found.sample_body
    if found.sample_positions is None or chosen is None:
        return None
    columns = [(f"{_count(chosen)} bodies, as found", chosen)]
    labels = found.alternative_labels
    for label in () if labels is None else labels[:MOST_ALTERNATIVES]:
        if _count(label) != _count(chosen):
            columns.append((f"{_count(label)} bodies", label))
    frame = results.frames[0]
    points = found.sample_positions[:, 0]
    radius = 0.7 * spacing(points)
    tiles: list[list[np.ndarray | None]] = []
    for view in ("three-quarter", "narrow side"):
        ray = stage.view(*VIEWS[view], tile_size(stage, *VIEWS[view]))
        row: list[np.ndarray | None] = []
        for _, label in columns:
            drawn = replace(gems(points, body_colors(label), radius), outlined=True)
            row.append(picture(results, stage, Model([drawn]), ray, frame))
        tiles.append(row)
    return sheet(tiles, (), [name for name, _ in columns])


def _count(label: np.ndarray) -> int:
    return len(np.unique(label[label >= 0]))


def joints_table(results: Results) -> Block | None:
    """Return the table of joints: ball or hinge, its axis at rest, standard deviation; None where it isn't known."""
    found, skeleton = results.diagnostics, results.skeleton
    kinds, axes = found.joint_is_hinge, found.joint_axes
    if skeleton is None or kinds is None or axes is None or not len(kinds) == skeleton.joint_count > 0:
        return None
    deviations = found.joint_std  # joints of a known subject's model have none
    called = skeleton.body_names
    rows, colors = [], []
    for j, name in enumerate(skeleton.joint_names):
        hinge = bool(kinds[j])
        axis = ", ".join(f"{v:.2f}" for v in axes[j]) if hinge else ""
        deviation = "" if deviations is None else f"{1000 * float(np.linalg.norm(deviations[j])):.1f}"
        parent, child = skeleton.joint_bodies[j]
        rows.append((name, f"{called[parent]} – {called[child]}", "hinge" if hinge else "ball", axis, deviation))
        colors.append(hex_color(body_color(int(child))))
    head = ("joint", "bodies", "kind", "axis in frame 0", "standard deviation (mm)")
    return table(head, rows, (4,), colors)
