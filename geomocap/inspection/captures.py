"""Captures, described."""

from __future__ import annotations

from pathlib import Path

from geomocap.capture import Capture, ImageFolder
from geomocap.errors import GeomocapError
from geomocap.inspection.calibrations import describe_rig
from geomocap.inspection.description import Description, count, shortened


def describe_capture(path: Path) -> Description:
    """Describe a capture folder."""
    told = Description(path, "capture")
    try:
        capture = Capture.open(path)
    except GeomocapError as error:
        told.problem(error)
        return told
    info = capture.info
    told.fact("name", info.name)
    kinds = {"images" if isinstance(s, ImageFolder) else "video" for s in capture.sources.values()}
    told.fact("cameras", f"{len(capture.cameras)}: {shortened(list(capture.cameras))} ({' and '.join(sorted(kinds))})")
    seconds = capture.n_frames / info.fps
    told.fact("frames", f"{capture.n_frames} at {info.fps:g} per second, {seconds:.2f} s")
    told.fact("up", info.up)
    sizes: dict[str, list[str]] = {}
    for camera in capture.cameras:
        try:
            height, width = capture.frame(camera, 0).shape[:2]
            sizes.setdefault(f"{width}×{height}", []).append(camera)
            capture.frame(camera, capture.n_frames - 1)
        except GeomocapError as error:
            told.problem(error)
    told.fact("image sizes", "; ".join(f"{s} ({count(len(c), 'camera')})" for s, c in sizes.items()) or "unreadable")
    plates = [c for c in capture.cameras if capture.has_background(c)]
    told.fact("background", f"pictures of {len(plates)} of {len(capture.cameras)} cameras" if plates else "none")
    told.fact("silhouettes", "given in masks/" if capture.has_masks else "to be cut out")
    if (path / "bar").is_dir():
        told.fact("reference bar", f"recorded by {count(sum(p.is_dir() for p in (path / 'bar').iterdir()), 'camera')}")
    _judge_parts(capture, plates, told)
    return told


def _judge_parts(capture: Capture, plates: list[str], told: Description) -> None:
    if not capture.is_calibrated:
        told.fact("calibration", "none")
        told.problem(f"not calibrated: no folder sparse/; run `geomocap calibrate {capture.path}`, or import one")
    else:
        try:
            describe_rig(capture.rig, told)
        except GeomocapError as error:
            told.problem(error)
    if 0 < len(plates) < len(capture.cameras):
        lacking = [c for c in capture.cameras if c not in plates]
        told.problem(f"no background picture of {shortened(lacking)}: it will be estimated from the frames there")
    if capture.has_masks:
        for camera in capture.cameras:
            there = len(list((capture.path / "masks" / camera).glob("*.png")))
            if there != capture.n_frames:
                told.problem(f"masks/{camera} has {there} silhouettes for {capture.n_frames} frames")
