"""A closed surface through the points of one frame.

Surface voxels have no normals: their shell is filled, smoothed, and its gradient taken. The surface is Open3D's
screened Poisson reconstruction (Kazhdan & Hoppe 2013), trimmed where there are no points. Its resolution is halved
until it has few enough triangles: they stay even, where simplification would leave long ones that bend badly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from scipy import ndimage
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError

FEWEST_POINTS = 50
MOST_CELLS = 40_000_000  # of the grid in which a shell is filled
COARSEST, FINEST = 4, 8  # depths of the octree
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
    cloud.normals = o3d.utility.Vector3dVector(shell_normals(points, spacing) if normals is None else normals)
    diagonal = float(np.ptp(points, axis=0).max())
    finest = int(np.clip(np.ceil(np.log2(1.1 * diagonal / spacing)), COARSEST, FINEST))
    for depth in range(finest, COARSEST - 1, -1):
        mesh = _trimmed_poisson(cloud, points, depth, TRIM * max(spacing, diagonal / 2**depth))
        if len(mesh.triangles) <= max_triangles:
            break
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


def point_spacing(points: np.ndarray) -> float:
    """Median distance of the points, (N, 3), to their nearest neighbours, metres."""
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    positive = distance[distance > 0]
    if len(positive) == 0:
        raise GeometryError("all points lie in one place; there is no surface")
    return float(np.median(positive))


def shell_normals(points: np.ndarray, spacing: float) -> np.ndarray:
    """Outward normals, (N, 3), of points that make a closed shell, from the gradient of the filled and smoothed shell.

    Where the gradient vanishes (leaves without a thickness) the direction from the centroid stands in.
    """
    low = points.min(axis=0) - 4.5 * spacing  # points of a grid lie in the middles of the cells
    size = np.ceil((points.max(axis=0) - low) / spacing).astype(int) + 5
    if np.prod(size.astype(float)) > MOST_CELLS:
        spacing *= float((np.prod(size.astype(float)) / MOST_CELLS) ** (1 / 3))
        size = np.ceil((points.max(axis=0) - low) / spacing).astype(int) + 5
    shell = np.zeros(size, bool)
    cell = np.floor((points - low) / spacing).astype(int)
    shell[tuple(cell.T)] = True
    # Closing bridges single cells that the points' own grid left out of phase with this one.
    solid = ndimage.binary_fill_holes(ndimage.binary_closing(shell, iterations=1) | shell)
    smooth = ndimage.gaussian_filter(solid.astype(np.float32), 1.5)
    place = ((points - low) / spacing - 0.5).T
    gradient = [ndimage.map_coordinates(g, place, order=1) for g in np.gradient(smooth)]
    normals = -np.stack(gradient, axis=1).astype(float)
    length = np.linalg.norm(normals, axis=1)
    outwards = points - points.mean(axis=0)
    normals = np.where((length > 1e-6)[:, None], normals, outwards)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
