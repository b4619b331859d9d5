"""What the bytes of an image file say of it before it is decoded: its size, its depth, and whether it is whole."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import BinaryIO

from PIL import Image

from geomocap.files.jpeg_blocks import jpeg_flaw

MOST_PIXELS = 1 << 28  # of an image, twice those of the largest camera backs; what claims more is damaged or hostile
_PNG = b"\x89PNG\r\n\x1a\n"
_ORIENTATION = 0x0112  # EXIF tag; from 5 on rows and columns change places
_TURNED = 5


@dataclass(frozen=True)
class ImageHeader:
    """What an image file claims: its format, pixels as they will be read, and bits of a PNG's values (else 0)."""

    kind: str
    width: int
    height: int
    bits: int = 0

    @property
    def is_too_large(self) -> bool:
        """Whether it claims more pixels than any camera has."""
        return self.width * self.height > MOST_PIXELS


def image_header(stream: BinaryIO) -> ImageHeader | None:
    """Read the header of an image file; None if it is none, or none that is known."""
    head = stream.read(26)
    if head[:8] == _PNG:
        if len(head) < 26 or head[12:16] != b"IHDR":
            return None
        return _sized("PNG", int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"), head[24])
    stream.seek(0)
    if head[:2] == b"\xff\xd8":
        return _jpeg_header(stream)
    try:
        with Image.open(stream) as image:
            return _sized(str(image.format), image.width, image.height)
    except Exception:  # whatever its many readers stumble over, it is no image for us
        return None


def image_flaw(header: ImageHeader, data: bytes) -> str:
    """Say what is wrong with the bytes of an image file; empty if nothing is."""
    if header.kind == "PNG":
        return _png_flaw(data)
    return jpeg_flaw(data) if header.kind == "JPEG" else ""


def _sized(kind: str, width: int, height: int, bits: int = 0) -> ImageHeader | None:
    return ImageHeader(kind, width, height, bits) if width > 0 and height > 0 else None


def _jpeg_header(stream: BinaryIO) -> ImageHeader | None:
    """Find the frame header among the markers, and the EXIF orientation."""
    stream.seek(2)
    turned = False
    while True:
        head = stream.read(4)
        while head[:2] == b"\xff\xff":  # fill
            head = head[1:] + stream.read(1)
        if len(head) < 4 or head[0] != 0xFF or head[1] in (0xD9, 0xDA):
            return None
        marker, length = head[1], int.from_bytes(head[2:], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            frame = stream.read(5)
            if len(frame) < 5:
                return None
            height, width = int.from_bytes(frame[1:3], "big"), int.from_bytes(frame[3:5], "big")
            return _sized("JPEG", height, width) if turned else _sized("JPEG", width, height)
        body = stream.read(max(0, length - 2))
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            turned = _is_turned(body)


def _is_turned(exif: bytes) -> bool:
    try:
        found = Image.Exif()
        found.load(exif)
        return int(found.get(_ORIENTATION, 1)) >= _TURNED
    except Exception:  # what a camera wrote there is no reason to refuse its picture
        return False


def _png_flaw(data: bytes) -> str:
    """Compare the checksums of all chunks; the picture ends with one called IEND."""
    view, at = memoryview(data), 8
    while at + 12 <= len(data):
        length = int.from_bytes(view[at : at + 4], "big")
        kind, end = bytes(view[at + 4 : at + 8]), at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            return f"wrong checksum of its part {kind.decode('latin-1')!r} at byte {at:,}"
        if kind == b"IEND":
            return ""
        at = end + 4
    return "data end early"
