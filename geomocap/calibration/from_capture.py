"""Calibrating a capture: the bar recording of its folder, and what the folder says about the world."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from geomocap.calibration.bar_calibration import Calibration, calibrate_bar
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.observed_points import Observed
from geomocap.calibration.recording import Recording, measure
from geomocap.calibration.targets import find_targets, gray_of
from geomocap.calibration.world import WorldKnowledge
from geomocap.errors import CalibrationError, CaptureError
from geomocap.files.capture import check_links, read_capture_info
from geomocap.files.images import IMAGE_ENDINGS, read_image
from geomocap.model.rig import Rig
from geomocap.progress import Progress, silent
from geomocap.reading import read_toml
from geomocap.settings import Settings, explained


class LShape(Settings):
    """What `reference/reference.toml` says of an L-shaped reference of three targets."""

    long_arm: float = Field(gt=0, description="distance of the corner's target from the far one (m)")
    short_arm: float = Field(gt=0, description="distance of the corner's target from the near one (m)")


def up_of(folder: Path) -> str:
    """Return the axis that `capture.toml` says points up; "z" if there is no such file."""
    return read_capture_info(folder).up if (folder / "capture.toml").exists() else "z"


def calibrate_capture(
    folder: Path,
    settings: BarSettings | None = None,
    world: WorldKnowledge | None = None,
    given: Rig | None = None,
    length: float | None = None,
    progress: Progress = silent,
    executor: Executor | None = None,
) -> Calibration:
    """Calibrate the cameras of a capture from its folder `bar`.

    Parameters
    ----------
    folder : Path
        A capture, with bar/<camera>/000000.png or bar/<camera>.mp4, and bar/bar.toml.
    settings : BarSettings, optional
    world : WorldKnowledge, optional
        What fixes the world; if it names nothing, the frames of `floor` in `bar.toml` do, or an L-shaped reference in
        the folder `reference`, if there are.
    given : Rig, optional
        Known interior orientations.
    length : float, optional
        Of the bar, metres, instead of what `bar.toml` says.
    progress : callable
    executor : Executor, optional

    Raises
    ------
    CaptureError
        If the recording can't be read, or a link leads out of the folder.
    CalibrationError
        If no calibration can be had from it.
    """
    folder = Path(folder)
    check_links(folder)
    settings = settings or BarSettings()
    cameras = read_capture_info(folder).cameras if (folder / "capture.toml").exists() else None
    recording = Recording.open(folder / "bar", cameras, length)
    observations = measure(recording, settings.targets, progress, executor)
    world = replace(world or WorldKnowledge(), up=up_of(folder))
    if world == WorldKnowledge(up=world.up):
        if recording.info.floor:
            world = replace(world, floor=recording.info.floor)
        elif (folder / "reference").is_dir():
            world = with_l_shape(world, folder / "reference", recording.cameras, settings)
    return calibrate_bar(
        observations,
        recording.info.length,
        settings,
        world,
        given,
        recording.info.length_sigma,
        recording.info.target_radius,
        progress,
    )


def with_l_shape(
    world: WorldKnowledge, folder: Path, cameras: tuple[str, ...], settings: BarSettings
) -> WorldKnowledge:
    """Measure an L-shaped reference: folder/<camera>/<any>.png or folder/<camera>.png, and folder/reference.toml.

    Raises
    ------
    CaptureError
        If `reference.toml` can't be read, or no camera has an image.
    CalibrationError
        If two cameras don't find its three targets.
    """
    file = folder / "reference.toml"
    hint = "it must say long_arm and short_arm, metres"
    try:
        shape = LShape(**read_toml(file, CaptureError, hint))
    except ValidationError as error:
        raise CaptureError(f"{file}: {explained(error)}; {hint}") from None
    candidates = np.full((len(cameras), 3, 2), np.nan)
    images = 0
    for c, name in enumerate(cameras):
        files = sorted(f for f in folder.glob(f"{name}/*") if f.suffix.lower() in IMAGE_ENDINGS)
        files += [f for e in IMAGE_ENDINGS if (f := folder / f"{name}{e}").is_file()]
        if not files:
            continue
        images += 1
        image = gray_of(read_image(files[0]))
        targets = find_targets(image, np.full_like(image, np.median(image)), settings.targets)
        if len(targets) >= 3:
            candidates[c] = targets[:3, :2]
    if not images:
        raise CaptureError(f"{folder}: holds no images; expected {folder.name}/<camera>/000000.png")
    found = int(np.isfinite(candidates).all(axis=(1, 2)).sum())
    if found < 2:
        raise CalibrationError(f"{folder}: only {found} of {images} images show the three targets of the L-shape")
    return replace(world, l_shape=candidates, arms=(shape.long_arm, shape.short_arm))


def with_points(
    world: WorldKnowledge, observed: Observed, coordinates: dict[str, np.ndarray], cameras: tuple[str, ...]
) -> WorldKnowledge:
    """Fix the world by observed points of known coordinates.

    Parameters
    ----------
    observed : Observed
        Each point once a camera.
    coordinates : dict of point name to (3,) float
        Metres.
    cameras : tuple of str

    Raises
    ------
    CalibrationError
        If fewer than three of the points are observed.
    """
    names = [n for n in coordinates if n in observed.points]
    if len(names) < 3:
        raise CalibrationError(f"{len(names)} of the given points are observed; three are needed")
    pixels = np.full((len(cameras), len(names), 2), np.nan)
    for c, camera in enumerate(cameras):
        for k, name in enumerate(names):
            rows = np.flatnonzero((observed.cameras == camera) & (observed.points == name))
            if len(rows):
                pixels[c, k] = observed.pixels[rows].mean(axis=0)
    return replace(world, points_pixels=pixels, points_world=np.array([coordinates[n] for n in names]))
