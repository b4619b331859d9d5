"""A capture: the folder of synchronized images or videos that everything starts from, read lazily.

capture.toml                     name, fps, length_unit, up; optional: cameras, frames, template_camera,
                                 region_of_interest
images/<camera>/000000.png       or videos/<camera>.mp4
background/<camera>.png          optional
masks/<camera>/000000.png        optional, used as they are; with masks there may be no images at all
sparse/                          calibration, a COLMAP model
bar/<camera>/000000.png          optional reference-bar recording
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
import tomli_w
from pydantic import Field, ValidationError, field_validator

from geomocap.errors import CaptureError
from geomocap.files.atomic import fingerprint, links, write_text
from geomocap.files.images import IMAGE_ENDINGS, ImageFolder, read_image, size_text
from geomocap.files.rigs import read_rig
from geomocap.files.videos import VIDEO_ENDINGS, Video
from geomocap.model.rig import Rig
from geomocap.reading import check_name, list_folder, read_toml
from geomocap.settings import LEAST_FPS, MOST_FPS, Settings, explained

PARTS = ("capture.toml", "images", "videos", "background", "masks", "sparse", "bar", "reference")

Point = tuple[float, float, float]


class CaptureInfo(Settings):
    """What `capture.toml` says."""

    name: str = Field("capture", description="name of the recording")
    fps: float = Field(ge=LEAST_FPS, le=MOST_FPS, description="frames per second")
    length_unit: Literal["m"] = Field("m", description="unit of the calibration")
    up: Literal["y", "z"] = Field("z", description="world axis that points up")
    cameras: tuple[str, ...] | None = Field(
        None, min_length=1, description="the cameras to use, in this order; all if not given"
    )
    frames: tuple[int, int] | None = Field(
        None, description="the first and the last frame to use, of what was recorded; all if not given"
    )
    template_camera: str | None = Field(None, description="camera whose images are the templates of matching")
    region_of_interest: tuple[Point, Point] | None = Field(
        None, description="corners (min, max) of the working volume, metres, world"
    )

    @field_validator("cameras")
    @classmethod
    def _each_once(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        for k, name in enumerate(names or ()):
            if names and name in names[:k]:
                raise ValueError(f"camera {name} is there more than once; name each camera once")
        return names

    @field_validator("frames")
    @classmethod
    def _in_order(cls, frames: tuple[int, int] | None) -> tuple[int, int] | None:
        if frames is not None and not 0 <= frames[0] <= frames[1]:
            raise ValueError(f"expected the first and the last frame to use, got {list(frames)}")
        return frames

    @field_validator("region_of_interest")
    @classmethod
    def _min_below_max(cls, box: tuple[Point, Point] | None) -> tuple[Point, Point] | None:
        if box is not None and not all(low < high for low, high in zip(*box, strict=True)):
            raise ValueError(
                f"expected the corners (min, max), got {list(box[0])} and {list(box[1])}; each max must exceed its min"
            )
        return box


class FrameSource(Protocol):
    """Frames of one camera, in order, readable in any order."""

    def __len__(self) -> int: ...

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels."""
        ...

    def read(self, frame: int) -> np.ndarray:
        """Return frame `frame` as (H, W, 3) uint8, RGB."""
        ...


MOST_LABELS = 16  # values of a picture of labels
LABELLED = 0.01  # of what isn't background, that has other labels than the subject's


@dataclass(frozen=True)
class Capture:
    """A capture folder, checked when it is opened; images are read when they are asked for.

    Frames are numbered from the first that `capture.toml` says to use.

    Attributes
    ----------
    path : Path
    info : CaptureInfo
    cameras : tuple of str
        Camera names in the order used everywhere.
    sources : dict of str to FrameSource
        All that was recorded, also what isn't used.
    corrected : Rig, optional
        Cameras to use instead of the calibration.
    """

    path: Path
    info: CaptureInfo
    cameras: tuple[str, ...]
    sources: dict[str, FrameSource]
    corrected: Rig | None = None

    @classmethod
    def open(cls, path: Path) -> Capture:
        """Open and check a capture folder.

        Raises
        ------
        CaptureError
            If it isn't one: no capture.toml or a wrong one, a camera folder missing, frame counts that differ, a link
            that leads out.
        """
        path = Path(path)
        if not path.is_dir():
            raise CaptureError(f"{path}: no such capture folder")
        check_links(path)
        info = read_capture_info(path)
        found = _find_sources(path)
        if not found:
            raise CaptureError(f"{path}: holds neither images/<camera>/*.png nor videos/<camera>.mp4 nor masks")
        names = info.cameras or tuple(sorted(found))
        for name in names:
            if name not in found:
                raise CaptureError(
                    f"{path}: camera {name} of capture.toml has no folder images/{name} and no video videos/{name}.mp4"
                )
        if info.template_camera is not None and info.template_camera not in names:
            raise CaptureError(
                f"{path / 'capture.toml'}: template_camera: there is no camera {info.template_camera}; "
                f"choose one of {', '.join(names)}"
            )
        counts = {n: len(found[n]) for n in names}
        if len(set(counts.values())) > 1:
            listed = ", ".join(f"{n}: {c}" for n, c in counts.items())
            raise CaptureError(
                f"{path}: cameras have unequal numbers of frames ({listed}); cut them to the same frames"
            )
        recorded = counts[names[0]]
        if info.frames is not None and info.frames[1] >= recorded:
            raise CaptureError(
                f"{path / 'capture.toml'}: frames: {list(info.frames)}, but {recorded} were recorded; the last is "
                f"{recorded - 1}"
            )
        return cls(path, info, names, {n: found[n] for n in names})

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.info.fps

    @property
    def n_frames(self) -> int:
        """Number of frames to use, the same for all cameras."""
        first, last = self.info.frames or (0, self.n_recorded - 1)
        return last - first + 1

    @property
    def n_recorded(self) -> int:
        """Number of frames that were recorded, the same for all cameras."""
        return len(self.sources[self.cameras[0]])

    @property
    def first(self) -> int:
        """Number of the first frame to use in the recording."""
        return self.info.frames[0] if self.info.frames else 0

    def frame(self, camera: str, frame: int) -> np.ndarray:
        """Read one image: (H, W, 3) uint8, RGB."""
        return self.sources[camera].read(self.first + frame)

    def has_background(self, camera: str) -> bool:
        """Whether the capture brings an empty background picture of this camera."""
        return self._background_file(camera) is not None

    def background(self, camera: str) -> np.ndarray:
        """Read the empty background picture of a camera: (H, W, 4) uint8, RGBA, alpha 0 where it is not known.

        Raises
        ------
        CaptureError
            If it is missing or has not the size of the images.
        """
        file = self._background_file(camera)
        if file is None:
            raise CaptureError(f"{self.path}: no background/{camera}.png")
        image = read_image(file, alpha=True)
        self._check_size(file, camera, (image.shape[1], image.shape[0]), "take it with the settings of the recording")
        return image

    def _background_file(self, camera: str) -> Path | None:
        files = [self.path / "background" / f"{camera}{e}" for e in IMAGE_ENDINGS]
        return next((f for f in files if f.is_file()), None)

    @property
    def has_images(self) -> bool:
        """Whether there are images; otherwise the frames are those of the given silhouettes."""
        return any((self.path / part).is_dir() for part in ("images", "videos"))

    @property
    def has_masks(self) -> bool:
        """Whether the capture brings its own silhouettes."""
        return (self.path / "masks").is_dir()

    def mask_file(self, camera: str, frame: int) -> Path:
        """Return where a given silhouette is, if the capture brings its own."""
        return self.path / "masks" / camera / f"{self.first + frame:06d}.png"

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """Read a given silhouette: (H, W) uint8, 0 or 255.

        Raises
        ------
        CaptureError
            If it is missing, has not the size of the images, or other values than these two mark the subject.
        """
        file = self.mask_file(camera, frame)
        values = read_image(file, gray=True)
        self.check_mask_size(camera, frame, (values.shape[1], values.shape[0]))
        if labels := labels_of(values):
            raise CaptureError(
                f"{file}: holds areas of the values {', '.join(map(str, labels))}; expected 0 for background and 255 "
                "for the subject: write it with these"
            )
        mask = np.where(values > 127, 255, 0).astype(np.uint8)
        if values.any() and not mask.any():
            raise CaptureError(
                f"{file}: its values go up to {values.max()} only; expected 0 for background and 255 for the subject: "
                "write it with these"
            )
        return mask

    def check_mask_size(self, camera: str, frame: int, size: tuple[int, int]) -> None:
        """Raise CaptureError if a given silhouette has not the size of the camera's images."""
        self._check_size(self.mask_file(camera, frame), camera, size, "write the mask in that size")

    def _check_size(self, file: Path, camera: str, size: tuple[int, int], remedy: str) -> None:
        wanted = self.sources[camera].size
        if size != wanted:
            raise CaptureError(
                f"{file}: {size_text(size)} pixels, but the images of camera {camera} are {size_text(wanted)}; {remedy}"
            )

    @property
    def is_calibrated(self) -> bool:
        """Whether the capture holds a calibration."""
        return (self.path / "sparse").is_dir()

    @cached_property
    def rig(self) -> Rig:
        """The calibrated cameras, in the capture's order.

        Raises
        ------
        CalibrationError
            If there is no calibration, or one without all the cameras.
        CaptureError
            If an image's size is not the one that the camera is calibrated for.
        """
        if self.corrected is not None:
            return self.corrected
        if not self.is_calibrated:
            raise CaptureError(f"{self.path}: not calibrated, no folder sparse/; run `geomocap calibrate {self.path}`")
        if len(self.cameras) < 2:
            raise CaptureError(f"{self.path}: one camera, {self.cameras[0]}, can't measure depth; take two or more")
        rig = read_rig(self.path / "sparse", self.cameras)
        for name, (w, h) in zip(rig.names, rig.sizes, strict=True):
            size = self.sources[name].size
            if size != (w, h):
                self.frame(name, self.n_frames - 1)  # a first frame unlike the others is no reason to calibrate again
                raise CaptureError(
                    f"{self.path}: images of camera {name} are {size_text(size)}, but it is calibrated for {w}×{h}; "
                    "calibrate again, or import with the tool that made the calibration"
                )
        return rig

    def without(self, cameras: Collection[str]) -> Capture:
        """Return the capture without some of its cameras."""
        kept = tuple(c for c in self.cameras if c not in cameras)
        template = self.info.template_camera if self.info.template_camera in kept else None
        info = self.info.model_copy(update={"template_camera": template})
        corrected = None if self.corrected is None else self.corrected.select(kept)
        return replace(self, info=info, cameras=kept, sources={c: self.sources[c] for c in kept}, corrected=corrected)

    def part(self, frames: range) -> Capture:
        """Return the capture with some of the frames that it uses, which are numbered anew."""
        used = self.first + frames.start, self.first + frames.stop - 1
        return replace(self, info=self.info.model_copy(update={"frames": used}))

    def with_rig(self, rig: Rig) -> Capture:
        """Return the capture with other cameras than those it is calibrated with."""
        return replace(self, corrected=rig)

    def fingerprint(self, *parts: str) -> str:
        """Digest of the names, sizes and times of the files of these parts ("images", "masks", "sparse" …)."""
        return fingerprint([self.path / "capture.toml", *(self.path / p for p in parts)])


def labels_of(values: np.ndarray) -> list[int]:
    """Return the values of a picture (H, W) uint8 if they are labels that a limit would divide; else none.

    Soft outlines have dark values, too, but no areas of them; what was compressed has areas, but of many values.
    """
    counts = np.bincount(values.ravel(), minlength=256)
    present = np.flatnonzero(counts)
    dark = counts[1:128].any() and counts[128:].any() and len(present) <= MOST_LABELS
    if not dark:
        return []
    window = np.ones((3, 3), np.uint8)
    flat = (cv2.erode(values, window) == cv2.dilate(values, window)) & (values > 0) & (values < 128)
    return present.tolist() if np.count_nonzero(flat) > LABELLED * np.count_nonzero(values) else []


def open_capture(path: str | Path) -> Capture:
    """Open a capture: cameras, calibration and frames, read when they are asked for.

    Parameters
    ----------
    path : str or Path
        Its folder.

    Raises
    ------
    CaptureError
        If the folder is no capture, or its parts don't fit together.
    """
    return Capture.open(Path(path))


def check_links(path: Path) -> None:
    """Raise CaptureError if a symbolic link leads out of a capture folder."""
    root = os.path.realpath(path)
    for link in (found for part in PARTS for found in links(path / part, depth=2)):
        if not Path(os.path.realpath(link)).is_relative_to(root):
            raise CaptureError(f"{link}: leads out of the capture folder; replace the link by what it stands for")


def read_capture_info(path: Path) -> CaptureInfo:
    """Read and check `capture.toml` of a capture folder."""
    file = path / "capture.toml"
    try:
        return CaptureInfo(**read_toml(file, CaptureError, "a capture needs at least `fps = …` in it"))
    except ValidationError as error:
        raise CaptureError(f"{file}: {explained(error)}; see docs/captures.md") from None


def write_capture_info(path: Path, info: CaptureInfo) -> None:
    """Write `capture.toml` of a capture folder."""
    write_text(path / "capture.toml", tomli_w.dumps(info.model_dump(exclude_none=True)))


def _entries(folder: Path) -> list[Path]:
    return list_folder(folder, CaptureError) if folder.is_dir() else []


def _find_sources(path: Path) -> dict[str, FrameSource]:
    """Frames by camera: images, videos, or if there are neither, the given silhouettes."""
    sources = _image_folders(path / "images")
    for file in _entries(path / "videos"):
        if file.suffix.lower() in VIDEO_ENDINGS and file.stem not in sources:
            check_name(file.stem, str(path / "videos"), CaptureError)
            sources[file.stem] = Video(file)
    return sources or _image_folders(path / "masks")


def _image_folders(parent: Path) -> dict[str, FrameSource]:
    sources: dict[str, FrameSource] = {}
    for folder in (p for p in _entries(parent) if p.is_dir()):
        check_name(folder.name, str(parent), CaptureError)
        files = tuple(f for f in list_folder(folder, CaptureError) if f.suffix.lower() in IMAGE_ENDINGS)
        for k, file in enumerate(files):
            if file.stem != f"{k:06d}":
                raise CaptureError(f"{file}: expected frame {k:06d} here; frames count from 000000 without gaps")
        if not files:
            raise CaptureError(f"{folder}: holds no frames (000000.png …)")
        sources[folder.name] = ImageFolder(files)
    return sources
