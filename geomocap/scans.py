"""Anybody's geometry as a sequence of point sets: meshes, point clouds, voxel grids, arrays.

A folder is a sequence in the order of its file names (numbers by value), one file is one scan, and an NPZ file may hold
a whole sequence.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import open3d as o3d
import trimesh
from pydantic import Field
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError
from geomocap.files import fingerprint
from geomocap.geometry import Voxels
from geomocap.settings import Settings

MESH_ENDINGS = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
CLOUD_ENDINGS = (".ply", ".pcd", ".xyz", ".pts")
ARRAY_ENDINGS = (".npz", ".npy")


class ScanSettings(Settings):
    """How scans become point sets."""

    samples: int = Field(20000, ge=16, description="points sampled on each mesh's surface (points)")
    spacing: float | None = Field(
        None, gt=0, description="distance of neighbouring points (scan units); measured on the first scan if not given"
    )
    scale: float = Field(1.0, gt=0, description="metres per unit of the scans, 0.001 for millimetres")
    up: Literal["x", "y", "z"] = Field("z", description="axis of the scans that points up; y in glTF files")
    seed: int = Field(0, ge=0, description="seed of the surface sampling")


@dataclass(frozen=True)
class Scans:
    """A sequence of scans, read one at a time.

    Attributes
    ----------
    source : Path
        The file or folder.
    names : tuple of str
        What each frame came from.
    read : callable
        `read(frame) -> (N, 3) float`, metres.
    settings : ScanSettings
    """

    source: Path
    names: tuple[str, ...]
    read: Callable[[int], np.ndarray]
    settings: ScanSettings

    features = None

    def __len__(self) -> int:
        return len(self.names)

    def points(self, frame: int) -> np.ndarray:
        """Return the points of one frame, (N, 3) float, metres.

        Raises
        ------
        GeometryError
            If the scan can't be read, is empty, or holds coordinates that are not finite.
        """
        points = np.ascontiguousarray(self.read(frame), dtype=np.float64) * self.settings.scale
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise GeometryError(f"{self.names[frame]}: expected points of shape (N, 3), got {points.shape}")
        if not np.isfinite(points).all():
            bad = int((~np.isfinite(points)).any(axis=1).sum())
            raise GeometryError(f"{self.names[frame]}: {bad} points are not finite; remove them")
        return points

    @cached_property
    def spacing(self) -> float:
        """Distance of neighbouring points, metres: as set, or the first scan's mean distance to the nearest one."""
        if self.settings.spacing is not None:
            return self.settings.spacing * self.settings.scale
        return point_spacing(self.points(0))

    def fingerprint(self) -> str:
        """Digest of the files' names, sizes and times."""
        return fingerprint([self.source])


def point_spacing(points: np.ndarray) -> float:
    """Mean distance of points (N, 3) to their nearest neighbour, coincident points apart; units of the points."""
    if len(points) < 2:
        raise GeometryError("a scan of a single point has no spacing; set scans.spacing")
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    distance = distance[distance > 0]
    if not len(distance):
        raise GeometryError("all points of the scan coincide; is the file right?")
    return float(distance.mean())


def open_scans(source: Path, settings: ScanSettings) -> Scans:
    """Open a file or a folder of scans; nothing but names is read yet.

    Raises
    ------
    GeometryError
        If there is nothing that can be read.
    """
    source = Path(source)
    if source.is_dir():
        known = (*MESH_ENDINGS, *CLOUD_ENDINGS, *ARRAY_ENDINGS)
        files = sorted((p for p in source.iterdir() if p.suffix.lower() in known), key=_by_number)
        if not files:
            raise GeometryError(f"{source}: holds no scans ({', '.join(sorted({e[1:] for e in known}))})")
        return Scans(source, tuple(str(f) for f in files), lambda k: read_points(files[k], settings), settings)
    if not source.is_file():
        raise GeometryError(f"{source}: no such file or folder of scans")
    if source.suffix.lower() in ARRAY_ENDINGS:
        array = _read_array(source)
        frames = array if array.ndim == 3 else array[None]
        names = tuple(f"{source}, frame {k}" for k in range(len(frames)))
        return Scans(source, names, lambda k: frames[k][np.isfinite(frames[k]).all(axis=1)], settings)
    return Scans(source, (str(source),), lambda _: read_points(source, settings), settings)


def read_points(path: Path, settings: ScanSettings) -> np.ndarray:
    """Read a scan as points (N, 3): vertices of clouds, centres of voxels, samples of a mesh's surface."""
    suffix = path.suffix.lower()
    if suffix in ARRAY_ENDINGS:
        return _read_array(path)
    if suffix == ".ply" and _is_voxel_grid(path):
        return Voxels.read(path).points
    try:
        if suffix in MESH_ENDINGS:
            mesh = trimesh.load(path, process=False, force="mesh")
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                return _sample(mesh, settings)
        cloud = o3d.io.read_point_cloud(path) if suffix in CLOUD_ENDINGS else None
    except Exception as error:
        raise GeometryError(f"{path}: can't be read as a scan ({str(error).splitlines()[0]})") from None
    if cloud is None or not cloud.has_points():
        raise GeometryError(f"{path}: holds neither triangles nor points; is it whole?")
    return np.asarray(cloud.points)


def _sample(mesh: trimesh.Trimesh, settings: ScanSettings) -> np.ndarray:
    """Sample a surface evenly by area: stratified over the triangles in their order, seeded."""
    rng = np.random.default_rng(settings.seed)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not area.sum() > 0:
        raise GeometryError("the mesh has no area; is it whole?")
    steps = (np.arange(settings.samples) + rng.random(settings.samples)) / settings.samples
    face = np.minimum(np.searchsorted(np.cumsum(area) / area.sum(), steps), len(faces) - 1)
    u, v = rng.random((2, settings.samples))
    flip = u + v > 1
    u[flip], v[flip] = 1 - u[flip], 1 - v[flip]
    return a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]


def _read_array(path: Path) -> np.ndarray:
    try:
        data = np.load(path, allow_pickle=False)
        if isinstance(data, np.ndarray):
            array = data
        else:
            with data:
                name = next((n for n in ("points", "positions", "vertices") if n in data.files), None)
                if name is None:
                    raise GeometryError(
                        f"{path}: expected an array `points` of shape (N, 3) or (T, N, 3); "
                        f"it has {', '.join(data.files)}"
                    )
                array = data[name]
    except (OSError, ValueError, EOFError) as error:
        raise GeometryError(f"{path}: can't be read as plain arrays ({error})") from None
    if array.ndim not in (2, 3) or array.shape[-1] != 3 or array.dtype.kind not in "fiu":
        raise GeometryError(
            f"{path}: expected numbers of shape (N, 3) or (T, N, 3), got {array.dtype} of shape {array.shape}"
        )
    return array.astype(np.float64)


def _is_voxel_grid(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.read(2048)
    return b"element origin" in header or b"voxel_size" in header


def _by_number(path: Path) -> list[tuple[int, int, str]]:
    """Sort key under which frame10 comes after frame9."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts]
