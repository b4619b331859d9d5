"""Triangle meshes as binary STL."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomocap.files.atomic import write_bytes

RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Write a mesh, whole or not at all.

    Parameters
    ----------
    path : Path
    vertices : (V, 3) float
    triangles : (F, 3) int
    """
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    records = np.zeros(len(triangles), RECORD)
    records["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    records["corners"] = corners
    head = b"geomocap".ljust(80) + np.uint32(len(triangles)).tobytes()
    write_bytes(path, head + records.tobytes())
