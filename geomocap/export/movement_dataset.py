"""Poses as the package movement holds them: an xarray dataset in netCDF, world axes, metres.

Dimensions time (seconds), space (x, y, z), keypoints, individuals; variables `position` and `confidence`. Joints and
key-points are its keypoints. Needs the package `xarray`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomocap.export.export_errors import require
from geomocap.export.markers import Markers
from geomocap.files.atomic import write_atomic
from geomocap.version import __version__


def write_movement(path: Path, markers: Markers) -> None:
    """Write markers as a dataset of movement, whole or not at all.

    Parameters
    ----------
    path : Path
    markers : Markers
        Confidence isn't known: it is NaN.

    Raises
    ------
    MissingPackageError
        If xarray isn't installed.
    """
    xarray = require("xarray", extra="movement", purpose="Datasets for movement")
    positions = markers.positions.swapaxes(1, 2)[..., None]
    dataset = xarray.Dataset(
        {
            "position": (("time", "space", "keypoints", "individuals"), positions),
            "confidence": (("time", "keypoints", "individuals"), np.full((*markers.positions.shape[:2], 1), np.nan)),
        },
        coords={
            "time": np.arange(markers.n_frames) / markers.fps,
            "space": list("xyz"),
            "keypoints": list(markers.names),
            "individuals": ["subject"],
        },
        attrs={
            "ds_type": "poses",
            "fps": markers.fps,
            "time_unit": "seconds",
            "length_unit": "metres",
            "up": markers.up,
            "source_software": f"geomocap {__version__}",
        },
    )
    write_atomic(path, lambda p: dataset.to_netcdf(p, engine="scipy"))
