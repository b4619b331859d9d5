"""Triangle meshes of simple solids, with texture coordinates and shading normals in groups."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Solid:
    """A closed mesh in its own axes.

    Attributes
    ----------
    vertices : (V, 3) float, metres
    faces : (F, 3) int, outward
    uv : (V, 2) float
    normals_group : (V,) int
        Vertices with the same number share a smooth normal.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    normals_group: np.ndarray


def capsule(length: float, radius: tuple[float, float], width: float = 1.0, rings: int = 6, sides: int = 18) -> Solid:
    """Make a capsule along −z from the origin, its two half-spheres round the ends.

    Parameters
    ----------
    length : float
        Distance of the half-spheres' centres, metres.
    radius : (float, float)
        At the origin and at the far end, metres.
    width : float
        Stretch along x, so that a trunk is wider than deep.
    """
    angles = np.linspace(0, np.pi / 2, rings)
    profile = [(radius[0] * np.sin(a), radius[0] * np.cos(a)) for a in angles]
    for fraction in np.linspace(0, 1, 6)[1:-1]:
        profile.append(((1 - fraction) * radius[0] + fraction * radius[1], -fraction * length))
    profile += [(radius[1] * np.cos(a), -length - radius[1] * np.sin(a)) for a in angles]
    r, z = np.array(profile).T
    turn = np.linspace(0, 2 * np.pi, sides + 1)  # the last column repeats the first with u = 1
    x, y = width * np.outer(r, np.cos(turn)), np.outer(r, np.sin(turn))
    vertices = np.stack([x, y, np.repeat(z[:, None], sides + 1, axis=1)], axis=-1).reshape(-1, 3)
    v = (z[0] - z) / (z[0] - z[-1])
    uv = np.stack(np.meshgrid(turn / (2 * np.pi), v), axis=-1).reshape(-1, 2)
    group = np.arange(len(r) * (sides + 1)).reshape(len(r), sides + 1)
    group[:, -1] = group[:, 0]
    group[0], group[-1] = group[0, 0], group[-1, 0]
    return Solid(vertices, _with_area(vertices, _grid_faces(len(r), sides + 1)), uv, group.ravel())


def ellipsoid(radii: tuple[float, float, float], center: tuple[float, float, float], rings: int = 15) -> Solid:
    """Make an ellipsoid with these semi-axes about a centre, metres."""
    ball = capsule(0.0, (1.0, 1.0), rings=rings // 2 + 1)
    return Solid(ball.vertices * radii + np.array(center), ball.faces, ball.uv, ball.normals_group)


def box(low: tuple[float, float, float], high: tuple[float, float, float], steps: int = 3) -> Solid:
    """Make a box with sharp edges between two corners, metres; each side a grid of `steps`² squares."""
    a, b = np.array(low), np.array(high)
    u, v = (g.ravel() for g in np.meshgrid(np.linspace(0, 1, steps + 1), np.linspace(0, 1, steps + 1)))
    vertices: list[np.ndarray] = []
    faces, uv, group = [], [], []
    for axis in range(3):
        for side in (0.0, 1.0):
            unit = np.zeros((len(u), 3))
            unit[:, axis], unit[:, (axis + 1) % 3], unit[:, (axis + 2) % 3] = side, u, v
            grid = _grid_faces(steps + 1, steps + 1)
            faces.append((grid if side == 0.0 else grid[:, ::-1]) + len(u) * len(vertices))
            group.append(np.arange(len(u)) + len(u) * len(vertices))
            vertices.append(a + unit * (b - a))
            uv.append(np.column_stack([u, v]))
    return Solid(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv), np.concatenate(group))


def cylinder(radius: float, half_length: float, axis: int, sides: int = 32) -> Solid:
    """Make a cylinder about the origin along axis 0, 1 or 2, with sharp rims; metres."""
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    circle = np.column_stack([np.cos(turn), np.sin(turn)]) * radius
    zero, height = np.zeros(sides + 1), np.full(sides + 1, half_length)
    # Four strips: cap, mantle, cap; the strips' borders are doubled so that the rims stay sharp
    strips = [
        (np.column_stack([zero, zero, height]), np.column_stack([circle, height])),
        (np.column_stack([circle, height]), np.column_stack([circle, -height])),
        (np.column_stack([circle, -height]), np.column_stack([zero, zero, -height])),
    ]
    vertices, faces, uv, group = [], [], [], []
    for k, (top, bottom) in enumerate(strips):
        first = 2 * (sides + 1) * k
        vertices += [top, bottom]
        faces.append(_grid_faces(2, sides + 1) + first)
        uv += [np.column_stack([turn / (2 * np.pi), np.full(sides + 1, (k + s) / 3)]) for s in (0, 1)]
        rows = np.arange(2 * (sides + 1)).reshape(2, -1) + first
        rows[:, -1] = rows[:, 0]
        group.append(rows.ravel())
    turned = np.roll(np.concatenate(vertices), axis + 1, axis=1)
    return Solid(turned, _with_area(turned, np.concatenate(faces)), np.concatenate(uv), np.concatenate(group))


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of vertices, rows downwards, columns anticlockwise seen from above."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])


def _with_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Leave out the triangles that have shrunk to a line, at poles."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12]
