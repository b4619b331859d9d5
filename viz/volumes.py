"""Meshes of volumes and point sets: voxels as cubes, points as small gems, a smooth skin around all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from geomocap.model.surface import outward_normals, vertex_normals
from viz.shapes import EMPTY, Mesh

_SIDES = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
_CORNERS = np.array(
    [
        [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
        [(0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)],
        [(0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)],
        [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
        [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
        [(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)],
    ]
)


def spacing(points: np.ndarray, tree: cKDTree | None = None) -> float:
    """Return the median distance of points (N, 3), those of the tree if one is given, to their nearest neighbours."""
    if len(points) < 2:
        return 0.01
    tree = tree or cKDTree(points, balanced_tree=False, compact_nodes=False)
    sample = points[:: max(1, len(points) // 1000)]
    return max(float(np.median(tree.query(sample, k=2)[0][:, 1])), 1e-6)


def cubes(indices: np.ndarray, origin: np.ndarray, size: float, colors: np.ndarray) -> Mesh:
    """Return voxels as cubes in colours (N, 3) uint8, RGB; see `black_cubes`."""
    mesh, voxel = black_cubes(indices, origin, size)
    return replace(mesh, colors=colors[voxel] / 255.0)


def black_cubes(indices: np.ndarray, origin: np.ndarray, size: float) -> tuple[Mesh, np.ndarray]:
    """Return voxels as cubes, without the sides that two of them share, and the voxel of each triangle.

    The shading normals lean towards the surface that the voxels together make, so that its shape shows as well.

    Parameters
    ----------
    indices : (N, 3) int
    origin : (3,) float
        Lowest corner of voxel (0, 0, 0), metres.
    size : float
        Edge of a voxel, metres.

    Returns
    -------
    mesh : Mesh
    voxel : (F,) int
    """
    if len(indices) == 0:
        return EMPTY, np.zeros(0, np.int64)
    low = indices.min(axis=0) - 1
    local = indices - low
    filled = np.zeros(local.max(axis=0) + 2, bool)
    filled[tuple(local.T)] = True
    smooth = outward_normals((indices + 0.5) * size)
    vertices, normals, owners = [], [], []
    for side, corners in zip(_SIDES, _CORNERS, strict=True):
        free = ~filled[tuple((local + side).T)]
        vertices.append((indices[free, None] + corners[None]).reshape(-1, 3))
        lean = smooth[free] * np.where(smooth[free] @ side >= 0, 1.0, -1.0)[:, None]
        blend = 0.8 * lean + 0.4 * side
        normals.append(np.repeat(blend / np.linalg.norm(blend, axis=1, keepdims=True), 4, axis=0))
        owners.append(np.repeat(np.flatnonzero(free), 2))
    count = sum(len(v) for v in vertices) // 4
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])], axis=1).reshape(-1, 3)
    positions = np.asarray(origin, float) + np.concatenate(vertices) * size
    black = np.zeros((len(faces), 3))
    return Mesh(positions, faces, np.concatenate(normals), black, outlined=False), np.concatenate(owners)


def gems(points: np.ndarray, colors: np.ndarray, radius: float, normals: np.ndarray | None = None) -> Mesh:
    """Return points (N, 3) as octahedra of `radius` metres, shaded by the surface that they lie on."""
    if len(points) == 0:
        return EMPTY
    if normals is None:
        normals = outward_normals(points) if len(points) > 3 else np.tile([0.0, 0.0, 1.0], (len(points), 1))
    tips = np.concatenate([np.eye(3), -np.eye(3)])
    octants = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)])
    vertices = (points[:, None] + radius * tips[None]).reshape(-1, 3)
    faces = (6 * np.arange(len(points))[:, None, None] + octants[None]).reshape(-1, 3)
    shading = np.repeat(normals, 6, axis=0)
    return Mesh(vertices, faces, shading, np.repeat(colors / 255.0, 8, axis=0), outlined=False)


def skin(points: np.ndarray, colors: np.ndarray, cells: int = 120, smoothing: float = 0.8) -> Mesh:
    """Return a smooth closed surface around points; what they enclose is filled.

    Occupied cells of a grid, filled, blurred, and the level surface of that by surface nets (Gibson 1998).

    Parameters
    ----------
    points : (N, 3) float, metres
    colors : (N, 3) uint8
        RGB; each triangle takes its nearest point's.
    cells : int
        Grid cells along the longest side, at most.
    smoothing : float
        Standard deviation of the blur, cells.
    """
    if len(points) == 0:
        return EMPTY
    low, high = points.min(axis=0), points.max(axis=0)
    tree = cKDTree(points)
    cell = max(float((high - low).max()) / cells, 1.15 * spacing(points, tree), 1e-6)
    pad = 4
    index = np.floor((points - low) / cell).astype(int) + pad
    occupied = np.zeros(index.max(axis=0) + pad + 1, bool)
    occupied[tuple(index.T)] = True
    box = np.ones((3, 3, 3), bool)
    components, _ = ndimage.label(~ndimage.binary_dilation(occupied, box))  # pin holes may not empty a body
    filled = ndimage.binary_erosion(components != components[0, 0, 0], box) | occupied
    field = ndimage.gaussian_filter(filled.astype(np.float32), smoothing, truncate=3)
    vertices, faces = surface_nets(field, 0.25)
    vertices = low + (vertices - pad + 0.5) * cell
    centers = vertices[faces].mean(axis=1)
    nearest = tree.query(centers)[1]
    return Mesh(vertices, faces, vertex_normals(vertices, faces), colors[nearest] / 255.0)


def surface_nets(field: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the level surface of a field as vertices (V, 3), in grid coordinates, and triangles (F, 3) facing down it.

    One vertex for each cell that the surface crosses, at the mean of the crossings of the cell's edges; one quad for
    each grid edge that it crosses (Gibson 1998, Constrained Elastic Surface Nets). The surface must stay off the
    border of the field.
    """
    inside = field > level
    shape = np.array(field.shape) - 1
    count = np.zeros(tuple(shape), np.uint8)
    offsets = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    for i, j, k in offsets:
        count += inside[i : i + shape[0], j : j + shape[1], k : k + shape[2]]
    active = np.argwhere((count > 0) & (count < 8))
    number = np.full(tuple(shape), -1, np.int64)
    number[tuple(active.T)] = np.arange(len(active))
    total, crossings = np.zeros((len(active), 3)), np.zeros(len(active))
    quads = []
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        for du in (0, 1):
            for dv in (0, 1):
                start = active + du * u + dv * v
                a, b = field[tuple(start.T)] - level, field[tuple((start + step).T)] - level
                cross = (a > 0) != (b > 0)
                fraction = a[cross] / (a[cross] - b[cross])
                total[cross] += start[cross] + fraction[:, None] * step
                crossings[cross] += 1
        here = inside[tuple(active.T)] != inside[tuple((active + step).T)]
        edge = active[here]
        out = inside[tuple(edge.T)]
        ring = np.stack([number[tuple((edge - d).T)] for d in (0 * u, u, u + v, v)], axis=1)
        quads.append(np.where(out[:, None], ring, ring[:, ::-1]))
    q = np.concatenate(quads)
    q = q[(q >= 0).all(axis=1)]
    return total / crossings[:, None], np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]])
