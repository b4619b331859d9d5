"""Everything there is to look at of a run: picture sheets, a video and the report, made from the run's files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from geomocap.dense.dense_frame import CloudFrame
from geomocap.errors import GeometryError, RunError
from geomocap.files.capture import Capture
from geomocap.files.results import read_cloud_record
from geomocap.files.run import Run
from geomocap.progress import Progress, silent
from viz import figures, keypoint_plots, separation, sheets
from viz import track_pictures as tracks
from viz.angle_plots import angle_blocks, motion_blocks
from viz.desk import Desk
from viz.films import filmed_beside
from viz.keypoint_marks import marks_of_run
from viz.matching_review import frame_sheet, template_sheet
from viz.quality_figures import Quality, assess, relative_paths
from viz.rendering import Look
from viz.report import Block, Report, missing, table, text, turning, video, write_report
from viz.run_contents import Results
from viz.scene import stage as find_stage
from viz.sections import (
    FOLLOWED,
    bodies_table,
    camera_remarks,
    cameras_table,
    changed_files,
    figures_of_quality,
    key_figures,
    lead,
    preview_note,
    record_blocks,
    section,
    summary,
    timings_table,
    title,
    verdict,
)
from viz.shown_names import named
from viz.turntable import Turntable, turntable
from viz.viewpoints import ViewStage


def review(
    run: Run,
    capture: Capture | None = None,
    *,
    frames: Sequence[int] | None = None,
    quick: bool = False,
    measured: Callable[[int], tuple[CloudFrame, np.ndarray] | None] = lambda _: None,
    progress: Progress = silent,
) -> list[Path]:
    """Write picture sheets, a video and `report.html` of a run into RUN/review, from the files that are there.

    Parts that are missing are left out and named in the report.

    Parameters
    ----------
    run : Run
    capture : Capture, optional
        What the run was made from: needed for everything drawn over the images.
    frames : sequence of int, optional
        Frames for the sheets; four evenly spread ones if not given.
    quick : bool
        Two frames if not given, and a film whose edges are rougher.
    measured : callable, optional
        Gives the surface measurement of a frame, with regions and shifts that files don't hold, and the undistorted
        image of the template that gave most points; None: not to be had. Without it these pictures are left out.
    progress : Progress
        Called as stage "review", and "video" while the video is drawn.

    Returns
    -------
    list of Path
        The files written, the report last.

    Raises
    ------
    RunError
        If the run holds nothing that could be shown, a file is damaged, or the folder can't be written.
    GeometryError
        If a geometry file is damaged.
    """
    results = named(Results(run, capture))
    if not results.frames:
        raise RunError(f"{run.path}: holds no silhouettes and no geometry; run a stage first")
    chosen = list(frames) if frames is not None else sheets.chosen_frames(results.frames, 2 if quick else 4)
    unknown = [f for f in chosen if f not in results.frames]
    if unknown or not chosen:
        raise RunError(
            f"{run.path}: frame {unknown[0] if unknown else '(none)'} is not in the run; "
            f"choose from {results.frames[0]} to {results.frames[-1]}"
        )
    try:
        stage = find_stage(results)
    except GeometryError:
        stage = None
    desk = Desk.of(run.path / "review", progress, 29)
    desk.report()
    look = Look(samples=1 if quick else 2)
    with filmed_beside(results, stage, desk.folder / "motion.mp4", progress, look) as film:
        quality = assess(results, chosen)
        desk.steps.step()
        desk.report()
        turns = None if stage is None else turntable(results, stage)
        desk.steps.step()
        named_parts: list[tuple[str, Callable[[Desk], list[Block]]]] = [
            ("What went in", lambda desk: _inputs(results, stage, chosen, desk)),
            ("Silhouettes", lambda desk: _silhouettes(results, quality, chosen, desk)),
            ("Volume and points", lambda desk: _volume(results, stage, chosen, desk)),
            ("Surface measurement", lambda desk: _clouds(results, measured, chosen, desk)),
            ("Surface points through time", lambda desk: _tracks(results, stage, chosen, desk)),
            ("Ellipsoids and their paths", lambda desk: _ellipsoids(results, stage, chosen, desk)),
            ("Rigid bodies", lambda desk: _bodies(results, stage, chosen, desk)),
            ("How the bodies were told apart", lambda desk: _separation(results, stage, desk)),
            ("Skeleton and motion", lambda desk: _skeleton(results, stage, quality, chosen, desk)),
            ("Key-points", lambda desk: _keypoints(results, stage, chosen, desk)),
            ("Quality", lambda _: figures_of_quality(results, quality)),
            ("Time", lambda desk: _times(results, desk)),
            ("Settings and versions", lambda _: record_blocks(results)),
        ]
        blocks = desk.side_by_side([make for _, make in named_parts])
        parts = [section(title, found) for (title, _), found in zip(named_parts, blocks, strict=True)]
        head = [*preview_note(results), *changed_files(results), *verdict(results), *summary(quality)]
        parts.insert(0, section("Result", [*head, *_result(results, stage, chosen, turns, desk, film)]))
    page = desk.folder / "report.html"
    write_report(page, Report(title(results), lead(results), key_figures(results), tuple(parts), turns))
    progress("review", desk.steps.total, desk.steps.total)
    return [*desk.written, page]


def _result(
    results: Results,
    stage: ViewStage | None,
    frames: list[int],
    turns: Turntable | None,
    desk: Desk,
    film: Callable[[], Path | None],
) -> list[Block]:
    if stage is None:
        return [missing("The run holds no geometry yet, so there is no result to show; the silhouettes are below.")]
    blocks: list[Block] = []
    if turns is not None:
        blocks.append(turning(sheets.still(results, stage, frames[len(frames) // 2]), "The subject"))
    words = (
        "Each column is a frame, each row a stage of the work, seen from the same place. "
        "A body has the same colour in every picture of this report."
    )
    stages = desk.sheet("stages", sheets.frames_sheet(desk.story, frames), "Stage by stage", words)
    path = film()
    if path is not None:
        desk.written.append(path)
        over = ", and over the image of one camera" if _calibrated(results) else ""
        words = "Look for limbs that keep their colour, joints that stay inside the volume, and bones that don't jump."
        told = f"From a slowly turning free view{over}. {words}"
        blocks.append(video(path, "The motion", told, folded=turns is not None))
    desk.steps.step()
    return blocks + stages


def _inputs(results: Results, stage: ViewStage | None, frames: list[int], desk: Desk) -> list[Block]:
    if results.capture is None:
        desk.steps.step()
        return [missing("No capture is at hand (the geometry came from elsewhere), so there are no cameras or images.")]
    blocks: list[Block] = [*camera_remarks(results), cameras_table(results)]
    if stage is not None:
        words = "Where the cameras stand and what they look at. Check that up is up, and that the distances are right."
        blocks += desk.sheet("cameras", sheets.cameras_picture(results, stage, frames[0]), "The cameras", words)
    words = f"Frame {frames[0]} as each camera saw it."
    return blocks + desk.sheet("images", sheets.camera_images(results, frames[0]), "The images", words)


def _silhouettes(results: Results, quality: Quality, frames: list[int], desk: Desk) -> list[Block]:
    image = sheets.silhouette_sheet(results, frames)
    if image is None or quality.coverage is None:
        desk.steps.step()
        return [missing("The run has no silhouettes.")]
    words = (
        "The line should follow the subject's outline, with nothing of it left out: what one camera misses is cut out "
        "of the volume. The figure is the fraction of the image inside."
    )
    blocks = desk.sheet("silhouettes", image, "Silhouettes", words)
    words = "Even curves are good; a sudden step means that background was taken for the subject, or the reverse."
    return blocks + desk.plot("coverage", figures.coverage(quality.coverage), "Coverage", words)


def _volume(results: Results, stage: ViewStage | None, frames: list[int], desk: Desk) -> list[Block]:
    kind = next((k for k in ("voxels", "cloud") if k in results.kinds), None)
    if stage is None or kind is None:
        return [missing("The run has neither voxels nor a point cloud.")]
    words = (
        "The volume in its own colours from four sides. Look for limbs grown together, phantom parts where no camera "
        "could tell empty from full, and parts cut off."
    )
    name = "volume" if kind == "voxels" else "points"
    image = _views(results, stage, frames, name, sheets.volume_meshes, desk)
    blocks = desk.sheet("volume", image, kind.title(), words)
    numbers = {k: (results.run.frames(k), v) for k, v in results.counts.items() if k != "bodies"}
    if numbers and len(results.frames) > 1:
        words = "Surface voxels or points in each frame. Jumps point to frames with bad silhouettes."
        blocks += desk.plot("counts", figures.counts(numbers), "Numbers", words)
    return blocks


def _clouds(
    results: Results,
    measured: Callable[[int], tuple[CloudFrame, np.ndarray] | None],
    frames: list[int],
    desk: Desk,
) -> list[Block]:
    record = read_cloud_record(results.run)
    if record is None:
        return []
    blocks: list[Block] = []
    if record.warnings:
        blocks.append(Block("warnings", items=tuple(record.warnings)))
    blocks.append(text("What became of the places where a match was sought, and of the seeds, on average in a frame:"))
    rows = [(reason, f"{n / record.frames:,.0f}") for reason, n in sorted(record.reasons.items(), key=lambda r: -r[1])]
    blocks.append(table(("reason", "in a frame"), rows, numbers=(1,)))
    number = frames[len(frames) // 2]
    found = measured(number)
    if found is None:
        desk.steps.step()
        return blocks
    frame, image = found
    words = (
        "The template that gave most points. Left: points matched in all search images, in some, and those that "
        "disagreed with their neighbours; rings are the seeds. Middle: the seeds' regions and the shifts along which "
        "they were covered. Right: the way from the template to the first search image."
    )
    best = max(frame.templates, key=lambda t: len(t.points))
    blocks += desk.sheet("matching", template_sheet(image, best), f"Matching in frame {number}", words)
    words = "The points from several sides, in their colours; where there are several, by the template they come from."
    up = np.eye(3)["xyz".index(results.up)]
    return blocks + desk.sheet("cloud_sides", frame_sheet(frame, up=up), f"The cloud of frame {number}", words)


def _tracks(results: Results, stage: ViewStage | None, frames: list[int], desk: Desk) -> list[Block]:
    found = None if stage is None else results.tracks
    if stage is None or found is None or not len(found.trajectories):
        return []
    words = (
        "Points of the surface followed in the images, with their way over the last frames. Neighbours should move "
        "alike, and lines should be smooth."
    )
    drawn = tracks.trajectory_sheet(results, stage, found, frames)
    blocks = desk.sheet("tracks", drawn, "Trajectories by displacement", words)
    words = "Velocities smoothed over some frames: a vector field on the surface."
    blocks += desk.sheet("velocities", tracks.velocity_sheet(results, stage, found, frames), "Velocities", words)
    middle = frames[len(frames) // 2]
    words = (
        "Red is what was cut off or removed as too fast, accelerated too much, unlike the motion around it, or too "
        "short (--filters.*)."
    )
    over = tracks.filter_sheet(results, stage, found, middle)
    return blocks + desk.sheet("filters", over, f"Filters off and on, frame {middle}", words)


def _ellipsoids(results: Results, stage: ViewStage | None, frames: list[int], desk: Desk) -> list[Block]:
    e = results.ellipsoids
    if stage is None or e is None:
        return [missing("The run has no ellipsoids.")]
    words = "The ellipsoids fitted to parts of the volume, in the colours of the bodies that they were joined to."
    image = _views(results, stage, frames, "ellipsoids", sheets.ellipsoid_meshes, desk)
    blocks = desk.sheet("ellipsoids", image, f"{e.centers.shape[1]} ellipsoids", words)
    if len(e.centers) < 2:
        return [*blocks, missing("One frame has no paths, so nothing tells the bodies apart.")]
    words = "Each ellipsoid's way through all frames. Paths of one body run side by side; a path that jumps was lost."
    blocks += desk.sheet("paths", sheets.path_sheet(results, stage, frames[0]), "Paths", words)
    paths = relative_paths(e, results.diagnostics)
    words = (
        "A relative path is a path minus its mean. Ellipsoids of one body move alike: their curves lie together, and "
        "their distance curves to each other stay low. By them the paper's method tells bodies apart; where points "
        "were tracked, these do it by paths of their own, which don't slide as ellipsoids do."
    )
    curves = figures.path_curves(paths, e.bodies, results.up, results.fps)
    blocks += desk.plot("path_curves", curves, "Relative paths and distance curves", words)
    words = (
        "The mean of a distance curve over time decides whether two ellipsoids belong together. A gap in the sorted "
        "integrals is a clear decision; a smooth slope is not."
    )
    blocks += desk.plot("integrals", figures.integrals(paths, e.bodies), "Integrals", words)
    words = "Steps and spikes show where the matching in time had to split or merge ellipsoids."
    return blocks + desk.plot("ellipsoid_curves", figures.ellipsoid_errors(e), "Sizes and fitting errors", words)


def _bodies(results: Results, stage: ViewStage | None, frames: list[int], desk: Desk) -> list[Block]:
    if stage is None or "bodies" not in results.kinds:
        return [missing("The run has no rigid bodies.")]
    words = "Each body in its colour, grey what belongs to none. Borders should lie where the subject bends."
    image = _views(results, stage, frames, "bodies", sheets.body_meshes, desk)
    blocks = desk.sheet("bodies", image, "Rigid bodies", words)
    words = "The bodies over the images of all cameras. Where their border leaves the subject's, the volume is wrong."
    middle = [frames[len(frames) // 2]]
    if _calibrated(results):
        over = sheets.overlay_sheet(results, middle, sheets.body_meshes, 0.72)
        blocks += desk.sheet("bodies_overlay", over, f"Bodies over frame {middle[0]}", words)
    return [*blocks, bodies_table(results, middle[0])]


def _separation(results: Results, stage: ViewStage | None, desk: Desk) -> list[Block]:
    found = results.diagnostics
    chosen = found.sample_body
    if stage is None or chosen is None:
        return []
    followed = FOLLOWED.get(found.paths or "", "motion paths")
    words = (
        f"The bodies come from {len(chosen)} {followed}, followed through all frames. Where a subject "
        "bends in many small steps, like a trunk or a tail, any border is arbitrary: the other numbers of bodies are "
        "as good. --bodies sets a number, --min-turn the criterion."
    )
    blocks = desk.sheet("alternatives", separation.alternatives_sheet(results, stage), "Samples by body", words)
    if found.curve_bodies is not None and found.curve_strengths is not None and len(found.curve_bodies) > 1:
        words = (
            "The weakest body goes, again and again. A steep rise beside the number found is a clear decision; a slow "
            "one means that a few bodies more or less explain the motion as well."
        )
        number = len(np.unique(chosen[chosen >= 0]))
        curve = separation.elimination_curve(found.curve_bodies, found.curve_strengths, number)
        blocks += desk.plot("elimination", curve, "Number of bodies", words)
    if found.reliability is not None and found.reliability.shape[1] > 0:
        words = "Dark: the body was hardly measured there, and its motion is bridged from its neighbours and in time."
        names = [results.body_name(b) for b in range(found.reliability.shape[1])]
        drawn = separation.reliability(found.reliability, names, results.fps)
        blocks += desk.plot("reliability", drawn, "Measured", words)
    return blocks


def _skeleton(
    results: Results, stage: ViewStage | None, quality: Quality, frames: list[int], desk: Desk
) -> list[Block]:
    if stage is None or results.skeleton is None:
        return [missing("The run has no skeleton.")]
    if not results.skeleton.joint_count:
        return [text("The subject is one rigid body, so it has no joints."), *motion_blocks(results, [], desk)]
    words = (
        "The skeleton inside the translucent volume. Joints should sit where limbs bend, in the middle of the flesh."
    )
    image = _views(results, stage, frames, "skeleton", sheets.skeleton_meshes, desk)
    blocks = desk.sheet("skeleton", image, "Skeleton", words)
    if _calibrated(results):
        middle = [frames[len(frames) // 2]]
        words = "Bones and joints over the images of all cameras, the volume as glass around them."
        over = sheets.overlay_sheet(results, middle, sheets.skeleton_meshes, 1.0)
        blocks += desk.sheet("skeleton_overlay", over, f"Skeleton over frame {middle[0]}", words)
    if kinds := separation.joints_table(results):
        blocks.append(kinds)
    if len(results.skeleton.joint_positions) > 1:
        blocks += [*angle_blocks(results, desk), *motion_blocks(results, quality.bones, desk)]
    return blocks


def _keypoints(results: Results, stage: ViewStage | None, frames: list[int], desk: Desk) -> list[Block]:
    points = results.keypoints
    if stage is None or points is None:
        return []
    marks = marks_of_run(points)
    words = (
        "Their ways from the front and from the top, with links at some moments; dotted where the body bridges a gap."
    )
    blocks = desk.plot("keypoint_paths", keypoint_plots.paths(marks, stage), "Ways of the key-points", words)
    if points.velocities is not None:
        words = "A jump where a curve turns dotted, or back, says that the bridge didn't hold."
        curves = keypoint_plots.speeds(marks, points.velocities, results.fps)
        blocks += desk.plot("keypoint_speeds", curves, "Speeds of the key-points", words)
    words = "Each should stay on the same spot of the subject. Orange: bridged, no trajectory inside in this frame."
    over = keypoint_plots.overlay_sheet(results, marks, frames)
    return blocks + desk.sheet("keypoints_overlay", over, "Key-points over the pictures", words)


def _views(
    results: Results, stage: ViewStage, frames: list[int], name: str, build: sheets.Builder, desk: Desk
) -> np.ndarray:
    """Draw one kind of geometry from several sides; the first of them is what the story shows of it."""
    rows = sheets.geometry_views(results, stage, frames, build)
    desk.story.append((name, rows[0]))
    return sheets.frames_sheet(list(zip(sheets.VIEWS, rows, strict=True)), frames)


def _times(results: Results, desk: Desk) -> list[Block]:
    stages = results.run.read_timings()
    if not stages:
        return [missing("The run has no timings.")]
    words = "Wall-clock seconds of each stage, as measured in this run."
    return [*desk.plot("timings", figures.timings(stages), "Timings", words), timings_table(stages)]


def _calibrated(results: Results) -> bool:
    return results.capture is not None and results.capture.is_calibrated
