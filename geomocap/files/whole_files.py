"""Whether a file that a library wrote is whole, told by its size: for libraries that don't say when a disk is full."""

from __future__ import annotations

from pathlib import Path

from geomocap.errors import GeometryError
from geomocap.files.open3d_geometry import check_ply


def is_whole_ply(path: Path) -> bool:
    """Whether a PLY holds all that its header announces."""
    try:
        check_ply(path)
    except GeometryError:
        return False
    return True


def is_whole_mp4(path: Path) -> bool:
    """Whether the boxes of an MP4 fill the file, with its index and its pictures among them (ISO/IEC 14496-12, 4.2)."""
    length, at, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while at + 8 <= length:
            file.seek(at)
            head = file.read(16)
            size = int.from_bytes(head[:4], "big")
            if size == 1:  # as 64 bits after the kind
                size = int.from_bytes(head[8:16], "big")
            if size < 8:
                return False
            kinds.add(head[4:8])
            at += size
    return at == length and {b"moov", b"mdat"} <= kinds
