"""Voxels under their name of version 0.1.0, which is to go: `geomocap.files.frame_files.read_voxels` has its place."""

from __future__ import annotations

import warnings

from geomocap.files.frame_files import read_voxels
from geomocap.model import frame_geometry

warnings.warn(
    "geomocap.geometry is to go; use geomocap.files.frame_files.read_voxels", DeprecationWarning, stacklevel=2
)

Voxels = type("Voxels", (frame_geometry.Voxels,), {"read": staticmethod(read_voxels)})
"""As `geomocap.model.frame_geometry.Voxels`, with `read(file)`."""
