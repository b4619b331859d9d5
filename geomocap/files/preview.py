"""A capture at a glance: every n-th frame, images reduced, so that a run of it shows in little time what to expect.

What is left is as small as following it allows. Patches follow a walking or dancing person from frame to frame down to
about 12 frames a second (LEAST_FPS): n is the largest number that leaves as many. Images whose longer side has 320
pixels (LONGEST) still show limbs as wide as the patches that are followed on them.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geomocap.files.capture import Capture, FrameSource
from geomocap.model.rig import Rig, reduction

LEAST_FPS = 12.0  # frames a second that are left
LONGEST = 320  # longer side of the images that are left, about, pixels
KEPT = 64e6  # bytes of a camera's reduced frames that are kept, so that each is decoded once


def frames_apart(fps: float) -> int:
    """Return how many frames a preview goes on at a time: the most that leave `LEAST_FPS`, at least 1."""
    return max(1, int(fps / LEAST_FPS + 1e-6))


@dataclass
class PreviewFrames:
    """Some frames of one camera, reduced; decoded once and in order where memory allows. May be shared by threads.

    Attributes
    ----------
    source : FrameSource
    first, every : int
        Frame 0 here is frame `first` there, frame 1 is `first + every`, and so on.
    size : (int, int)
        Width and height, pixels.
    """

    source: FrameSource
    first: int
    every: int
    size: tuple[int, int]
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)
    _frames: list[np.ndarray] = field(default_factory=list, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {"source": self.source, "first": self.first, "every": self.every, "size": self.size}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def __len__(self) -> int:
        return -(-(len(self.source) - self.first) // self.every)

    def read(self, frame: int) -> np.ndarray:
        """Return frame `frame` as (H, W, 3) uint8, RGB."""
        if not 0 <= frame < len(self) or 3 * self.size[0] * self.size[1] * len(self) > KEPT:
            return self._reduced(frame)
        with self._lock:
            while len(self._frames) <= frame:
                self._frames.append(self._reduced(len(self._frames)))
            return self._frames[frame].copy()

    def _reduced(self, frame: int) -> np.ndarray:
        return shrunk(self.source.read(self.first + frame * self.every), self.size)


@dataclass(frozen=True)
class PreviewCapture(Capture):
    """A capture of which every n-th frame is used, with reduced images.

    Attributes
    ----------
    whole : Capture
    every : int
        The n.
    longest : int
        Longer side of the images, about, pixels.
    """

    whole: Capture | None = None
    every: int = 1
    longest: int = LONGEST

    @classmethod
    def of(cls, capture: Capture, every: int | None = None, longest: int = LONGEST) -> PreviewCapture:
        """Make the preview of a capture; where n is not given, it follows from the frame rate."""
        every = frames_apart(capture.fps) if every is None else every
        info, first = capture.info, capture.first % every
        update: dict[str, Any] = {"fps": info.fps / every}
        if info.frames is not None:
            begin = capture.first // every
            update["frames"] = begin, begin + (capture.n_frames - 1) // every
        sources: dict[str, FrameSource] = {}
        for name, source in capture.sources.items():
            width, height = source.size
            factor = reduction(width, height, longest)
            sources[name] = PreviewFrames(source, first, every, (width // factor, height // factor))
        info = info.model_copy(update=update)
        return cls(capture.path, info, capture.cameras, sources, capture.corrected, capture, every, longest)

    @property
    def _whole(self) -> Capture:
        assert self.whole is not None
        return self.whole

    def _number(self, frame: int) -> int:
        """Return which frame of the whole capture one is, also of a part of the preview."""
        first = self._whole.first
        return first % self.every + (self.first + frame) * self.every - first

    @property
    def record(self) -> dict[str, int]:
        """What `run.toml` says of it."""
        return {"every": self.every, "longest": self.longest}

    @cached_property
    def rig(self) -> Rig:
        """The calibrated cameras with reduced images; raises as `Capture.rig`."""
        if self.corrected is not None:
            return self.corrected
        return self._whole.rig.select(self.cameras).reduced(self.longest)

    def background(self, camera: str) -> np.ndarray:
        """Read the reduced background picture of a camera; a pixel is known if all that it covers is."""
        plate = shrunk(self._whole.background(camera), self.sources[camera].size)
        plate[..., 3] = np.where(plate[..., 3] == 255, 255, 0)
        return plate

    def mask_file(self, camera: str, frame: int) -> Path:
        """Return where a given silhouette is."""
        return self._whole.mask_file(camera, self._number(frame))

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """Read a given silhouette, reduced: (H, W) uint8, 0 or 255; raises as `Capture.mask`."""
        mask = shrunk(self._whole.mask(camera, self._number(frame)), self.sources[camera].size)
        return np.where(mask > 127, 255, 0).astype(np.uint8)

    def fingerprint(self, *parts: str) -> str:
        """Digest of the files of these parts, and of what of them is used."""
        return f"{self._whole.fingerprint(*parts)} {self.every} {self.longest}"


def shrunk(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Reduce an image to a width and height."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def preview_of(capture: Capture, record: dict[str, int] | None) -> Capture:
    """Return what a run was made from: the capture, or its preview as `run.toml` records it."""
    return capture if record is None else PreviewCapture.of(capture, record["every"], record["longest"])
