"""A reference-bar recording on disk: `bar/<camera>/000000.png` or `bar/<camera>.mp4`, and `bar/bar.toml`."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from geomocap.calibration.calibration_settings import TargetSettings
from geomocap.calibration.target_observations import TargetObservations, stack_candidates
from geomocap.calibration.targets import find_targets, gray_of, still_background
from geomocap.errors import CaptureError
from geomocap.files.capture import FrameSource
from geomocap.files.images import IMAGE_ENDINGS, ImageFolder
from geomocap.files.videos import VIDEO_ENDINGS, Video
from geomocap.progress import Progress, silent
from geomocap.reading import check_name, list_folder, read_toml
from geomocap.scheduling import map_items, threads
from geomocap.settings import Settings, explained

LEAST_LENGTH, MOST_LENGTH = 1e-3, 20.0  # of a bar, metres


class BarInfo(Settings):
    """What `bar/bar.toml` says."""

    length: float = Field(gt=0, lt=MOST_LENGTH, description="distance of the two target centres (m)")
    length_sigma: float | None = Field(None, gt=0, description="its standard deviation (m)")
    target_radius: float | None = Field(None, gt=0, description="radius of the balls (m); measured if not given")
    floor: tuple[int, ...] = Field((), description="frames in which the bar lies on the floor")


@dataclass(frozen=True)
class Recording:
    """Images of a reference bar by all cameras.

    Attributes
    ----------
    path : Path
    info : BarInfo
    cameras : tuple of str
    frames : (T,) int
        Frame numbers, the same for all cameras.
    sources : dict of str to FrameSource
    """

    path: Path
    info: BarInfo
    cameras: tuple[str, ...]
    frames: np.ndarray
    sources: dict[str, FrameSource]

    @classmethod
    def open(cls, folder: Path, cameras: tuple[str, ...] | None = None, length: float | None = None) -> Recording:
        """Open the folder `bar` of a capture.

        Parameters
        ----------
        folder : Path
        cameras : tuple of str, optional
            The cameras wanted; all that are there if not given.
        length : float, optional
            Length of the bar, metres, instead of what `bar.toml` says.

        Raises
        ------
        CaptureError
            If it holds no recording, cameras are missing or have different frames, or the length is not known.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise CaptureError(f"{folder}: no bar recording; expected {folder.name}/<camera>/000000.png and bar.toml")
        info = read_bar_info(folder / "bar.toml", length)
        sources: dict[str, FrameSource] = {}
        numbers: dict[str, np.ndarray] = {}
        entries = list_folder(folder, CaptureError)
        for sub in (p for p in entries if p.is_dir()):
            found = list_folder(sub, CaptureError)
            files = tuple(f for f in found if f.suffix.lower() in IMAGE_ENDINGS and f.name[0] != ".")
            if not files:
                continue
            wrong = next((f for f in files if not f.stem.isdecimal()), None)
            if wrong is not None:
                raise CaptureError(f"{wrong}: expected a frame number as name (000000.png)")
            check_name(sub.name, str(folder), CaptureError)
            sources[sub.name] = ImageFolder(files)
            numbers[sub.name] = np.array([int(f.stem) for f in files])
        for file in entries:
            if file.suffix.lower() in VIDEO_ENDINGS and file.stem not in sources:
                video = Video(file)
                sources[file.stem], numbers[file.stem] = video, np.arange(len(video))
        names = cameras or tuple(sorted(sources))
        missing = [n for n in names if n not in sources]
        if missing or len(names) < 2:
            what = f"no images of camera {', '.join(missing)}" if missing else f"images of {len(names)} camera(s) only"
            raise CaptureError(f"{folder}: {what}; expected {folder.name}/<camera>/000000.png or <camera>.mp4")
        first = numbers[names[0]]
        for name in names[1:]:
            if not np.array_equal(numbers[name], first):
                raise CaptureError(
                    f"{folder}: cameras {names[0]} and {name} have different frames ({len(first)} and "
                    f"{len(numbers[name])}); cut them to the same frames"
                )
        return cls(folder, info, names, first, {n: sources[n] for n in names})


def read_bar_info(file: Path, length: float | None = None) -> BarInfo:
    """Read and check `bar.toml`; a given length goes before the file's, and makes do without the file."""
    if length is not None:
        check_length(length)
    values: dict[str, Any] = {}
    if file.exists() or length is None:
        values = read_toml(file, CaptureError, "it must say `length = …`, metres between the target centres")
    try:
        return BarInfo(**{**values, **({"length": length} if length is not None else {})})
    except ValidationError as error:
        raise CaptureError(f"{file}: {explained(error)}; lengths are in metres") from None


def check_length(length: float) -> None:
    """Refuse what is no length of a bar, metres, that was given instead of the file's."""
    if not LEAST_LENGTH <= length < MOST_LENGTH:
        raise CaptureError(
            f"--distance {length:g}: expected the distance of the bar's two target centres in metres, "
            f"{LEAST_LENGTH:g} to {MOST_LENGTH:g}"
        )


def measure(
    recording: Recording,
    settings: TargetSettings,
    progress: Progress = silent,
    executor: Executor | None = None,
) -> TargetObservations:
    """Find and measure the targets in all images.

    Candidates that are much fainter than the camera's targets usually are get dropped.

    Raises
    ------
    CaptureError
        If a camera's images differ in size or can't be read.
    """
    if executor is None:
        with threads() as own:
            return measure(recording, settings, progress, own)
    count = len(recording.frames)
    index = np.arange(count)

    def background_of(name: str) -> np.ndarray:
        return still_background(recording.sources[name], index, settings)

    backgrounds = dict(zip(recording.cameras, map_items(background_of, recording.cameras, executor), strict=True))
    # Runs of frames, so that a video is decoded forwards by one thread
    jobs = [(c, run) for c in range(len(recording.cameras)) for run in np.array_split(index, max(1, count // 64))]

    def find(job: tuple[int, np.ndarray]) -> list[np.ndarray]:
        name = recording.cameras[job[0]]
        found = []
        for t in job[1]:
            image = gray_of(recording.sources[name].read(int(t)))
            if image.shape != backgrounds[name].shape:
                raise CaptureError(
                    f"{recording.path}: image {recording.frames[t]:06d} of camera {name} is {image.shape[1]}×"
                    f"{image.shape[0]}, the others {backgrounds[name].shape[1]}×{backgrounds[name].shape[0]}"
                )
            found.append(find_targets(image, backgrounds[name], settings))
        return found

    per_image: dict[tuple[int, int], np.ndarray] = {}
    for (c, run), found in zip(jobs, map_items(find, jobs, executor, "targets", progress), strict=True):
        per_image.update({(c, int(t)): f for t, f in zip(run, found, strict=True)})
    sizes = np.array([backgrounds[n].shape[::-1] for n in recording.cameras])
    candidates = {}
    for c in range(len(recording.cameras)):
        brightness = [f[1, 4] for (k, _), f in per_image.items() if k == c and len(f) >= 2]
        limit = settings.relative_contrast * float(np.median(brightness)) if brightness else 0.0
        for t in range(count):
            f = per_image[c, t]
            candidates[c, t] = f[f[:, 4] >= limit][: settings.max_candidates, :4]
    return stack_candidates(recording.cameras, sizes, recording.frames, candidates)
