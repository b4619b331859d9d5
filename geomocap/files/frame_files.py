"""The geometry of a frame in a PLY file: voxels, points with colours, points with their bodies."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import open3d as o3d

from geomocap.errors import GeometryError
from geomocap.files.array_schema import quiet_nan
from geomocap.files.atomic import write_atomic, write_bytes
from geomocap.files.geometry_claims import check_geometry
from geomocap.files.open3d_geometry import check_ply, read_by_open3d, write_by_open3d
from geomocap.files.whole_files import is_whole_ply
from geomocap.model.frame_geometry import BodyPoints, Voxels
from geomocap.model.palette import body_colors
from geomocap.reading import open_plain, read_bytes


def write_voxels(path: Path, voxels: Voxels) -> None:
    """Write voxels as the PLY of an Open3D voxel grid, whole or not at all."""
    write_bytes(path, _voxel_file(voxels), lasting=False)


def read_voxels(path: Path) -> Voxels:
    """Read a voxel grid's PLY.

    Raises
    ------
    GeometryError
        If the file is missing or holds no voxels.
    """
    if not path.is_file():
        raise GeometryError(f"{path}: no such voxel grid")
    check_ply(path)
    voxels = _read_binary(path)
    if voxels is not None:
        return Voxels.sorted(*voxels)
    grid = read_by_open3d(o3d.io.read_voxel_grid, path)
    size_is_known = bool(np.isfinite(grid.voxel_size) and grid.voxel_size > 0 and np.isfinite(grid.origin).all())
    if not grid.has_voxels() or not size_is_known:
        raise GeometryError(f"{path}: no readable voxel grid; make it again")
    return Voxels.from_open3d(grid)


def write_points(path: Path, points: BodyPoints | o3d.t.geometry.PointCloud) -> None:
    """Write points with their bodies, or any tensor point cloud, as PLY, whole or not at all."""
    if isinstance(points, BodyPoints) and len(points.positions):
        write_bytes(path, _body_file(points), lasting=False)
        return
    cloud = points.to_open3d() if isinstance(points, BodyPoints) else points
    size = sum(tensor.numpy().nbytes for _, tensor in cloud.point.items())
    write_atomic(path, write_by_open3d(o3d.t.io.write_point_cloud, cloud, size), is_whole_ply, lasting=False)


_BODY_HEADER = """ply
format binary_little_endian 1.0
comment Created by Open3D
element vertex {}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property int body
end_header
"""
_BODY_POINT = np.dtype([("position", "<f4", 3), ("color", "u1", 3), ("body", "<i4")])


def _body_file(points: BodyPoints) -> bytes:
    """Return what Open3D writes of `points.to_open3d()`, which takes it ten times as long."""
    rows = np.empty(len(points.positions), _BODY_POINT)
    rows["position"], rows["color"], rows["body"] = points.positions, body_colors(points.body), points.body
    return _BODY_HEADER.format(len(rows)).encode() + rows.tobytes()


def read_points(path: Path) -> BodyPoints:
    """Read points in the file's order, with bodies (-1 where it says none), colours and normals as far as it has them.

    Raises
    ------
    GeometryError
        If the file is missing, isn't whole, or holds no points.
    """
    if not path.is_file():
        raise GeometryError(f"{path}: no such point cloud")
    check_geometry(path)
    cloud = read_by_open3d(o3d.t.io.read_point_cloud, path)
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise GeometryError(f"{path}: no readable points; delete it and run again")
    positions = quiet_nan(cloud.point.positions.numpy()).astype(np.float64)
    body, colors, normals = np.full(len(positions), -1), None, None
    if "body" in cloud.point:
        body = np.nan_to_num(cloud.point["body"].numpy().ravel(), nan=-1, posinf=-1, neginf=-1).astype(int)
    if "colors" in cloud.point:
        colors = cloud.point.colors.numpy()
        colors = (
            colors if colors.dtype == np.uint8 else np.rint(np.clip(np.nan_to_num(colors), 0, 1) * 255).astype(np.uint8)
        )
    if "normals" in cloud.point:
        normals = quiet_nan(cloud.point.normals.numpy()).astype(np.float64)
    return BodyPoints(positions, body, colors, normals)


def ply_count(path: Path) -> int:
    """Return the number of vertices that a PLY file announces, without reading them; 0 if it announces none."""
    with open_plain(path) as file:
        match = re.search(rb"^element vertex (\d{1,15})\s*$", file.read(4096), re.MULTILINE)
    return int(match[1]) if match else 0


_VOXEL_HEADER = b"""ply
format binary_little_endian 1.0
comment Created by Open3D
element origin 1
property double x
property double y
property double z
element rotation 1
"""
_VOXEL_PROPERTIES = """property double r00
property double r01
property double r02
property double r10
property double r11
property double r12
property double r20
property double r21
property double r22
element voxel_size 1
property double val
element vertex {}
property double x
property double y
property double z
property uchar red
property uchar green
property uchar blue
end_header
"""
_VOXEL = np.dtype([("index", "<f8", 3), ("color", "u1", 3)])


def _voxel_file(voxels: Voxels) -> bytes:
    """Return what Open3D writes of `voxels.to_open3d()`, sorted, in a twenty-fifth of the time."""
    rows = np.empty(len(voxels.indices), _VOXEL)
    rows["index"], rows["color"] = voxels.indices, voxels.colors
    frame = np.array([*voxels.origin, *np.eye(3).ravel(), voxels.voxel_size], "<f8")
    header = _VOXEL_HEADER + _VOXEL_PROPERTIES.format(len(rows)).encode()
    return header + frame.tobytes() + rows.tobytes()


def _read_binary(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, float] | None:
    """Read a voxel grid as Open3D writes it, a hundred times faster than voxel by voxel; None if it is another kind."""
    data = read_bytes(path)
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    vertex = [line for line in lines if line.startswith("element vertex ")]
    properties = [line for line in lines[lines.index(vertex[0]) + 1 :]] if vertex else []
    if not data.startswith(_VOXEL_HEADER) or properties != [
        "property double x",
        "property double y",
        "property double z",
        "property uchar red",
        "property uchar green",
        "property uchar blue",
    ]:
        return None
    count = int(vertex[0].split()[-1])
    frame = np.frombuffer(body, "<f8", 13)  # origin, rotation, voxel size
    if len(body) != 13 * 8 + count * _VOXEL.itemsize or not np.array_equal(frame[3:12].reshape(3, 3), np.eye(3)):
        return None
    voxels = np.frombuffer(body, _VOXEL, count, 13 * 8)
    index, place = voxels["index"], frame[[0, 1, 2, 12]]
    if not (np.isfinite(place).all() and place[3] > 0 and (np.abs(index) < 1 << 30).all()):
        raise GeometryError(f"{path}: its voxels are at no places that can be; make it again")
    return voxels["index"].astype(np.int32), np.array(voxels["color"]), np.array(frame[:3]), float(frame[12])
