"""Sessions of other tools, made into captures: videos and images are copied, never coded again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from data_tools.calibration_files import read_pose2sim, read_qualisys
from data_tools.image_sizes import SizeMismatch, find_fit, refit_camera
from data_tools.plates import compose_plate
from data_tools.synthesize import write_png
from geomocap.errors import CalibrationError, CaptureError, GeomocapError
from geomocap.files.atomic import copy_whole
from geomocap.files.capture import Capture, CaptureInfo, write_capture_info
from geomocap.files.images import IMAGE_ENDINGS, check_image, read_image
from geomocap.files.rigs import read_rig, write_rig
from geomocap.files.videos import VIDEO_ENDINGS, Video
from geomocap.model.rig import Rig
from geomocap.progress import Progress, silent
from geomocap.reading import list_folder, read_toml
from geomocap.settings import LEAST_FPS, MOST_FPS

PLATE_FRAMES = 25  # frames of a video that a plate is composed from


@dataclass(frozen=True)
class ImportReport:
    """What was imported.

    Attributes
    ----------
    capture : Capture
        Opened and checked.
    rig : Rig
    notes : tuple of str
        What was decided on the way and the user should know.
    """

    capture: Capture
    rig: Rig
    notes: tuple[str, ...]


def import_pose2sim(
    source: Path,
    capture: Path,
    *,
    size_mismatch: SizeMismatch = "auto",
    plates: bool = True,
    progress: Progress = silent,
) -> ImportReport:
    """Make a capture of a Pose2Sim session or trial: calibration (Qualisys or Pose2Sim TOML) and videos.

    Parameters
    ----------
    source : Path
        Folder with videos/*.mp4; the calibration/ folder may be beside it or up to two levels above.
    capture : Path
        Folder to write.
    size_mismatch : "auto", "crop-right", "center", "scale" or "letterbox"
        How videos of another size than the calibrated one came about; "auto" finds out from
        calibration/extrinsics/<camera>* pictures, black bars or the shape.
    plates : bool
        Compose background plates from those pictures and the videos, where there are such pictures.

    Raises
    ------
    CaptureError, CalibrationError
        If videos or calibration are missing or don't belong together, or the capture folder is in use.
    """
    source, capture = Path(source), Path(capture)
    _must_be_free(capture)
    notes: list[str] = []
    videos = sorted(f for f in (source / "videos").glob("*") if f.suffix.lower() in VIDEO_ENDINGS)
    if not videos:
        raise CaptureError(f"{source}: holds no videos/*.mp4; give the folder of a Pose2Sim session or trial")
    calibration = _calibration_file(source)
    rig = read_qualisys(calibration) if calibration.name.endswith(".qca.txt") else read_pose2sim(calibration)
    rig, files = _pair(rig, videos, calibration, notes)

    cameras = []
    pictures: dict[str, Path] = {}
    for k, (name, file) in enumerate(zip(rig.names, files, strict=True)):
        progress("videos", k, len(files))
        frame = Video(file).read(0)
        picture = _reference_picture(calibration.parent, name)
        reference = None if picture is None else read_image(picture)
        if picture is not None:
            pictures[name] = picture
        camera, size = rig.cameras[k], (frame.shape[1], frame.shape[0])
        calibrated = (int(camera.width), int(camera.height))
        if size != calibrated:
            try:
                mode, fit, reason = find_fit(frame, reference, calibrated, size_mismatch)
                camera = refit_camera(camera, fit, size)
            except CalibrationError as error:
                raise CalibrationError(f"{file}: {error}") from None
            notes.append(
                f"{name}: plays at {size[0]}×{size[1]}, calibrated for {calibrated[0]}×{calibrated[1]}; "
                f"taken as {mode}: {reason}"
            )
        cameras.append(camera)
        target = capture / "videos" / f"{name}{file.suffix.lower()}"
        copy_whole(file, target)
    progress("videos", len(files), len(files))
    rig = Rig(rig.names, tuple(cameras), np.array(rig.cam_from_world), rig.notes)
    notes += rig.notes
    write_rig(capture / "sparse", rig)
    fps = _frame_rate(source, files)
    write_capture_info(capture, CaptureInfo(name=source.resolve().name, fps=fps, up="z", cameras=rig.names))
    opened = Capture.open(capture)
    if plates:
        _write_plates(opened, pictures, notes, progress)
    return ImportReport(opened, opened.rig, tuple(notes))


def import_colmap(
    source: Path,
    capture: Path,
    fps: float,
    *,
    metres_per_unit: float = 1.0,
    up: Literal["y", "z"] = "z",
    progress: Progress = silent,
) -> ImportReport:
    """Make a capture of a COLMAP project: a model and images/<camera>/<frame>.*, frames in the order of their names.

    Parameters
    ----------
    source : Path
        Folder with images/ and sparse/0, sparse or the model itself.
    capture : Path
        Folder to write.
    fps : float
        Frames per second.
    metres_per_unit : float
        Length of the model's unit, metres.
    up : "y" or "z"
        Axis of the model that points up.

    Raises
    ------
    CaptureError, CalibrationError
        If images or model are missing, a camera moves, or the capture folder is in use.
    """
    source, capture = Path(source), Path(capture)
    _must_be_free(capture)
    if not (metres_per_unit > 0 and np.isfinite(metres_per_unit)):
        raise CalibrationError(f"metres_per_unit is {metres_per_unit}; it must be a positive length in metres")
    model = next(
        (m for m in (source / "sparse" / "0", source / "sparse", source) if any(m.glob("cameras.*"))), source / "sparse"
    )
    rig = read_rig(model)
    pose = np.array(rig.cam_from_world)
    pose[:, :, 3] *= metres_per_unit
    rig = Rig.of_file(str(model), rig.names, rig.cameras, pose, rig.notes)
    frames = {name: _checked_images(source / "images" / name) for name in rig.names}
    counts = {name: len(files) for name, files in frames.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{n}: {c}" for n, c in counts.items())
        raise CaptureError(f"{source}: cameras have unequal numbers of frames ({listed}); cut them to the same frames")
    for k, (name, files) in enumerate(frames.items()):
        progress("images", k, len(rig))
        for t, file in enumerate(files):
            target = capture / "images" / name / f"{t:06d}{file.suffix.lower()}"
            if file.suffix.lower() in IMAGE_ENDINGS:
                copy_whole(file, target)
            else:  # other formats are stored anew, without loss
                write_png(target.with_suffix(".png"), read_image(file))
    progress("images", len(rig), len(rig))
    write_rig(capture / "sparse", rig)
    write_capture_info(capture, CaptureInfo(name=source.resolve().name, fps=fps, up=up, cameras=rig.names))
    opened = Capture.open(capture)
    notes = () if metres_per_unit != 1.0 else ("the model's unit is taken as a metre; give metres_per_unit if not",)
    return ImportReport(opened, opened.rig, (*rig.notes, *notes))


def _checked_images(folder: Path) -> list[Path]:
    """List the images of a camera, all of which are whole."""
    entries = list_folder(folder, CaptureError) if folder.is_dir() else []
    files = [f for f in entries if f.is_file() and not f.name.startswith(".")]
    if not files:
        raise CaptureError(f"{folder}: holds no images; COLMAP's images must lie in images/<camera>/<frame>.*")
    for file in files:
        check_image(file)
    return files


def _must_be_free(capture: Path) -> None:
    if capture.is_dir() and any(capture.iterdir()):
        raise CaptureError(f"{capture}: is not empty; remove it or choose another folder")


def _calibration_file(source: Path) -> Path:
    """The session's calibration: Pose2Sim's own TOML before Qualisys' file, the nearest folder first."""
    root = source.resolve()
    for folder in (root, root.parent, root.parent.parent):
        for name in ("calibration", "Calibration"):
            for pattern in ("Calib*.toml", "*.qca.txt", "*.toml"):
                found = sorted((folder / name).glob(pattern))
                if found:
                    return found[0]
    raise CalibrationError(
        f"{source}: no calibration/Calib*.toml or calibration/*.qca.txt here or above; calibrate with Pose2Sim first"
    )


def _pair(rig: Rig, videos: list[Path], calibration: Path, notes: list[str]) -> tuple[Rig, list[Path]]:
    """Pair cameras and videos: by name, else by order, as Pose2Sim does."""
    by_name = {file.stem: file for file in videos}
    if all(name in by_name for name in rig.names):
        left = sorted(set(by_name) - set(rig.names))
        if left:
            notes.append(f"videos without calibration were left out: {', '.join(left)}")
        return rig, [by_name[name] for name in rig.names]
    if len(videos) != len(rig):
        raise CaptureError(
            f"{videos[0].parent}: {len(videos)} videos ({', '.join(by_name)}) for {len(rig)} cameras "
            f"({', '.join(rig.names)}) of {calibration.name}; name the videos like the cameras"
        )
    order = sorted(range(len(rig)), key=lambda k: rig.names[k])
    notes.append(
        "videos were paired with cameras in alphabetical order: "
        + ", ".join(f"{file.name} – {rig.names[k]}" for file, k in zip(videos, order, strict=True))
    )
    files = dict(zip(order, videos, strict=True))
    return rig, [files[k] for k in range(len(rig))]


def _reference_picture(calibration: Path, name: str) -> Path | None:
    """A picture calibration/extrinsics/<camera>*, possibly in a folder of the camera's own."""
    root = calibration / "extrinsics"
    found = sorted(f for f in root.rglob(f"*{name}*") if f.is_file() and f.suffix.lower() in IMAGE_ENDINGS)
    return found[0] if found else None


def _frame_rate(source: Path, files: list[Path]) -> float:
    """Frames per second: as Config.toml says, else as all videos agree."""
    config = source / "Config.toml"
    if config.is_file():
        project = read_toml(config, CaptureError).get("project", {})
        if not isinstance(project, dict):
            raise CaptureError(f"{config}: project is no table; write [project] as Pose2Sim does")
        rate = project.get("frame_rate")
        if isinstance(rate, int | float) and not isinstance(rate, bool):
            if not LEAST_FPS <= rate <= MOST_FPS:
                raise CaptureError(
                    f"{config}: frame_rate is {rate}; expected {LEAST_FPS:g} to {MOST_FPS:,.0f} per second"
                )
            return float(rate)
    rates = {file.name: frame_rate(file) for file in files}
    if max(rates.values()) - min(rates.values()) > 0.01 * max(rates.values()):
        listed = ", ".join(f"{n}: {r:g}" for n, r in rates.items())
        raise CaptureError(f"{files[0].parent}: videos of different frame rates ({listed} fps); record them together")
    return next(iter(rates.values()))


def frame_rate(file: Path) -> float:
    """Frames per second of a video file."""
    reader = cv2.VideoCapture(str(file))
    try:
        rate = float(reader.get(cv2.CAP_PROP_FPS))
    finally:
        reader.release()
    if not rate > 0:
        raise CaptureError(f"{file}: doesn't say its frame rate; set frame_rate in Config.toml")
    return round(rate, 4)


def _write_plates(capture: Capture, pictures: dict[str, Path], notes: list[str], progress: Progress) -> None:
    for k, (name, picture) in enumerate(pictures.items()):
        progress("background plates", k, len(pictures))
        wanted = np.unique(np.linspace(0, capture.n_frames - 1, PLATE_FRAMES).astype(int))
        try:
            plate, known = compose_plate([capture.frame(name, int(t)) for t in wanted], read_image(picture))
        except GeomocapError as error:
            notes.append(f"{name}: no background plate from {picture.name}: {error}")
            continue
        alpha = np.where(known, 255, 0).astype(np.uint8)
        write_png(capture.path / "background" / f"{name}.png", np.dstack([plate, alpha]))
        notes.append(f"{name}: background plate from {picture.name} and the video, {100 * known.mean():.1f} % known")
    if pictures:
        progress("background plates", len(pictures), len(pictures))
