"""Meshes to look at: balls, ellipsoids, bones, tubes, camera frusta."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from geomocap.model.rig import Rig

Color = Sequence[float]
"""RGB 0–255."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with smooth normals, a colour for each, and what light does to them.

    Attributes
    ----------
    vertices : (V, 3) float, metres, world
    faces : (F, 3) int
    normals : (V, 3) float, unit, world
    colors : (F, 3) float, RGB 0–1
    alpha : float
        1 is opaque; below, what is behind shines through.
    rim : float
        Opacity added where the surface is seen edge on (translucent meshes only): gives a glassy outline.
    outlined : bool
        Whether opaque meshes get a fine dark line where they end or the colour changes.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    alpha: float = 1.0
    rim: float = 0.0
    outlined: bool = True

    def translucent(self, alpha: float, rim: float = 0.25) -> Mesh:
        """Return the same mesh, translucent."""
        return replace(self, alpha=alpha, rim=rim)

    def recolored(self, color: Color) -> Mesh:
        """Return the same mesh in one colour, RGB 0–255."""
        return replace(self, colors=np.tile(np.asarray(color, float) / 255, (len(self.faces), 1)))


EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of several that share the first one's opacity."""
    meshes = [m for m in meshes if len(m.faces)]
    if not meshes:
        return EMPTY
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return replace(
        meshes[0],
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]),
        normals=np.concatenate([m.normals for m in meshes]),
        colors=np.concatenate([m.colors for m in meshes]),
    )


def _mesh(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, color: Color) -> Mesh:
    return Mesh(vertices, faces, normals, np.tile(np.asarray(color, float) / 255, (len(faces), 1)))


@cache
def _unit_sphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    """Icosahedron with each face divided into level², on the unit sphere."""
    g = (1 + 5**0.5) / 2
    corners = np.array([(s, t * g, 0) for s in (-1, 1) for t in (-1, 1)], float)
    corners = np.concatenate([corners, np.roll(corners, 1, axis=1), np.roll(corners, 2, axis=1)])
    edge = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    near = np.isclose(edge, 2.0)
    triples = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    vertices: list[np.ndarray] = []
    faces: list[tuple[int, int, int]] = []
    for i, j, k in triples:
        a, b, c = corners[[i, j, k]]
        if np.dot(np.cross(b - a, c - a), a) < 0:
            b, c = c, b
        index = {}
        for u in range(level + 1):
            for v in range(level + 1 - u):
                index[u, v] = len(vertices)
                vertices.append(a + (b - a) * u / level + (c - a) * v / level)
        for u in range(level):
            for v in range(level - u):
                faces.append((index[u, v], index[u + 1, v], index[u, v + 1]))
                if u + v < level - 1:
                    faces.append((index[u + 1, v], index[u + 1, v + 1], index[u, v + 1]))
    points = np.array(vertices)
    return points / np.linalg.norm(points, axis=1, keepdims=True), np.array(faces)


def ball(center: np.ndarray, radius: float, color: Color, level: int = 4) -> Mesh:
    """Return a ball: centre (3,) and radius in metres."""
    unit, faces = _unit_sphere(level)
    return _mesh(np.asarray(center) + radius * unit, faces, unit, color)


def ellipsoid(center: np.ndarray, radii: np.ndarray, rotation: np.ndarray, color: Color, level: int = 5) -> Mesh:
    """Return an ellipsoid whose axes are the columns of `rotation` (3, 3), with `radii` (3,), metres."""
    unit, faces = _unit_sphere(level)
    radii = np.maximum(radii, 1e-6)
    normals = (unit / radii) @ np.asarray(rotation).T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if np.linalg.det(rotation) < 0:
        faces = faces[:, ::-1]
    return _mesh(np.asarray(center) + (unit * radii) @ np.asarray(rotation).T, faces, normals, color)


def _frames_along(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit normals of a polyline at each of its points, without needless twist."""
    tangents = np.gradient(path, axis=0)
    length = np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents = np.where(length > 1e-12, tangents / np.maximum(length, 1e-12), np.eye(3)[2])
    first = np.empty_like(tangents)
    side = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    for i, t in enumerate(tangents):
        side = side - t * (side @ t)
        norm = np.linalg.norm(side)
        side = side / norm if norm > 1e-9 else np.cross(t, np.eye(3)[np.argmin(np.abs(t))])
        side = side / np.linalg.norm(side)
        first[i] = side
    return first, np.cross(tangents, first)


def tube(path: np.ndarray, radius: float | np.ndarray, color: Color, sides: int = 8) -> Mesh:
    """Return a tube along a polyline (N, 3), metres, with a radius for all or for each of its points."""
    path = np.asarray(path, float)
    keep = np.isfinite(path).all(axis=1)
    radii = np.broadcast_to(np.asarray(radius, float), (len(path),))[keep]
    path = path[keep]
    if len(path) < 2:
        return EMPTY
    u, v = _frames_along(path)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angle)[None, :, None] * u[:, None] + np.sin(angle)[None, :, None] * v[:, None]
    vertices = (path[:, None] + radii[:, None, None] * ring).reshape(-1, 3)
    i, k = np.meshgrid(np.arange(len(path) - 1), np.arange(sides), indexing="ij")
    a, b = (i * sides + k).ravel(), (i * sides + (k + 1) % sides).ravel()
    faces = np.concatenate([np.column_stack([a, b, a + sides]), np.column_stack([b, b + sides, a + sides])])
    return _mesh(vertices, faces, ring.reshape(-1, 3), color)


def bone(start: np.ndarray, end: np.ndarray, radius: float, color: Color) -> Mesh:
    """Return a bone from one joint to the next: thick a fifth of the way, thin at its end."""
    along = np.array([0.0, 0.06, 0.2, 0.6, 0.97, 1.0])
    path = np.asarray(start) + along[:, None] * (np.asarray(end) - start)
    return tube(path, radius * np.array([0.25, 0.75, 1.0, 0.65, 0.38, 0.1]), color, sides=10)


def frustum(rig: Rig, camera: int, depth: float, thickness: float, color: Color) -> Mesh:
    """Return a camera's frustum as wires: its centre and the image's outline at `depth` metres."""
    width, height = rig.sizes[camera]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    center, directions = rig.rays(camera, corners)
    reach = depth / np.maximum(directions @ rig.viewing_directions[camera], 0.1)
    ends = center + directions * reach[:, None]
    edges = [(center, e) for e in ends] + [(ends[i], ends[(i + 1) % 4]) for i in range(4)]
    wires = [tube(np.array([a, b]), thickness, color, sides=6) for a, b in edges]
    return join([*wires, ball(center, 3 * thickness, color, level=2)])
