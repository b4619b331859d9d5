"""Image files: their pixels, their size without decoding them, and folders of them as the frames of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from geomocap.errors import CaptureError
from geomocap.files.atomic import write_bytes

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg")
ORIENTATION = 0x0112  # EXIF tag; from 5 on rows and columns change places


def read_image(path: Path, *, gray: bool = False, alpha: bool = False) -> np.ndarray:
    """Read an image file as (H, W, 3) uint8 RGB, as (H, W) uint8 if `gray`, as (H, W, 4) RGBA if `alpha`.

    Raises
    ------
    CaptureError
        If the file is missing, truncated or no image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _missing(path, error) from None
    if _is_whole(data, data):
        mode = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_UNCHANGED if alpha else cv2.IMREAD_COLOR_RGB
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
        if alpha and image is not None:
            conversion = {2: cv2.COLOR_GRAY2RGBA, 4: cv2.COLOR_BGRA2RGBA}.get(
                image.shape[2] if image.ndim == 3 else 2, cv2.COLOR_BGR2RGBA
            )
            image = cv2.cvtColor(image, conversion)
        if image is not None:
            return image
    raise _damaged(path, len(data))


def write_image(path: Path, image: np.ndarray, parameters: Sequence[int] = ()) -> None:
    """Write an image (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA, uint8, whole or not at all.

    The ending says the format; `parameters` are OpenCV's. What OpenCV writes itself it doesn't check.

    Raises
    ------
    RunError
        If the file can't be written.
    """
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    write_bytes(path, cv2.imencode(path.suffix, image, list(parameters))[1].data, lasting=False)


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a silhouette (H, W) uint8 as a PNG that is made for speed, whole or not at all."""
    fast = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
    write_image(path, mask, fast)


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image file as it will be read, pixels.

    Raises
    ------
    CaptureError
        If the file is missing, truncated or no image.
    """
    try:
        with path.open("rb") as file:
            head = file.read(8)
            length = file.seek(0, 2)
            file.seek(max(0, length - 4096))
            if _is_whole(head, file.read()):
                with Image.open(file) as image:
                    turned = "exif" in image.info and image.getexif().get(ORIENTATION, 1) >= 5
                    return (image.height, image.width) if turned else (image.width, image.height)
    except Image.UnidentifiedImageError:
        pass
    except OSError as error:
        raise _missing(path, error) from None
    raise _damaged(path, length)


@dataclass(frozen=True)
class ImageFolder:
    """Frames of one camera as numbered image files."""

    files: tuple[Path, ...]

    def __len__(self) -> int:
        return len(self.files)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the first frame, pixels; all others must have it."""
        return image_size(self.files[0])

    def read(self, frame: int) -> np.ndarray:
        """Return frame `frame` as (H, W, 3) uint8, RGB."""
        image = read_image(self.files[frame])
        self.check_size(frame, (image.shape[1], image.shape[0]))
        return image

    def check_size(self, frame: int, size: tuple[int, int]) -> None:
        """Raise CaptureError if a frame has not the size of the first one."""
        if size != self.size:
            raise CaptureError(
                f"{self.files[frame]}: {size_text(size)} pixels, but {self.files[0].name} is {size_text(self.size)}; "
                "all frames of a camera need the same size: write the wrong one again"
            )


def size_text(size: tuple[int, int]) -> str:
    """Return width and height as messages show them."""
    return f"{size[0]}×{size[1]}"


def _is_whole(head: bytes, tail: bytes) -> bool:
    """Whether an image file that begins and ends like this has its end: 8 bytes and 4096 tell."""
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return b"IEND" in tail[-64:]
    if head[:2] == b"\xff\xd8":
        return b"\xff\xd9" in tail[-4096:]
    return len(head) > 0


def _missing(path: Path, error: OSError) -> CaptureError:
    """Return the error of an image file that can't be opened."""
    return CaptureError(f"{path}: can't be read ({error.strerror or error}); every camera needs every frame")


def _damaged(path: Path, length: int) -> CaptureError:
    """Return the error of an image file that holds no whole image."""
    return CaptureError(f"{path}: truncated or no image ({length} bytes); write it again")
