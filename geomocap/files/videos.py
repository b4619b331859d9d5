"""Frames of a video file, read when they are asked for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import av
import numpy as np

from geomocap.errors import CaptureError
from geomocap.files.image_formats import MOST_PIXELS
from geomocap.reading import open_plain, reason

VIDEO_ENDINGS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,flv,ogg"  # none that leads to other files
KEPT = 64e6  # bytes of decoded frames that are kept
LEAST_KEPT = 4  # frames, so that threads may ask for them in another order
_UNREADABLE = (av.FFmpegError, IndexError, OSError, ValueError)


@dataclass
class Video:
    """Frames of one camera in a video file, decoded one by one and never unpacked to disk.

    Reading forwards is cheap; reading elsewhere seeks to the key frame before. The frames decoded last are kept as the
    video has them, so that reading backwards decodes each only a few times. May be shared by threads.
    """

    path: Path
    kept: float = KEPT
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _container: av.container.InputContainer | None = field(default=None, repr=False)
    _frames: object = field(default=None, repr=False)
    _next: int = field(default=0, repr=False)
    _recent: OrderedDict[int, av.VideoFrame] = field(default_factory=OrderedDict, repr=False)

    def __getstate__(self) -> dict:
        return {"path": self.path, "kept": self.kept}

    def __setstate__(self, state: dict) -> None:
        self.__init__(**state)  # type: ignore[misc]

    @cached_property
    def _times(self) -> tuple[int, ...]:
        """Presentation times of all frames, from the packets alone (nothing is decoded)."""
        try:
            with self._open() as container:
                stream = container.streams.video[0]
                times = sorted(p.pts for p in container.demux(stream) if p.pts is not None and not p.is_discard)
        except _UNREADABLE as error:
            raise CaptureError(f"{self.path}: no readable video ({_said(error)}); record or copy it again") from None
        if not times:
            raise CaptureError(f"{self.path}: holds no video frames; record or copy it again")
        return tuple(times)

    def __len__(self) -> int:
        return len(self._times)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels."""
        height, width = self.read(0).shape[:2]
        return width, height

    def read(self, frame: int) -> np.ndarray:
        """Return frame `frame` as (H, W, 3) uint8, RGB."""
        with self._lock:
            if frame not in self._recent:
                try:
                    self._decode_to(frame)
                except (*_UNREADABLE, StopIteration, MemoryError) as error:
                    raise self._undecodable(frame, error) from None
            try:
                return self._recent[frame].to_ndarray(format="rgb24")
            except (*_UNREADABLE, MemoryError) as error:
                raise self._undecodable(frame, error) from None

    def _undecodable(self, frame: int, error: Exception) -> CaptureError:
        return CaptureError(
            f"{self.path}: frame {frame} of {len(self)} can't be decoded ({_said(error)}); copy the file again"
        )

    def _open(self) -> av.container.InputContainer:
        """Open the file as a container of pictures; a play list, which would lead to other files, is none."""
        open_plain(self.path).close()
        return av.open(str(self.path.absolute()), options={"format_whitelist": CONTAINERS})

    def _decode_to(self, frame: int) -> None:
        times = self._times
        if self._container is None or not self._next <= frame <= self._next + 64:
            if self._container is not None:
                self._container.close()
            self._container = self._open()
            stream = self._container.streams.video[0]
            if stream.codec_context is None:
                raise CaptureError(f"{self.path}: pictures are in a code that isn't known; convert the video to H.264")
            stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
            stream.thread_type = "SLICE"  # frame threads would hand out frames late after a seek
            if frame > 0:
                self._container.seek(times[frame], stream=stream, backward=True)
            self._frames = self._container.decode(stream)
        while True:
            picture = next(self._frames)  # type: ignore[call-overload]
            if picture.pts is None or picture.is_corrupt:
                raise CaptureError(f"{self.path}: damaged near frame {frame} of {len(self)}; copy the file again")
            index = int(np.searchsorted(times, picture.pts))
            self._next = index + 1
            self._recent[index] = picture
            while len(self._recent) > max(LEAST_KEPT, int(self.kept / _bytes(picture))):
                self._recent.popitem(last=False)
            if index >= frame:
                if index > frame:
                    raise CaptureError(f"{self.path}: frame {frame} is missing from the stream; copy the file again")
                return


def _bytes(picture: av.VideoFrame) -> int:
    """Memory that a decoded picture takes."""
    return max(1, sum(plane.buffer_size for plane in picture.planes))


def _said(error: Exception) -> str:
    """Say what libav found wrong, without the path that it repeats."""
    if isinstance(error, StopIteration):
        return "it ends early"
    if isinstance(error, IndexError):
        return "it holds no pictures"
    if isinstance(error, av.ArgumentError):
        return "it is no MP4, MOV, MKV, WebM, AVI, MPEG, ASF, FLV or Ogg"
    if isinstance(error, av.FFmpegError) and error.strerror:
        return str(error.strerror)
    return reason(error)
