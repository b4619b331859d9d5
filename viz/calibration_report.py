"""The report of a calibration: cameras and bar in 3-D, precision, residuals, coverage, held-out bars, verdict."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from geomocap.calibration.bar_calibration import Calibration
from geomocap.files.atomic import write_bytes
from viz.body_colors import ACCENT, INK, body_color, hex_color
from viz.drawing import DENSITY
from viz.figures import plot
from viz.report import Block, Report, Section, table, text, write_report
from viz.report import plot as plot_block

UP_COLUMNS = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}


def write_calibration_report(calibration: Calibration, folder: Path) -> Path:
    """Write `report.html`, self-contained, and its plots as PNG files.

    Parameters
    ----------
    calibration : Calibration
    folder : Path
        Made if need be.

    Returns
    -------
    page : Path
    """
    plots = {
        "layout": layout(calibration),
        "residuals": residual_vectors(calibration),
        "coverage": coverage_maps(calibration),
        "lengths": held_out_lengths(calibration),
    }
    for name, png in plots.items():
        write_bytes(folder / f"{name}.png", png)
    page = folder / "report.html"
    write_report(page, report_of(calibration, plots))
    return page


def report_of(calibration: Calibration, plots: dict[str, bytes]) -> Report:
    """Compose the report from a calibration and its plots."""
    c = calibration
    n = c.adjusted.network
    verdict = [text(c.verdict.summary)]
    if c.verdict.warnings:
        verdict.append(Block("warnings", items=c.verdict.warnings))
    else:
        verdict.append(Block("fine", "Nothing needs recording again."))
    precision = (
        text(
            f"Standard deviations are for the a-posteriori sigma0 of {c.sigma0:.2f} and a free network whose "
            f"datum is held by all bar ends. A bar end is known to "
            f"{1000 * c.covariance.point_sigma:.3f} mm in each axis."
        ),
        interior_table(c),
        pose_table(c),
        distortion_table(c),
        *tests_block(c),
    )

    def pictured(title: str, name: str, caption: str, words: str) -> Section:
        return Section(title, name, (plot_block(plots[name], caption, words),))

    sections = (
        Section("Verdict", "verdict", tuple(verdict)),
        pictured(
            "Cameras and bar",
            "layout",
            "Where the cameras stand and where the bar was held",
            f"{len(n.bars)} bar positions, coloured by frame. World from {c.datum.source}.",
        ),
        Section("Precision", "precision", precision),
        pictured(
            "Residuals",
            "residuals",
            "Residuals over each image",
            "Computed minus observed positions of the bar ends, enlarged as the scale bar says. Directions that agree "
            "in some part of an image show a distortion that the model does not have.",
        ),
        pictured(
            "Coverage",
            "coverage",
            "Where in each image the bar was seen",
            "Number of bar ends in each field. Distortion is extrapolated where there are none.",
        ),
        pictured(
            "Held-out bars",
            "lengths",
            "Lengths of bars that the cameras were not calibrated with",
            "The calibration was repeated without a part of the bars, and these were then measured by forward "
            "intersection alone.",
        ),
    )
    relative = c.held_out.relative
    figures = (
        ("verdict", c.verdict.grade),
        ("held-out length error, RMS", f"{1000 * c.held_out.rms:.2f} mm"),
        ("of the volume", f"1/{1 / relative:.0f}" if relative > 0 else "–"),
        ("residual, RMS", f"{np.sqrt(np.mean(c.adjusted.residuals**2)):.3f} px"),
        ("sigma0", f"{c.sigma0:.2f}"),
        ("bar positions", f"{len(n.bars)}"),
    )
    lead = (
        f"{len(n.names)} cameras, calibrated with a bar of {1000 * n.length:.1f} mm moved through a volume of "
        f"{c.held_out.diagonal:.2f} m diagonal."
    )
    return Report("Calibration", lead, tuple((value, label) for label, value in figures), sections)


def interior_table(calibration: Calibration) -> Block:
    """Table of cameras: constants, principal point, rays and residuals, with standard deviations."""
    rows = []
    for k, p in enumerate(calibration.precision):
        camera = calibration.rig.cameras[k]
        values = {
            "fx": camera.focal_length_x,
            "fy": camera.focal_length_y,
            "cx": camera.principal_point_x,
            "cy": camera.principal_point_y,
        }
        words = []
        for key, value in values.items():
            sigma = p.parameters.get(key, (value, float("nan")))[1]
            words.append(f"{value:.2f}\u00a0±\u00a0{sigma:.2f}" if np.isfinite(sigma) else f"{value:.2f}")
        rows.append((p.camera, f"{camera.width}×{camera.height}", *words, f"{p.rays}", f"{p.rms_px:.3f}"))
    head = ("camera", "image", "fx (px)", "fy (px)", "cx (px)", "cy (px)", "rays", "RMS (px)")
    return table(head, rows, numbers=(2, 3, 4, 5, 6, 7), colors=_colors(len(rows)))


def pose_table(calibration: Calibration) -> Block:
    """Table of the cameras' centres and the standard deviations of their poses."""
    rows = [
        (
            p.camera,
            *(f"{v:.4f}" for v in center),
            f"{1000 * p.center_sigma:.2f}",
            f"{p.angle_sigma_deg:.4f}",
        )
        for p, center in zip(calibration.precision, calibration.rig.centers, strict=True)
    ]
    head = ("camera", "centre x (m)", "y (m)", "z (m)", "centre ± (mm)", "turn ± (°)")
    return table(head, rows, numbers=(1, 2, 3, 4, 5), colors=_colors(len(rows)))


def distortion_table(calibration: Calibration) -> Block:
    """Table of the estimated distortion coefficients with standard deviations."""
    keys = [k for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6") if k in calibration.precision[0].parameters]
    if not keys:
        return text("Interior orientations were given and not estimated.")
    rows = [
        (p.camera, *(f"{p.parameters[k][0]:.5f} ± {p.parameters[k][1]:.5f}" for k in keys))
        for p in calibration.precision
    ]
    return table(("camera", *keys), rows, numbers=tuple(range(1, len(keys) + 1)), colors=_colors(len(rows)))


def tests_block(calibration: Calibration) -> list[Block]:
    """Say what the tests of further parameters (shear, k3) gave."""
    if not calibration.tests:
        return []
    rows = [
        (t.camera, t.parameter, f"{t.value:.4f} ± {t.sigma:.4f}", "significant" if t.significant else "no")
        for t in calibration.tests
    ]
    words = (
        "Parameters that the model does not have, estimated for a test (shear in pixels; COLMAP's cameras have none):"
    )
    return [text(words), table(("camera", "parameter", "value", "differs from zero"), rows, numbers=(2,))]


def _colors(count: int) -> tuple[str, ...]:
    return tuple(hex_color(body_color(k)) for k in range(count))


def _grid(count: int, width: float, ratio: float) -> tuple[Figure, list[Axes]]:
    columns = {1: 1, 2: 2, 4: 2}.get(count, 4 if count > 6 else 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(width, rows * (width / columns * ratio + 0.35)), dpi=100 * DENSITY, layout="constrained")
    axes = [figure.add_subplot(rows, columns, k + 1) for k in range(count)]
    return figure, axes


def _image_axes(ax: Axes, name: str, size: np.ndarray, color: str) -> None:
    ax.set_xlim(0, size[0])
    ax.set_ylim(size[1], 0)
    ax.set_aspect("equal")
    ax.set_xticks([0, int(size[0])])
    ax.set_yticks([0, int(size[1])])
    ax.grid(False)
    for side in ax.spines.values():
        side.set_visible(True)
    ax.set_title(name, fontweight="bold")
    ax.spines["top"].set_color(color)
    ax.spines["top"].set_linewidth(2.5)


@plot
def layout(calibration: Calibration) -> Figure:
    """Draw cameras as pyramids and bars as lines, from above the corner, from the front and from above."""
    c = calibration
    n = c.adjusted.network
    up = c.up
    order = UP_COLUMNS[up]
    figure = Figure(figsize=(9.2, 4.9), dpi=100 * DENSITY, layout="constrained")
    ax = figure.add_subplot(1, 2, 1, projection="3d")
    plan = figure.add_subplot(1, 2, 2)
    bars = n.bars[..., order]
    centers = c.rig.centers[:, order]
    scale = 0.14 * float(np.linalg.norm(np.ptp(centers, axis=0)) + 1e-9)
    shade = np.linspace(0, 1, max(len(bars), 2))
    for bar, s in zip(bars, shade, strict=False):
        tint = (0.12 + 0.75 * s, 0.37 + 0.2 * s, 0.55 - 0.35 * s)
        ax.plot(*bar.T, color=tint, linewidth=0.8)
        plan.plot(bar[:, 0], bar[:, 1], color=tint, linewidth=0.8, marker="o", markersize=1.6)
    for k, (name, camera) in enumerate(zip(c.rig.names, c.rig.cameras, strict=True)):
        w, h = camera.width / camera.focal_length_x, camera.height / camera.focal_length_y
        corners = np.array([[-w / 2, -h / 2, 1], [w / 2, -h / 2, 1], [w / 2, h / 2, 1], [-w / 2, h / 2, 1]]) * scale
        world = (corners @ c.rig.cam_from_world[k, :, :3])[:, order] + centers[k]
        color = hex_color(body_color(k))
        loop = np.vstack([world, world[:1]])
        ax.plot(*loop.T, color=color, linewidth=1.1)
        plan.plot(loop[:, 0], loop[:, 1], color=color, linewidth=1.1)
        for corner in world:
            ray = np.array([centers[k], corner])
            ax.plot(*ray.T, color=color, linewidth=0.8)
            plan.plot(ray[:, 0], ray[:, 1], color=color, linewidth=0.6)
        ax.text(*centers[k], f" {name}", color=hex_color(INK), fontsize=8)
        plan.annotate(
            name,
            (centers[k, 0], centers[k, 1]),
            color=hex_color(INK),
            textcoords="offset points",
            xytext=(4, 4),
            fontsize=8,
            fontweight="bold",
        )
    # The floor, where it belongs to the picture
    everything = np.vstack([bars.reshape(-1, 3), centers])
    low, high = everything.min(axis=0), everything.max(axis=0)
    floor = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]])
    ax.plot(floor[:, 0], floor[:, 1], 0.0, color="#b8bec6", linewidth=0.8, linestyle="--")
    names = [("x", "y", "z")[k] for k in order]
    ax.set_xlabel(f"{names[0]} (m)")
    ax.set_ylabel(f"{names[1]} (m)")
    ax.set_zlabel(f"{names[2]} (m), up")
    ax.set_aspect("equal")
    ax.view_init(elev=24, azim=-60)
    ax.set_title("Cameras and bar positions; dashed: floor")
    plan.plot(0, 0, marker="+", color=hex_color(INK), markersize=9)
    plan.set_aspect("equal")
    plan.set_xlabel(f"{names[0]} (m)")
    plan.set_ylabel(f"{names[1]} (m)")
    plan.set_title("From above; +: origin")
    return figure


@plot
def residual_vectors(calibration: Calibration) -> Figure:
    """Draw the residuals of every camera over its image, all at one scale."""
    n = calibration.adjusted.network
    residuals = calibration.adjusted.residuals
    camera = n.view_camera[n.view]
    rms = float(np.sqrt(np.mean(residuals**2)))
    figure, axes = _grid(len(n.names), 9.2, float(np.max(n.sizes[:, 1] / n.sizes[:, 0])))
    for c, ax in enumerate(axes):
        own = camera == c
        size = n.sizes[c]
        enlarged = 0.03 * size[0] / max(rms, 1e-9)
        color = hex_color(body_color(c))
        _image_axes(ax, n.names[c], size, color)
        ax.quiver(
            *n.pixels[own].T,
            *(residuals[own] * enlarged).T,
            angles="xy",
            scale_units="xy",
            scale=1,
            color=color,
            width=0.004,
        )
        unit = 2 * rms
        ax.plot([0.04 * size[0], 0.04 * size[0] + unit * enlarged], [0.95 * size[1]] * 2, color=hex_color(INK), lw=1.4)
        ax.text(0.04 * size[0], 0.93 * size[1], f"{unit:.3f} px", fontsize=7, va="bottom")
        if own.any():
            ax.set_xlabel(f"RMS {np.sqrt(np.mean(residuals[own] ** 2)):.3f} px, {own.sum()} rays")
    return figure


@plot
def coverage_maps(calibration: Calibration) -> Figure:
    """Draw the number of bar ends in every field of every image."""
    n = calibration.adjusted.network
    camera = n.view_camera[n.view]
    figure, axes = _grid(len(n.names), 9.2, float(np.max(n.sizes[:, 1] / n.sizes[:, 0])))
    most = max(int(c.grid.max()) for c in calibration.coverage) or 1
    for c, (ax, cover) in enumerate(zip(axes, calibration.coverage, strict=True)):
        w, h = n.sizes[c]
        _image_axes(ax, n.names[c], n.sizes[c], hex_color(body_color(c)))
        ax.imshow(cover.grid, extent=(0, w, h, 0), cmap="Blues", vmin=0, vmax=1.5 * most, aspect="equal")
        own = camera == c
        ax.plot(*n.pixels[own].T, ".", markersize=2, color=hex_color(ACCENT))
        for (i, j), count in np.ndenumerate(cover.grid):
            ax.text(
                (j + 0.5) * w / cover.grid.shape[1],
                (i + 0.5) * h / cover.grid.shape[0],
                str(count),
                ha="center",
                va="center",
                fontsize=7,
                color="#a34708" if count == 0 else "#4a525c",
            )
        ax.set_xlabel(f"{100 * cover.fraction:.0f} % of the fields")
    return figure


@plot
def held_out_lengths(calibration: Calibration) -> Figure:
    """Draw the length errors of the held-out bars over frames and as a histogram."""
    h = calibration.held_out
    figure = Figure(figsize=(9.2, 2.8), dpi=100 * DENSITY, layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=[3, 1])
    ax = figure.add_subplot(grid[0])
    errors = 1000 * h.errors
    ax.axhline(0, color="#9aa1aa", linewidth=0.8)
    ax.plot(h.frames, errors, "o", markersize=3, color=hex_color(ACCENT))
    rms = 1000 * h.rms
    ax.axhspan(-rms, rms, color=hex_color(ACCENT), alpha=0.1, linewidth=0)
    ax.set_xlabel("frame")
    ax.set_ylabel("length error (mm)")
    ax.set_title(f"Held-out bars: RMS {rms:.3f} mm (band), largest {np.abs(errors).max(initial=0):.3f} mm")
    side = figure.add_subplot(grid[1], sharey=ax)
    if len(errors):
        side.hist(
            errors, bins=max(8, int(np.sqrt(len(errors)) * 1.5)), orientation="horizontal", color=hex_color(ACCENT)
        )
    side.set_xlabel("bars")
    return figure
