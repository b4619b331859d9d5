"""One file of a scan: the vertices of a mesh with its triangles, the points of a cloud, the centres of voxels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh

from geomocap.errors import GeometryError
from geomocap.files.frame_files import read_voxels
from geomocap.files.geometry_claims import check_faces, check_geometry
from geomocap.files.npz import array_names, read_arrays
from geomocap.files.open3d_geometry import read_by_open3d
from geomocap.files.ragged_arrays import spread_over_frames
from geomocap.reading import open_plain, reason, shortened

MESH_ENDINGS = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
CLOUD_ENDINGS = (".ply", ".pcd", ".xyz", ".pts")
ARRAY_ENDINGS = (".npz", ".npy")
SCAN_ENDINGS = tuple(sorted({*MESH_ENDINGS, *CLOUD_ENDINGS, *ARRAY_ENDINGS}))
_TRACKS = {"positions", "start", "end"}  # what tells `tracks.npz` of a run


@dataclass(frozen=True)
class ScanSurface:
    """What a scan holds.

    Attributes
    ----------
    points : (N, 3) float, scan units
        Vertices of a mesh, points of a cloud, centres of voxels; NaN where one is missing.
    faces : (F, 3) int, optional
        Triangles of a mesh.
    """

    points: np.ndarray
    faces: np.ndarray | None = None

    def scaled(self, scale: float) -> ScanSurface:
        """Return it in other units."""
        return replace(self, points=np.ascontiguousarray(self.points, dtype=np.float64) * scale)


@dataclass(frozen=True)
class Places:
    """Places on a mesh: K of them, each in a triangle.

    Attributes
    ----------
    corners : (K, 3) int
        Vertices of its triangle.
    fractions : (K, 3) float
        Barycentric coordinates.
    """

    corners: np.ndarray
    fractions: np.ndarray

    def of(self, points: np.ndarray) -> np.ndarray:
        """Where they are with the vertices at points (N, 3): (K, 3)."""
        return np.einsum("kc,kci->ki", self.fractions, points[self.corners])


def places_on(mesh: ScanSurface, count: int, seed: int) -> Places:
    """Choose places on a mesh evenly by area: stratified over the triangles in their order, seeded.

    Raises
    ------
    GeometryError
        If it has no area.
    """
    assert mesh.faces is not None
    rng = np.random.default_rng(seed)
    faces = mesh.faces[~np.isnan(mesh.points[mesh.faces]).any(axis=(1, 2))]
    a, b, c = (mesh.points[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not area.sum() > 0:
        raise GeometryError("the mesh has no area; is it whole?")
    steps = (np.arange(count) + rng.random(count)) / count
    face = np.minimum(np.searchsorted(np.cumsum(area) / area.sum(), steps), len(faces) - 1)
    u, v = rng.random((2, count))
    flip = u + v > 1
    u[flip], v[flip] = 1 - u[flip], 1 - v[flip]
    return Places(faces[face], np.stack([1 - u - v, u, v], axis=1))


def read_surface(path: Path) -> ScanSurface:
    """Read a scan.

    Raises
    ------
    GeometryError
        If the file can't be read, or holds neither triangles nor points.
    """
    suffix = path.suffix.lower()
    if suffix in ARRAY_ENDINGS:
        return ScanSurface(read_array(path))
    check_geometry(path)
    if suffix == ".ply" and _is_voxel_grid(path):
        return ScanSurface(read_voxels(path).points)
    try:
        mesh = read_mesh(path) if suffix in MESH_ENDINGS else None
        if mesh is not None:
            return ScanSurface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))
        cloud = read_by_open3d(o3d.io.read_point_cloud, path) if suffix in CLOUD_ENDINGS else None
    except GeometryError:
        raise
    except Exception as error:
        raise GeometryError(f"{path}: can't be read as a scan ({reason(error)})") from None
    if cloud is None or not cloud.has_points():
        raise GeometryError(f"{path}: holds neither triangles nor points; is it whole?")
    return ScanSurface(np.asarray(cloud.points))


def read_mesh(path: Path) -> trimesh.Trimesh | None:
    """Read the triangles of a file, those given several times once; None if it has none.

    Raises
    ------
    GeometryError
        If the file claims more than it holds, can't be read, or has triangles of vertices that aren't there.
    """
    check_geometry(path)
    try:
        with np.errstate(invalid="ignore"):  # of signalling NaN
            mesh = trimesh.load(path, process=False, force="mesh")
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            return None
        if np.shape(mesh.vertices)[1:] != (3,) or np.shape(mesh.faces)[1:] != (3,):
            raise GeometryError(f"{path}: its vertices have {np.shape(mesh.vertices)[1:]} coordinates; make it again")
        check_faces(mesh.faces, len(mesh.vertices), path)
        single = mesh.unique_faces()
        if not single.all():  # thousands in one place would take rays for ever
            mesh.update_faces(single)
        return mesh
    except GeometryError:
        raise
    except Exception as error:
        raise GeometryError(f"{path}: can't be read as a scan ({reason(error)})") from None


def holds_tracks(path: Path) -> bool:
    """Whether a file is `tracks.npz` of a run: positions (N, T, 3) of the same points, with gaps."""
    if path.suffix.lower() != ".npz":
        return False
    try:
        return set(array_names(path)) >= _TRACKS
    except (OSError, ValueError):
        return False  # what is wrong with it, reading it says


def read_array(path: Path) -> np.ndarray:
    """Read points of shape (N, 3) or (T, N, 3) from an NPZ or NPY file, never executing anything in it.

    Of tracks, whose first axis is that of the points, the axes are exchanged.
    """
    try:
        found = read_arrays(path)
        name = next((n for n in ("", "points", "positions", "vertices") if n in found), None)
        if name is None:
            has = shortened(", ".join(found)) or "none"
            raise GeometryError(f"{path}: expected an array `points` of shape (N, 3) or (T, N, 3); it has {has}")
        array = found[name]
        if found.keys() >= _TRACKS:
            if str(found.get("layout", "")) == "ragged":
                array = spread_over_frames(array, found["first"], found["start"], int(found["n_frames"]))
            if array.ndim == 3:
                array = array.swapaxes(0, 1)
    except (OSError, ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError) as error:
        raise GeometryError(f"{path}: can't be read as plain arrays ({reason(error)})") from None
    if array.ndim not in (2, 3) or array.shape[-1] != 3 or array.dtype.kind not in "fiu":
        raise GeometryError(
            f"{path}: expected numbers of shape (N, 3) or (T, N, 3), got {array.dtype} of shape {array.shape}"
        )
    return array.astype(np.float64)


def _is_voxel_grid(path: Path) -> bool:
    with open_plain(path) as file:
        header = file.read(2048)
    return b"element origin" in header or b"voxel_size" in header
