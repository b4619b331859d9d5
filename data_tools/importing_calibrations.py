"""Calibrations of other tools put into a capture, and written out again for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from data_tools.calibration_files import (
    detect_format,
    read_calibration,
    write_aniposelib,
    write_caliscope,
    write_colmap,
    write_easymocap,
    write_opencv,
    write_pose2sim,
)
from geomocap.errors import CalibrationError
from geomocap.files.capture import CaptureInfo, write_capture_info
from geomocap.files.images import IMAGE_ENDINGS, image_size
from geomocap.files.rigs import write_rig
from geomocap.files.videos import VIDEO_ENDINGS, Video
from geomocap.model.rig import Rig

Format = Literal["anipose", "aniposelib", "caliscope", "pose2sim", "opencv", "easymocap", "colmap"]

WRITERS: dict[str, Callable[[Rig, Path], None]] = {
    "anipose": write_aniposelib,  # the tool, and its library that has the format
    "aniposelib": write_aniposelib,
    "caliscope": write_caliscope,
    "pose2sim": write_pose2sim,
    "opencv": write_opencv,
    "easymocap": write_easymocap,
    "colmap": write_colmap,
}


def import_calibration(
    source: Path,
    capture: Path,
    fps: float,
    *,
    metres_per_unit: float = 1.0,
    up: Literal["y", "z"] = "z",
) -> tuple[Rig, tuple[str, ...]]:
    """Put the calibration of another tool into a capture folder, whose images or videos bear the cameras' names.

    Parameters
    ----------
    source : Path
        aniposelib or caliscope TOML, Pose2Sim TOML, Qualisys XML, OpenCV or EasyMocap YAML, COLMAP model.
    capture : Path
        Folder with images/ or videos/, or one that will have them; its capture.toml is written if it has none.
    fps : float
        Frames per second, for a new capture.toml.
    metres_per_unit : float
        Length of the calibration's unit, metres.
    up : "y" or "z"
        World axis that points up, for a new capture.toml.

    Returns
    -------
    rig : Rig
    notes : tuple of str
        What was done and what is still missing.

    Raises
    ------
    CalibrationError
        If it can't be read, the capture has a calibration already, or images have another size than calibrated.
    """
    if (capture / "sparse").exists():
        raise CalibrationError(f"{capture}: has a calibration already; delete {capture / 'sparse'} to replace it")
    sizes = _image_sizes(capture)
    rig = read_calibration(source, metres_per_unit, sizes or None)
    notes = [f"read as {detect_format(source)}: {', '.join(rig.names)}", *rig.notes]
    for name, camera in zip(rig.names, rig.cameras, strict=True):
        if name in sizes and sizes[name] != (camera.width, camera.height):
            w, h = sizes[name]
            raise CalibrationError(
                f"{source}: camera {name} is calibrated for {camera.width}×{camera.height}, "
                f"but its images are {w}×{h}; calibrate the images as they are"
            )
        if name not in sizes:
            notes.append(f"camera {name} has no images/{name} and no videos/{name}.mp4 yet")
    write_rig(capture / "sparse", rig)
    if not (capture / "capture.toml").exists():
        write_capture_info(capture, CaptureInfo(name=capture.resolve().name, fps=fps, up=up, cameras=rig.names))
    return rig, tuple(notes)


def convert_calibration(source: Path, target: Path, kind: Format, *, metres_per_unit: float = 1.0) -> Rig:
    """Read a calibration of any known format and write it in another.

    Raises
    ------
    CalibrationError
        If it can't be read, or the other format can't hold it without loss.
    """
    rig = read_calibration(source, metres_per_unit)
    WRITERS[kind](rig, target)
    return rig


def _image_sizes(capture: Path) -> dict[str, tuple[int, int]]:
    """Width and height of each camera's first image, where the capture has any."""
    sizes = {}
    for folder in sorted((capture / "images").glob("*")):
        first = next((f for f in sorted(folder.glob("*")) if f.suffix.lower() in IMAGE_ENDINGS), None)
        if first is not None:
            sizes[folder.name] = image_size(first)
    for file in sorted((capture / "videos").glob("*")):
        if file.suffix.lower() in VIDEO_ENDINGS and file.stem not in sizes:
            height, width = Video(file).read(0).shape[:2]
            sizes[file.stem] = (width, height)
    return sizes
