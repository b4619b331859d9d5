"""Rendering without a screen or a graphics stack: rays cast by Open3D (Embree), shaded and composited here.

The same on every machine, to the pixel of a calibrated camera (distortion included), antialiased, and translucent by
depth peeling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from viz.shapes import Mesh
from viz.views import View

PAPER = (255, 255, 255)
"""Background, RGB 0–255."""

_STRIP = 1 << 20  # rays cast at once: bounds the memory


@dataclass(frozen=True)
class Look:
    """How a picture is drawn.

    Attributes
    ----------
    samples : int
        Rays a pixel, along each side: 2 means 4 rays.
    layers : int
        Translucent surfaces that are told apart along a ray.
    outline : float
        Darkness of the outlines of opaque surfaces, 0 to 1.
    hollows : float
        Darkening where one surface lies just behind another, 0 to 1.
    """

    samples: int = 2
    layers: int = 2
    outline: float = 0.55
    hollows: float = 0.45


@dataclass(frozen=True)
class Layer:
    """A rendered picture that still has to be put on a background.

    Attributes
    ----------
    rgba : (H, W, 4) float32
        Colour times opacity, and opacity, 0–1.
    """

    rgba: np.ndarray

    def over(self, background: np.ndarray | tuple[int, int, int] = PAPER, opacity: float = 1.0) -> np.ndarray:
        """Return the picture on a background: an image (H, W, 3) uint8 or one colour, RGB; (H, W, 3) uint8."""
        below = np.broadcast_to(np.asarray(background, np.float32) / 255, (*self.rgba.shape[:2], 3))
        above = self.rgba * np.float32(opacity)
        mixed = above[..., :3] + (1 - above[..., 3:]) * below
        return np.clip(np.rint(mixed * 255), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class _Surfaces:
    """Meshes as one ray casting scene with flat attribute arrays."""

    scene: o3d.t.geometry.RaycastingScene
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    alpha: np.ndarray
    rim: np.ndarray
    label: np.ndarray  # of mesh and colour; 0 where no outline is wanted


def _surfaces(meshes: Sequence[Mesh]) -> _Surfaces | None:
    meshes = [m for m in meshes if len(m.faces)]
    if not meshes:
        return None
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)])
    sizes = [len(m.faces) for m in meshes]
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)  # frames are rendered side by side
    vertices = np.concatenate([m.vertices for m in meshes]).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(faces.astype(np.uint32)))
    return _Surfaces(
        scene,
        faces,
        np.concatenate([m.normals for m in meshes]).astype(np.float32),
        np.concatenate([m.colors for m in meshes]).astype(np.float32),
        np.repeat([m.alpha for m in meshes], sizes).astype(np.float32),
        np.repeat([m.rim for m in meshes], sizes).astype(np.float32),
        np.concatenate([_labels(k, m) for k, m in enumerate(meshes)]),
    )


def _labels(number: int, mesh: Mesh) -> np.ndarray:
    """One number for each mesh and colour, (F,) int64."""
    if not mesh.outlined:
        return np.zeros(len(mesh.faces), np.int64)
    return ((np.rint(mesh.colors * 255).astype(np.int64) @ [1 << 16, 1 << 8, 1]) << 16) + number + 1


def render(meshes: Sequence[Mesh], view: View, look: Look | None = None, up: np.ndarray | None = None) -> Layer:
    """Render meshes as a view sees them.

    Parameters
    ----------
    meshes : sequence of Mesh
        Opaque and translucent ones, in any order.
    view : View
    look : Look, optional
    up : (3,) float, optional
        World direction from which some more light comes.

    Returns
    -------
    Layer
    """
    look = look or Look()
    width, height = view.size
    result = np.zeros((height, width, 4), np.float32)
    meshes = [m for m in meshes if len(m.faces)]
    touched = _touched(meshes, view)
    rows, columns = np.flatnonzero(touched.any(axis=1)), np.flatnonzero(touched.any(axis=0))
    if len(rows) == 0:
        return Layer(result)
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    s = look.samples
    wanted = np.repeat(np.repeat(touched[top:bottom, left:right], s, axis=0), s, axis=1)
    y, x = np.nonzero(wanted)
    origin, directions = view.rays(np.column_stack([left + (x + 0.5) / s, top + (y + 0.5) / s]))
    rays = _Rays(origin.astype(np.float32), directions.astype(np.float32), wanted)

    near = _opaque(_surfaces([m for m in meshes if m.alpha >= 1]), rays, look, up)
    clear = _surfaces([m for m in meshes if m.alpha < 1])
    rgba = near.rgba if clear is None else _peel(clear, rays, near, look, up)
    samples = np.zeros((*wanted.shape, 4), np.float32)
    samples[wanted] = rgba
    result[top:bottom, left:right] = cv2.resize(samples, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
    return Layer(result)


@dataclass(frozen=True)
class _Rays:
    """The rays worth casting: origin (3,), directions (N, 3), and where they are among all samples, (h, w) bool."""

    origin: np.ndarray
    directions: np.ndarray
    wanted: np.ndarray

    def __len__(self) -> int:
        return len(self.directions)

    def spread(self, values: np.ndarray, fill: float) -> np.ndarray:
        """Return values of the rays (N,) as a picture of all samples."""
        picture = np.full(self.wanted.shape, fill, values.dtype)
        picture[self.wanted] = values
        return picture


def _touched(meshes: Sequence[Mesh], view: View) -> np.ndarray:
    """Pixels (H, W) bool on which a triangle may fall: those of the 8 × 8 tiles that its box meets, and their edges."""
    width, height = view.size
    if not meshes:
        return np.zeros((height, width), bool)
    pixels, depth = view.project(np.concatenate([m.vertices for m in meshes]))
    if (depth <= 1e-6).any() or not np.isfinite(pixels).all():
        return np.ones((height, width), bool)  # something reaches behind the view
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    corners = pixels[np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)])]
    margin, tile = 1.5, 8
    shape = np.array([-(-height // tile), -(-width // tile)])
    low = np.floor((corners.min(axis=1) - margin) / tile).astype(int)[:, ::-1]
    high = np.floor((corners.max(axis=1) + margin) / tile).astype(int)[:, ::-1] + 1
    inside = ((high > 0) & (low < shape)).all(axis=1)
    low, high = np.clip(low[inside], 0, shape), np.clip(high[inside], 0, shape)
    counts = np.zeros((shape[0] + 1, shape[1] + 1), np.int64)  # differences, summed below
    for rows, columns, sign in ((low, low, 1), (high, high, 1), (low, high, -1), (high, low, -1)):
        index = rows[:, 0] * counts.shape[1] + columns[:, 1]
        counts += sign * np.bincount(index, minlength=counts.size).reshape(counts.shape)
    tiles = counts.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0
    return np.repeat(np.repeat(tiles, tile, axis=0), tile, axis=1)[:height, :width]


@dataclass(frozen=True)
class _Near:
    """What is opaque: colour (N, 4), and distance along the ray (N,), infinite where there is nothing."""

    rgba: np.ndarray
    distance: np.ndarray


def _cast(
    scene: o3d.t.geometry.RaycastingScene, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (N,), triangle numbers (N,) and barycentric coordinates (N, 2) of the first hits."""
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3], rays[:, 3:] = origins, directions
    parts = [scene.cast_rays(o3d.core.Tensor.from_numpy(rays[i : i + _STRIP])) for i in range(0, len(rays), _STRIP)]
    distance, triangle, uv = (
        np.concatenate([p[k].numpy() for p in parts]) for k in ("t_hit", "primitive_ids", "primitive_uvs")
    )
    return distance, triangle, uv


def _normals(surfaces: _Surfaces, triangle: np.ndarray, uv: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Interpolated unit normals that face the viewer."""
    corner = surfaces.faces[triangle]
    u, v = uv[:, :1], uv[:, 1:]
    n = (1 - u - v) * surfaces.normals[corner[:, 0]]
    n += u * surfaces.normals[corner[:, 1]] + v * surfaces.normals[corner[:, 2]]
    n /= np.maximum(np.sqrt(np.einsum("ij,ij->i", n, n)), 1e-9)[:, None]
    away = np.einsum("ij,ij->i", n, directions) > 0
    n[away] *= -1
    return n


def _shade(albedo: np.ndarray, normals: np.ndarray, directions: np.ndarray, up: np.ndarray | None) -> np.ndarray:
    """Soft light from the upper left of the viewer, some from above, and a faint highlight."""
    forward = directions.mean(axis=0)
    forward /= np.linalg.norm(forward)
    above = np.asarray(up if up is not None else -forward, np.float32)
    right = np.cross(forward, above)
    norm = np.linalg.norm(right)
    right = right / norm if norm > 0.05 else np.cross(forward, np.roll(forward, 1))
    head = np.cross(right, forward)
    key = -forward - 0.45 * right + 0.65 * head
    key = (key / np.linalg.norm(key)).astype(np.float32)
    diffuse = np.clip(normals @ key, 0, 1)
    facing = np.clip(-np.einsum("ij,ij->i", normals, directions), 0, 1)
    sky = 0.5 + 0.5 * (normals @ above.astype(np.float32))
    half = key - directions
    half /= np.sqrt(np.einsum("ij,ij->i", half, half))[:, None]
    shine = np.clip(np.einsum("ij,ij->i", normals, half), 0, 1) ** 40
    light = 0.30 + 0.16 * sky + 0.20 * facing + 0.44 * diffuse
    return np.clip(albedo * light[:, None] + 0.10 * shine[:, None], 0, 1)


def _opaque(surfaces: _Surfaces | None, rays: _Rays, look: Look, up: np.ndarray | None) -> _Near:
    rgba = np.zeros((len(rays), 4), np.float32)
    if surfaces is None:
        return _Near(rgba, np.full(len(rays), np.inf, np.float32))
    distance, triangle, uv = _cast(surfaces.scene, rays.origin, rays.directions)
    hit = np.isfinite(distance)
    if hit.any():
        triangle, d = triangle[hit], rays.directions[hit]
        normals = _normals(surfaces, triangle, uv[hit], d)
        color = _shade(surfaces.colors[triangle], normals, d, up)
        depth = rays.spread(distance, np.inf)
        label = np.zeros(len(rays), np.int64)
        label[hit] = surfaces.label[triangle]
        dark = 1 - look.hollows * _hollows(depth, look.samples)
        dark *= 1 - look.outline * _edges(depth, rays.spread(label, 0))
        rgba[hit, :3] = color * dark[rays.wanted][hit, None]
        rgba[hit, 3] = 1
    return _Near(rgba, distance)


def _hollows(depth: np.ndarray, samples: int) -> np.ndarray:
    """Darkness, 0–1, where nearer surfaces are close by in the picture (depth unsharp masking, Luft et al. 2006)."""
    hit = np.isfinite(depth)
    values = depth[hit]
    near, far = float(values.min()), float(values.max())
    filled = np.where(hit, depth, far).astype(np.float32)
    sigma = 5.0 * samples
    weight = cv2.GaussianBlur(hit.astype(np.float32), (0, 0), sigma)
    blurred = cv2.GaussianBlur(np.where(hit, filled, 0).astype(np.float32), (0, 0), sigma) / np.maximum(weight, 1e-6)
    scale = 0.10 * max(far - near, 1e-6)
    return np.clip((filled - blurred) / scale, 0, 1) * hit


def _edges(depth: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Darkness, 0–1, of samples beside which an outlined surface ends, lies deeper, or changes its colour."""
    hit = np.isfinite(depth)
    values = depth[hit]
    jump = np.float32(0.03 * max(float(np.ptp(values)), 0.02 * float(values.mean()), 1e-6))
    far = np.where(hit, depth, np.float32(1e9))
    dark = np.zeros(depth.shape, np.float32)
    for axis in (0, 1):
        first = tuple(slice(0, -1) if a == axis else slice(None) for a in (0, 1))
        second = tuple(slice(1, None) if a == axis else slice(None) for a in (0, 1))
        rise = far[second] - far[first]
        border = (label[first] != label[second]) & (label[first] > 0) & (label[second] > 0)
        for here, deeper in ((first, rise > jump), (second, rise < -jump)):
            view = dark[here]
            view[border] = np.maximum(view[border], np.float32(0.35))
            view[deeper] = 1
    return dark * (label > 0)


def _peel(clear: _Surfaces, rays: _Rays, near: _Near, look: Look, up: np.ndarray | None) -> np.ndarray:
    """Composite translucent layers, front to back, and what is opaque behind them: (N, 4)."""
    rgba = np.zeros((len(rays), 4), np.float32)
    start = np.broadcast_to(rays.origin, rays.directions.shape).copy()
    travelled = np.zeros(len(rays), np.float32)
    alive = np.arange(len(rays))
    for _ in range(look.layers):
        if len(alive) == 0:
            break
        distance, triangle, uv = _cast(clear.scene, start[alive], rays.directions[alive])
        seen = np.isfinite(distance) & (travelled[alive] + distance < near.distance[alive])
        alive, distance, triangle, uv = alive[seen], distance[seen], triangle[seen], uv[seen]
        if len(alive) == 0:
            break
        d = rays.directions[alive]
        normals = _normals(clear, triangle, uv, d)
        facing = np.clip(-np.einsum("ij,ij->i", normals, d), 0, 1)
        alpha = np.clip(clear.alpha[triangle] + clear.rim[triangle] * (1 - facing) ** 2, 0, 1)
        color = _shade(clear.colors[triangle], normals, d, up)
        left = (1 - rgba[alive, 3]) * alpha
        rgba[alive, :3] += left[:, None] * color
        rgba[alive, 3] += left
        step = distance * np.float32(1 + 1e-5) + np.float32(1e-5)
        travelled[alive] += step
        start[alive] += step[:, None] * d
    return rgba + (1 - rgba[:, 3:]) * near.rgba
