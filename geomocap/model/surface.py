"""A closed surface through the points of one frame, and normals of points and meshes.

The surface is Open3D's screened Poisson reconstruction (Kazhdan & Hoppe 2013), trimmed where there are no points. Its
resolution is halved until it has few enough triangles: they stay even, where simplification would leave long ones that
bend badly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numba import njit
from scipy import ndimage
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError

FEWEST_POINTS = 50
MOST_CELLS = 40_000_000  # of the grid in which a shell is filled
NEIGHBOURS = 16  # points that make a normal
SHEET = 0.05  # fall a cell of a smoothed shell below which it tells no side; 0.27 at the surface of a solid
COARSEST, FINEST = 4, 8  # depths of the octree
FOURFOLD, SURELY = 6, 2  # from this depth on there are four times the triangles in the next one, at least twice
TRIM = 3.0  # spacings or cells from the nearest point beyond which surface is invented
SMALLEST_PART = 0.01  # fraction of the triangles; smaller parts are dirt


@dataclass(frozen=True)
class Surface:
    """A triangle mesh.

    Attributes
    ----------
    vertices : (V, 3) float, metres, world
    normals : (V, 3) float, unit, outwards
    triangles : (F, 3) int
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray


def surface_through(points: np.ndarray, normals: np.ndarray | None = None, max_triangles: int = 50000) -> Surface:
    """Mesh the surface that points lie on.

    Parameters
    ----------
    points : (N, 3) float, metres, world
    normals : (N, 3) float, optional
        Outward; found from the shell that the points make if not given.
    max_triangles : int

    Raises
    ------
    GeometryError
        If there are too few points for a surface.
    """
    points = np.asarray(points, float)
    if len(points) < FEWEST_POINTS:
        raise GeometryError(f"{len(points)} points are too few for a surface; choose another reference frame")
    spacing = point_spacing(points)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(outward_normals(points) if normals is None else normals)
    diagonal = float(np.ptp(points, axis=0).max())
    finest = int(np.clip(np.ceil(np.log2(1.1 * diagonal / spacing)), COARSEST, FINEST))

    def at(depth: int) -> o3d.geometry.TriangleMesh:
        return _trimmed_poisson(cloud, points, depth, TRIM * max(spacing, diagonal / 2**depth))

    # The finest that has few enough; it takes longest, so it is made last, and not where it has too many for sure
    depth = max(COARSEST, finest - 1)
    mesh = at(depth)
    if len(mesh.triangles) > max_triangles:
        while len(mesh.triangles) > max_triangles and depth > COARSEST:
            depth -= 1
            mesh = at(depth)
    elif depth < finest and (depth < FOURFOLD or SURELY * len(mesh.triangles) <= max_triangles):
        finer = at(finest)
        mesh = finer if len(finer.triangles) <= max_triangles else mesh
    if len(mesh.triangles) == 0:
        raise GeometryError("no surface could be laid through the points; choose another reference frame")
    mesh.compute_vertex_normals()
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals), np.asarray(mesh.triangles))


def _trimmed_poisson(
    cloud: o3d.geometry.PointCloud, points: np.ndarray, depth: int, far: float
) -> o3d.geometry.TriangleMesh:
    """Poisson surface without what lies farther than `far` from the points, and without dirt."""
    # One thread: the sums of several come in another order each time.
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    mesh.remove_vertices_by_mask(cKDTree(points).query(np.asarray(mesh.vertices))[0] > far)
    part, sizes, _ = (np.asarray(x) for x in mesh.cluster_connected_triangles())
    mesh.remove_triangles_by_mask(sizes[part] < SMALLEST_PART * len(part))
    mesh.remove_degenerate_triangles()
    mesh.remove_unreferenced_vertices()
    return mesh


def point_spacing(points: np.ndarray, average: Callable[[np.ndarray], Any] = np.median) -> float:
    """Average distance of points (N, 3) to their nearest neighbours, coincident ones apart; units of the points.

    Raises
    ------
    GeometryError
        If there is a single point, or all coincide.
    """
    if len(points) < 2:
        raise GeometryError("a single point has no spacing; set scans.spacing")
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    distance = distance[distance > 0]
    if not len(distance):
        raise GeometryError("all points coincide; is the file right?")
    return float(average(distance))


def plane_normals(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Unit normals (M, 3) of the planes nearest to some of N points each, of either sign.

    Parameters
    ----------
    points : (N, 3) float, metres
    near : (M, k) int
        Points of each plane.
    """
    return np.linalg.eigh(_scatter(np.ascontiguousarray(points, float), near))[1][:, :, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _scatter(points, near):
    """Sums (M, 3, 3) of the squared distances from their middle, by direction, of some of N points (N, 3) each.

    Parameters
    ----------
    points : (N, 3) float64
    near : (M, k) int64
        Points of each sum.
    """
    count, k = near.shape
    result = np.empty((count, 3, 3))
    for m in range(count):
        x = y = z = 0.0
        for i in range(k):
            x += points[near[m, i], 0]
            y += points[near[m, i], 1]
            z += points[near[m, i], 2]
        x, y, z = x / k, y / k, z / k
        xx = xy = xz = yy = yz = zz = 0.0
        for i in range(k):
            a, b, c = points[near[m, i], 0] - x, points[near[m, i], 1] - y, points[near[m, i], 2] - z
            xx += a * a
            xy += a * b
            xz += a * c
            yy += b * b
            yz += b * c
            zz += c * c
        result[m, 0, 0], result[m, 1, 1], result[m, 2, 2] = xx, yy, zz
        result[m, 0, 1] = result[m, 1, 0] = xy
        result[m, 0, 2] = result[m, 2, 0] = xz
        result[m, 1, 2] = result[m, 2, 1] = yz
    return result


def outward_normals(points: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
    """Outward unit normals, (M, 3), at points of a surface: across the plane of the nearest ones, out of the shell.

    A filled shell tells the side without doubt, but its slope follows the surface coarsely; planes are the other way
    round (Hoppe et al. 1992, section 3.2).

    Parameters
    ----------
    points : (N, 3) float, metres
        Of a closed surface; where it is open they point away from the middle of all.
    at : (M,) int, optional
        Points whose normals are wanted; all if not given.
    """
    at = np.arange(len(points)) if at is None else at
    near = cKDTree(points).query(points[at], min(NEIGHBOURS + 1, len(points)))[1].reshape(len(at), -1)
    normals = plane_normals(points, near)
    reach = float(np.median(np.linalg.norm(points[near[:, -1]] - points[at], axis=1)))
    inwards = (normals * _out_of_shell(points, max(reach, 1e-9))[at]).sum(axis=1) < 0
    return np.where(inwards[:, None], -normals, normals)


def _out_of_shell(points: np.ndarray, cell: float) -> np.ndarray:
    """Directions (N, 3) out of the shell that points make: how the filled and smoothed shell falls off.

    Where it hardly does, as in the middle of a sheet, the direction from the centroid stands in.
    """
    low = points.min(axis=0) - 4.5 * cell
    size = np.ceil((points.max(axis=0) - low) / cell).astype(int) + 5
    if np.prod(size.astype(float)) > MOST_CELLS:
        cell *= float((np.prod(size.astype(float)) / MOST_CELLS) ** (1 / 3))
        size = np.ceil((points.max(axis=0) - low) / cell).astype(int) + 5
    shell = np.zeros(size, bool)
    shell[tuple(np.floor((points - low) / cell).astype(int).T)] = True
    # Closing bridges single cells that hold no point by chance
    solid = ndimage.binary_fill_holes(ndimage.binary_closing(shell, iterations=1) | shell)
    smooth = ndimage.gaussian_filter(solid.astype(np.float32), 1.5)
    place = ((points - low) / cell - 0.5).T
    outwards = -np.stack([ndimage.map_coordinates(g, place, order=1) for g in np.gradient(smooth)], axis=1)
    steep = np.linalg.norm(outwards, axis=1) > SHEET
    return np.where(steep[:, None], outwards, points - points.mean(axis=0))


def vertex_normals(vertices: np.ndarray, faces: np.ndarray, groups: np.ndarray | None = None) -> np.ndarray:
    """Unit normals at the vertices of a mesh, (V, 3), those of their triangles weighted by area.

    Parameters
    ----------
    vertices, faces : (V, 3) float, (F, 3) int
    groups : (V,) int, optional
        Vertices of one group share a normal.
    """
    groups = np.arange(len(vertices)) if groups is None else groups
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    each = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    number = groups[faces].ravel()
    total = np.column_stack([np.bincount(number, each[:, k], int(groups.max(initial=-1)) + 1) for k in range(3)])
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30))[groups]
