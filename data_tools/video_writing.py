"""Writing a video file picture by picture, whole or not at all."""

from __future__ import annotations

import os
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from geomocap.errors import RunError
from geomocap.files.atomic import temporary_beside
from geomocap.files.whole_files import is_whole_mp4


class VideoFile:
    """An H.264 video under way; it appears under its name when `finish` has been called.

    Parameters
    ----------
    path : Path
        Name of the MP4 file.
    width, height : int
        Even numbers of pixels, as H.264 with subsampled colours wants them.
    fps : float
        Frames per second.
    crf : int
        Constant rate factor of x264: 12 is visually lossless.
    """

    def __init__(self, path: Path, width: int, height: int, fps: float, crf: int = 12) -> None:
        if width % 2 or height % 2:
            raise RunError(f"{path}: {width}×{height} can't be written as H.264; choose even numbers of pixels")
        self.path = path
        self._temporary = temporary_beside(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._temporary), "w")
        except OSError as error:
            raise RunError(f"{path}: can't be written ({error.strerror}); choose another folder") from None
        rate = Fraction(fps).limit_denominator(1001)
        # One thread: the same file whatever the number of cores
        options = {"crf": str(crf), "preset": "veryfast", "threads": "1"}
        self._stream = self._container.add_stream("libx264", rate=rate, options=options)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"

    def add(self, picture: np.ndarray) -> None:
        """Append a picture, (H, W, 3) uint8 RGB."""
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        try:
            self._container.mux(self._stream.encode(frame))
        except OSError as error:
            raise RunError(f"{self.path}: can't be written ({error.strerror}); free space") from None

    def finish(self) -> None:
        """Write what is still under way and give the file its name."""
        try:
            self._container.mux(self._stream.encode())
            self._container.close()
            if not is_whole_mp4(self._temporary):
                raise OSError(None, "it was not written whole")
            os.replace(self._temporary, self.path)
        except OSError as error:
            raise RunError(f"{self.path}: can't be written ({error.strerror}); free space") from None

    def close(self) -> None:
        """Drop the file if it was not finished."""
        if self._temporary.exists():
            with suppress(OSError):  # what is still under way has no room either
                self._container.close()
            self._temporary.unlink(missing_ok=True)
