"""Image files: their pixels, their size without decoding them, and folders of them as the frames of a camera.

Pictures have eight bits a value here. Those of 16 are scaled by the bits that a camera's pictures use: 10, 12, 14, 16.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from geomocap.errors import CaptureError
from geomocap.files.atomic import write_bytes
from geomocap.files.image_formats import MOST_PIXELS, ImageHeader, image_flaw, image_header
from geomocap.files.kept_frames import KeptFrames
from geomocap.reading import open_plain, read_bytes

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg")
MOST_SIDE = 16384  # pixels of an image that is made
_DEPTHS = (8, 10, 12, 14, 16)  # bits that cameras use of 16
_FAST = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_FIXED),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE),
)
_LOOKED_AT = 5  # frames of a camera that tell how many it uses


def read_image(path: Path, *, gray: bool = False, alpha: bool = False, bits: int | None = None) -> np.ndarray:
    """Read an image file as (H, W, 3) uint8 RGB, as (H, W) uint8 if `gray`, as (H, W, 4) RGBA if `alpha`.

    Parameters
    ----------
    path : Path
    gray, alpha : bool
    bits : int, optional
        How many bits of 16 its values use; as many as its largest value takes if not given.

    Raises
    ------
    CaptureError
        If the file is missing, truncated, damaged or no image, claims a size that no camera has, holds no whole
        numbers, or larger ones than its bits.
    """
    mode = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_UNCHANGED if alpha else cv2.IMREAD_COLOR_RGB
    image = _decoded(path, mode | cv2.IMREAD_ANYDEPTH)
    if image.dtype == np.uint16:
        image = _in_eight_bits(image, bits, path)
    if not alpha:
        return image
    channels = image.shape[2] if image.ndim == 3 else 1
    conversion = {1: cv2.COLOR_GRAY2RGBA, 4: cv2.COLOR_BGRA2RGBA}.get(channels, cv2.COLOR_BGR2RGBA)
    return cv2.cvtColor(image, conversion)


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
    write_image(path, mask, _FAST)


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image file as it will be read, pixels.

    Raises
    ------
    CaptureError
        If the file is missing, truncated or no image, or claims a size that no camera has.
    """
    try:
        with open_plain(path) as file:
            length = file.seek(0, 2)
            file.seek(max(0, length - 4096))
            tail = file.read()
            file.seek(0)
            header = image_header(file)
    except OSError as error:
        raise _missing(path, error) from None
    ends = {"PNG": (b"IEND", 64), "JPEG": (b"\xff\xd9", 4096)}
    if header is None or (header.kind in ends and ends[header.kind][0] not in tail[-ends[header.kind][1] :]):
        raise _damaged(path, length)
    _check_claim(path, header)
    return header.width, header.height


def _decoded(path: Path, mode: int) -> np.ndarray:
    """Decode an image file that is whole, in the depth that it has."""
    try:
        data = read_bytes(path)
    except OSError as error:
        raise _missing(path, error) from None
    return _decoded_bytes(data, path, mode)


def decode_image(data: bytes, where: str) -> np.ndarray:
    """Decode an image that stands in another file, (H, W, 3) uint8 RGB; raises CaptureError as `read_image`."""
    image = _decoded_bytes(data, where, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH)
    return image if image.dtype == np.uint8 else _in_eight_bits(image, None, where)


def check_image(path: Path) -> None:
    """Refuse an image file that isn't whole, without decoding it; raises CaptureError as `read_image`."""
    try:
        _check_bytes(read_bytes(path), path)
    except OSError as error:
        raise _missing(path, error) from None


def _check_bytes(data: bytes, where: Path | str) -> None:
    header = image_header(io.BytesIO(data))
    if header is None:
        raise _damaged(where, len(data))
    _check_claim(where, header)
    if flaw := image_flaw(header, data):
        raise CaptureError(
            f"{where}: damaged or truncated ({flaw}); copy it again, or put the frame before it in its place"
        )


def _decoded_bytes(data: bytes, where: Path | str, mode: int) -> np.ndarray:
    _check_bytes(data, where)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise _damaged(where, len(data))
    if image.dtype not in (np.uint8, np.uint16):
        raise CaptureError(f"{where}: holds {image.dtype} values; save it with 8 or 16 bits a colour")
    return image


def _in_eight_bits(image: np.ndarray, bits: int | None, path: Path | str) -> np.ndarray:
    """Scale an image of 16 bits, of which `bits` are used."""
    largest = int(image.max())
    bits = bits or bits_for(largest)
    if largest >> bits:
        raise CaptureError(
            f"{path}: its values go up to {largest}, those of the camera's other pictures have {bits} bits; "
            "save all alike"
        )
    full = (1 << bits) - 1
    return ((image.astype(np.uint32) * 255 + full // 2) // full).astype(np.uint8)


def bits_for(largest: int) -> int:
    """Bits of a camera whose largest value this is."""
    return next(b for b in _DEPTHS if largest < 1 << b)


@dataclass(frozen=True)
class ImageFolder:
    """Frames of one camera as numbered image files; those of a short recording are decoded once."""

    files: tuple[Path, ...]
    _kept: KeptFrames = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_kept", KeptFrames(len(self.files)))

    def __reduce__(self) -> tuple[type[ImageFolder], tuple[tuple[Path, ...]]]:
        return ImageFolder, (self.files,)

    def __len__(self) -> int:
        return len(self.files)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the first frame, pixels; all others must have it."""
        return image_size(self.files[0])

    @cached_property
    def bits(self) -> int | None:
        """How many of 16 bits the camera uses, as some frames tell; None if they have eight."""
        spread = np.linspace(0, len(self) - 1, min(_LOOKED_AT, len(self))).astype(int)
        deep = [f for f in (self.files[k] for k in spread) if _is_deep(f)]
        mode = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        return max((bits_for(int(_decoded(f, mode).max())) for f in deep), default=None)

    def read(self, frame: int) -> np.ndarray:
        """Return frame `frame` as (H, W, 3) uint8, RGB."""
        kept = self._kept.get(frame)
        if kept is not None:
            return kept
        image = read_image(self.files[frame], bits=self.bits)
        self.check_size(frame, (image.shape[1], image.shape[0]))
        self._kept.keep(frame, image)
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


def _is_deep(path: Path) -> bool:
    """Whether a file is a PNG of 16 bits; what is wrong with it, reading it says."""
    try:
        with open_plain(path) as file:
            header = image_header(file)
    except OSError:
        return False
    return header is not None and header.bits == 16 and not header.is_too_large


def _check_claim(path: Path | str, header: ImageHeader) -> None:
    if header.is_too_large:
        raise CaptureError(
            f"{path}: claims {header.width}×{header.height} pixels, more than {MOST_PIXELS / 1e6:.0f} million; "
            "it is damaged, or to be made smaller"
        )


def _missing(path: Path, error: OSError) -> CaptureError:
    """Return the error of an image file that can't be opened."""
    return CaptureError(f"{path}: can't be read ({error.strerror or error}); every camera needs every frame")


def _damaged(path: Path | str, length: int) -> CaptureError:
    """Return the error of an image file that holds no whole image."""
    return CaptureError(f"{path}: truncated or no image ({length} bytes); write it again")
