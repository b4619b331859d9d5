"""What image files say of themselves without being decoded: their size, and whether they are whole."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from geomocap.errors import CaptureError

ORIENTATION = 0x0112  # EXIF tag; from 5 on rows and columns change places


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
            if is_whole(head, file.read()):
                with Image.open(file) as image:
                    turned = "exif" in image.info and image.getexif().get(ORIENTATION, 1) >= 5
                    return (image.height, image.width) if turned else (image.width, image.height)
    except Image.UnidentifiedImageError:
        pass
    except OSError as error:
        raise missing(path, error) from None
    raise damaged(path, length)


def is_whole(head: bytes, tail: bytes) -> bool:
    """Whether an image file that begins and ends like this has its end: 8 bytes and 4096 tell."""
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return b"IEND" in tail[-64:]
    if head[:2] == b"\xff\xd8":
        return b"\xff\xd9" in tail[-4096:]
    return len(head) > 0


def missing(path: Path, error: OSError) -> CaptureError:
    """Return the error of an image file that can't be opened."""
    return CaptureError(f"{path}: can't be read ({error.strerror}); every camera needs every frame")


def damaged(path: Path, length: int) -> CaptureError:
    """Return the error of an image file that holds no whole image."""
    return CaptureError(f"{path}: truncated or no image ({length} bytes); write it again")
