"""Captures, described."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from geomocap.dense.match_groups import match_groups
from geomocap.errors import GeomocapError
from geomocap.evaluation.camera_check import check_cameras_of
from geomocap.files.capture import Capture
from geomocap.files.images import ImageFolder, image_size, size_text
from geomocap.inspection.calibrations import describe_rig
from geomocap.inspection.description import Description, count, shortened

FEWEST_CAMERAS = 2  # their surface is matched in their images, which can't be done from any directions
MOST_NAMED = 3  # files of one camera that are wrong


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
    part = f" ({info.frames[0]} to {info.frames[1]} of {capture.n_recorded})" if info.frames else ""
    told.fact("frames", f"{capture.n_frames}{part} at {info.fps:g} per second, {seconds:.2f} s")
    told.fact("up", info.up)
    sizes: dict[str, list[str]] = {}
    for camera, source in capture.sources.items():
        if not isinstance(source, ImageFolder) or _judge_files(source.files, source.check_size, told):
            _judge_ends(partial(capture.frame, camera), capture.n_frames, told)
        with suppress(GeomocapError):
            sizes.setdefault(size_text(source.size), []).append(camera)
    told.fact("image sizes", "; ".join(f"{s} ({count(len(c), 'camera')})" for s, c in sizes.items()) or "unreadable")
    plates = [c for c in capture.cameras if capture.has_background(c)]
    told.fact("background", f"pictures of {len(plates)} of {len(capture.cameras)} cameras" if plates else "none")
    told.fact("silhouettes", "given in masks/" if capture.has_masks else "to be cut out")
    if (path / "bar").is_dir():
        told.fact("reference bar", f"recorded by {count(sum(p.is_dir() for p in (path / 'bar').iterdir()), 'camera')}")
    _judge_parts(capture, plates, told)
    if not told.problems:
        _judge_cameras(capture, told)
    return told


def _judge_parts(capture: Capture, plates: list[str], told: Description) -> None:
    if not capture.is_calibrated:
        told.fact("calibration", "none")
        told.problem(f"not calibrated: no folder sparse/; run `geomocap calibrate {capture.path}`, or import one")
    else:
        try:
            describe_rig(capture.rig, told)
            if len(capture.rig) == FEWEST_CAMERAS:
                match_groups(capture.rig, box=capture.info.region_of_interest)
        except GeomocapError as error:
            told.problem(error)
    if 0 < len(plates) < len(capture.cameras):
        lacking = [c for c in capture.cameras if c not in plates]
        told.problem(f"no background picture of {shortened(lacking)}: it will be estimated from the frames there")
    for camera in plates:
        try:
            capture.background(camera)
        except GeomocapError as error:
            told.problem(error)
    if capture.has_masks:
        for camera in capture.cameras:
            _judge_masks(capture, camera, told)


def _judge_cameras(capture: Capture, told: Description) -> None:
    """Ask whether the cameras fit together."""
    try:
        for warning in check_cameras_of(capture).warnings:
            told.problem(warning)
    except GeomocapError as error:
        told.problem(error)


def _judge_masks(capture: Capture, camera: str, told: Description) -> None:
    there = len(list((capture.path / "masks" / camera).glob("*.png")))
    if there != capture.n_recorded:
        told.problem(f"masks/{camera} has {there} silhouettes for {capture.n_recorded} frames")
        return
    files = [capture.mask_file(camera, k) for k in range(capture.n_frames)]
    if _judge_files(files, partial(capture.check_mask_size, camera), told):
        _judge_ends(partial(capture.mask, camera), capture.n_frames, told)


def _judge_files(files: Sequence[Path], check: Callable[[int, tuple[int, int]], None], told: Description) -> bool:
    """Judge all image files of a camera by their headers, and return whether they pass; the first wrong are named."""
    errors = []
    for frame, file in enumerate(files):
        try:
            check(frame, image_size(file))
        except GeomocapError as error:
            errors.append(str(error))
    wrong = list(dict.fromkeys(errors))
    for line in wrong[:MOST_NAMED]:
        told.problem(line)
    if len(wrong) > MOST_NAMED:
        told.problem(f"{files[0].parent}: {count(len(wrong) - MOST_NAMED, 'more file')} like these")
    return not wrong


def _judge_ends(read: Callable[[int], object], frames: int, told: Description) -> None:
    """Judge the first and the last frame by reading them."""
    try:
        read(0)
        read(frames - 1)
    except GeomocapError as error:
        told.problem(error)
