"""Cameras under their name of version 0.1.0, which is to go: `geomocap.open_capture(PATH).rig` has its place."""

from __future__ import annotations

import warnings

from geomocap.files.rigs import read_rig
from geomocap.model import rig

warnings.warn(
    "geomocap.cameras is to go; use geomocap.open_capture(PATH).rig or geomocap.files.rigs.read_rig",
    DeprecationWarning,
    stacklevel=2,
)

Rig = type("Rig", (rig.Rig,), {"read": staticmethod(read_rig)})
"""As `geomocap.model.rig.Rig`, with `read(folder)`."""
