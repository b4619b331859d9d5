"""Words and tables of the report."""

from __future__ import annotations

from typing import Any

import numpy as np
import tomli_w

from geomocap.files.check_file import read_self_check
from geomocap.files.results import read_diagnostics
from viz.body_colors import body_color, hex_color
from viz.quality_figures import MANY_UNASSIGNED, Quality
from viz.report import Block, Section, missing, table, text
from viz.run_contents import Results

FOLLOWED = {
    "patches": "patches of the images",
    "points": "points that the scans have in common",
    "nodes": "nodes of a deformable surface",
    "both": "nodes of a deformable surface, held by patches of the images",
    "pieces": "patches of the images, and nodes of a deformable surface where these leave it uncovered",
    "ellipsoids": "ellipsoids",
}
"""What the samples were whose paths told the bodies apart, by `segmentation.paths`."""


def section(title: str, blocks: list[Block]) -> Section:
    """Return a section whose anchor follows from its title."""
    return Section(title, title.lower().replace(" ", "-"), tuple(blocks))


def title(results: Results) -> str:
    """Return the report's title: the capture's name, or the run folder's."""
    return results.capture.info.name if results.capture is not None else results.run.path.resolve().name


def lead(results: Results) -> str:
    """Return the sentence below the title."""
    if results.capture is not None:
        count = len(results.capture.cameras)
        source = f"{count} camera{'s' if count != 1 else ''}"
    else:
        source = "a sequence of geometry" if len(results.frames) > 1 else "a scan"
    e, s = results.ellipsoids, results.skeleton
    if s is not None and s.joint_count:
        found = f"{_counted(s.body_count, 'rigid bodies')} and {_counted(s.joint_count, 'joints')}"
        return f"From {source} to {found}, without a body model."
    if bodies := s.body_count if s is not None else e.body_count if e is not None else 0:
        return f"From {source} to {_counted(bodies, 'rigid bodies')}, without a body model."
    if e is not None:
        return f"From {source} to {_counted(e.centers.shape[1], 'ellipsoids')}."
    return f"What has been made from {source} so far."


def _pair(number: int, things: str) -> tuple[str, str]:
    """Return a number and what it counts, which is given in the plural."""
    if number == 1:
        things = f"{things[:-3]}y" if things.endswith("ies") else things[:-1]
    return str(number), things


def _counted(number: int, things: str) -> str:
    return " ".join(_pair(number, things))


def key_figures(results: Results) -> tuple[tuple[str, str], ...]:
    """Return the figures at the head of the report: (value, label)."""
    figures = []
    if results.capture is not None:
        figures.append((str(len(results.capture.cameras)), "cameras"))
    figures.append((str(len(results.frames)), "frames"))
    if results.fps:
        figures.append((f"{results.fps:g}", "frames per second"))
        figures.append((f"{len(results.frames) / results.fps:.1f} s", "recorded"))
    for kind in ("voxels", "cloud"):
        if kind in results.counts:
            label = "surface voxels a frame" if kind == "voxels" else "points a frame"
            figures.append((f"{round(float(results.counts[kind].mean())):,}", label))
    if results.ellipsoids is not None:
        figures.append(_pair(results.ellipsoids.centers.shape[1], "ellipsoids"))
        if results.ellipsoids.body_count:
            figures.append(_pair(results.ellipsoids.body_count, "bodies"))
    if results.skeleton is not None and results.skeleton.joint_count:
        figures.append(_pair(results.skeleton.joint_count, "joints"))
    timings = results.run.read_timings()
    if timings:
        figures.append((f"{sum(float(t['seconds']) for t in timings.values()):.1f} s", "of work"))
    return tuple(figures)


def cameras_table(results: Results) -> Block:
    """Return the table of cameras: sizes, orientations if the capture is calibrated, which contradict the others."""
    capture = results.capture
    assert capture is not None
    rows: list[tuple[str, ...]] = []
    if not capture.is_calibrated:
        for name in capture.cameras:
            height, width = capture.frame(name, 0).shape[:2]
            rows.append((name, f"{width} × {height}", "not calibrated"))
        return table(("camera", "size (px)", ""), rows)
    rig, doubtful = capture.rig, set(results.camera_doubts.contradicting)
    for name, camera, center, (w, h) in zip(rig.names, rig.cameras, rig.centers, rig.sizes, strict=True):
        opening = 2 * np.degrees(np.arctan(w / 2 / camera.focal_length_x))
        x, y, z = center
        place = f"{x:.2f}, {y:.2f}, {z:.2f}"
        row = (name, f"{w} × {h}", f"{camera.focal_length_x:.1f}", f"{opening:.0f}", camera.model.name, place)
        rows.append((*row, "contradicts the others") if name in doubtful else (*row, "") if doubtful else row)
    head = ("camera", "size (px)", "camera constant (px)", "opening (°)", "model", "position x, y, z (m)")
    return table((*head, "") if doubtful else head, rows, (2, 3))


def camera_remarks(results: Results) -> list[Block]:
    """Return what was found to be doubtful about the cameras, and which of them the run goes without."""
    doubts = results.camera_doubts
    items = [*doubts.warnings]
    if doubts.left_out:
        items.append(f"The run goes without {', '.join(doubts.left_out)}.")
    return [Block("warnings", items=tuple(items))] if items else []


def bodies_table(results: Results, frame: int) -> Block:
    """Return the table of bodies: their fraction of the points, ellipsoids and joints."""
    labels = results.bodies(frame).body
    e, s = results.ellipsoids, results.skeleton
    sure = read_diagnostics(results.run).body_confidence
    count = int(max(labels.max(initial=-1), -1 if e is None else e.bodies.max(initial=-1))) + 1
    rows, colors = [], []
    for body in (*range(count), *([-1] if (labels < 0).any() else [])):
        fraction = f"{100 * float(np.mean(labels == body)):.1f}"
        own = "" if e is None else str(int((e.bodies == body).sum()))
        joints = ""
        if s is not None and body >= 0:
            joints = ", ".join(s.joint_names[j] for j in np.flatnonzero((s.joint_bodies == body).any(axis=1)).tolist())
        confidence = "" if sure is None or not 0 <= body < len(sure) else f"{sure[body]:.2f}"
        rows.append((results.body_name(body) if body >= 0 else "none", fraction, confidence, own, joints))
        colors.append(hex_color(body_color(body)))
    head = ("body", f"points in frame {frame} (%)", "confidence", "ellipsoids", "joints")
    return table(head, rows, (1, 2, 3), colors)


def summary(quality: Quality) -> list[Block]:
    """Return the sentence at the beginning that points to the warnings, if there are any."""
    count = len(quality.warnings)
    if count == 0:
        return []
    remarks = "One remark" if count == 1 else f"{count} remarks"
    return [text(f"{remarks} on the quality of this run: see the section Quality before you use it.")]


def verdict(results: Results) -> list[Block]:
    """Return what to do with the result, in plain words, from how well it agrees with its own silhouettes."""
    found = read_self_check(results.run)
    if found is None:
        return []
    word, reasons = found.verdict(tuple(results.remarks))
    words = f"Verdict: {word}."
    if reasons:
        return [Block("warnings", items=(words, *reasons))]
    return [Block("fine", f"{words} Model, cameras and paths agree.")]


def preview_note(results: Results) -> list[Block]:
    """Return that the run is a preview only, if it is."""
    preview = results.record.get("source", {}).get("preview")
    if preview is None:
        return []
    every = "every frame" if preview["every"] == 1 else f"one frame in {preview['every']}"
    words = (
        f"This is a preview: {every}, images reduced to about {preview['longest']} pixels, fewer patches and voxels. "
        "It tells whether cameras, silhouettes and bodies come out right, not how precise the motion will be: run "
        "again without --preview."
    )
    return [Block("warnings", items=(words,))]


def changed_files(results: Results) -> list[Block]:
    """Return which files that the report shows are no longer as the run wrote them."""
    faults = {name: fault for name, fault in results.run.faults().items() if not name.startswith("review/")}
    if not faults:
        return []
    return [
        Block("warnings", items=("Start the run again:", *(f"{name} is {fault}." for name, fault in faults.items())))
    ]


def agreement_table(results: Results) -> list[Block]:
    """Return how well the model and the other cameras explain what each camera saw."""
    found = read_self_check(results.run)
    if found is None:
        return []
    rows = []
    for name, model, others in zip(found.cameras, found.model, found.left_out, strict=True):
        rows.append((name, *(_percent(float(np.nanmean(v))) if np.isfinite(v).any() else "–" for v in (model, others))))
    head = ("camera", "model drawn (%)", "hull of the other cameras (%)")
    words = (
        "Intersection over union with the camera's silhouette. The model is drawn in the pose that was found: wrong "
        "bodies put limbs where no silhouette is. The hull of the others is larger than the subject, the more so the "
        "fewer cameras there are; a camera that stands out contradicts the others."
    )
    return [Block("heading", "Agreement with the cameras"), table(head, rows, (1, 2)), text(words)]


def figures_of_quality(results: Results, quality: Quality) -> list[Block]:
    """Return warnings in words and the tables of what can be judged without ground truth."""
    blocks: list[Block] = []
    rows: list[tuple[str, ...]]
    head: tuple[str, ...]
    if quality.warnings:
        blocks.append(Block("warnings", items=tuple(quality.warnings)))
    else:
        blocks.append(Block("fine", "Nothing conspicuous was found in what can be judged without ground truth."))
    if quality.coverage is not None:
        rows = []
        for camera, fraction, cut in zip(
            quality.coverage.cameras, quality.coverage.fraction, quality.coverage.cut, strict=True
        ):
            covered, inside = quality.agreement.get(camera, (np.nan, np.nan))
            spread = f"{100 * np.nanmin(fraction):.1f} – {100 * np.nanmax(fraction):.1f}"
            rows.append(
                (
                    camera,
                    f"{100 * np.nanmedian(fraction):.1f}",
                    spread,
                    str(int(cut.sum())),
                    _percent(covered),
                    _percent(inside),
                )
            )
        head = (
            "camera",
            "silhouette, median (%)",
            "range (%)",
            "frames cut by the border",
            "of it covered by the volume (%)",
            "of the volume inside it (%)",
        )
        blocks += [Block("heading", "Silhouettes"), table(head, rows, (1, 2, 3, 4, 5))]
        if quality.agreement:
            blocks.append(
                text(
                    "A visual hull covers nearly all of every silhouette. What it lacks, another camera's silhouette "
                    "or a wrong calibration has cut away. It sticks out by about half a voxel and a pixel, which "
                    "weighs more the thinner the subject."
                )
            )
    blocks += agreement_table(results)
    if quality.bones:
        rows = [
            (b.name, f"{1000 * b.mean:.0f}", f"{1000 * b.spread:.1f}", f"{100 * b.spread / b.mean:.1f}")
            for b in quality.bones
            if b.mean > 0
        ]
        colors = [hex_color(body_color(b.body)) for b in quality.bones if b.mean > 0]
        head = ("bone", "length (mm)", "varies by (mm)", "(%)")
        blocks += [Block("heading", "Bone lengths"), table(head, rows, (1, 2, 3), colors)]
    if results.skeleton is not None and quality.jitter is not None and np.isfinite(quality.jitter).any():
        rows = [
            (name, f"{1000 * j:.1f}")
            for name, j in zip(results.skeleton.joint_names, quality.jitter, strict=True)
            if np.isfinite(j)
        ]
        colors = [hex_color(body_color(int(b))) for b in results.skeleton.joint_bodies[:, 1]]
        head = ("joint", "unrest: median second difference (mm)")
        blocks += [Block("heading", "Unrest of the joints"), table(head, rows, (1,), colors)]
    if quality.unassigned is not None and quality.unassigned <= MANY_UNASSIGNED:  # else a warning says it
        blocks.append(text(f"{100 * quality.unassigned:.1f} % of the points belong to no body."))
    return blocks


def _percent(value: float) -> str:
    return f"{100 * value:.1f}" if np.isfinite(value) else "–"


def timings_table(stages: dict[str, dict[str, float]]) -> Block:
    """Return the table of `timings.json`."""
    rows = []
    for name, values in stages.items():
        rate = float(values.get("items_per_second", 0.0))
        rows.append((name, f"{float(values['seconds']):.2f}", f"{int(values.get('items', 0)):,}", f"{rate:,.2f}"))
    total = sum(float(v["seconds"]) for v in stages.values())
    return table(("stage", "seconds", "items", "items a second"), [*rows, ("all", f"{total:.2f}", "", "")], (1, 2, 3))


def record_blocks(results: Results) -> list[Block]:
    """Return what `run.toml` says: source, versions, and all settings."""
    record = results.record
    if not record:
        return [missing("The run has no run.toml.")]
    blocks = []
    for key in ("geomocap", "source", "versions"):
        rows = [(name, _words(value)) for name, value in record.get(key, {}).items()]
        if rows:
            heading = {"geomocap": "Program", "source": "Source", "versions": "Versions"}[key]
            blocks += [Block("heading", heading), table(("key", "value"), rows)]
    blocks.append(Block("code", tomli_w.dumps(record), "The whole run.toml: enough to repeat the run"))
    return blocks


def _words(value: Any) -> str:
    return ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
