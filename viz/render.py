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
    scene = o3d.t.geometry.RaycastingScene()
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
    window = _window([m for m in meshes if len(m.faces)], view)
    if window is None:
        return Layer(result)
    left, top, right, bottom = window
    s = look.samples
    x = left + (np.arange((right - left) * s) + 0.5) / s
    y = top + (np.arange((bottom - top) * s) + 0.5) / s
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    origin, directions = view.rays(pixels)
    directions = directions.astype(np.float32)
    shape = (len(y), len(x))

    near = _opaque(_surfaces([m for m in meshes if m.alpha >= 1]), origin, directions, shape, look, up)
    clear = _surfaces([m for m in meshes if m.alpha < 1])
    rgba = near.rgba if clear is None else _peel(clear, origin, directions, near, look, up)
    result[top:bottom, left:right] = cv2.resize(rgba, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
    return Layer(result)


def _window(meshes: Sequence[Mesh], view: View) -> tuple[int, int, int, int] | None:
    """Pixel window that holds all of the meshes: left, top, right, bottom."""
    if not meshes:
        return None
    width, height = view.size
    pixels, depth = view.project(np.concatenate([m.vertices for m in meshes]))
    if (depth <= 1e-6).any() or not np.isfinite(pixels).all():
        return 0, 0, width, height  # something reaches behind the view
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, [width, height])
    return None if (low >= high).any() else (int(low[0]), int(low[1]), int(high[0]), int(high[1]))


@dataclass(frozen=True)
class _Near:
    """What is opaque: picture, and distance along the ray (infinite where there is nothing)."""

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


def _opaque(
    surfaces: _Surfaces | None,
    origin: np.ndarray,
    directions: np.ndarray,
    shape: tuple[int, int],
    look: Look,
    up: np.ndarray | None,
) -> _Near:
    rgba = np.zeros((len(directions), 4), np.float32)
    distance = np.full(len(directions), np.inf, np.float32)
    if surfaces is None:
        return _Near(rgba.reshape(*shape, 4), distance)
    distance, triangle, uv = _cast(surfaces.scene, origin.astype(np.float32), directions)
    hit = np.isfinite(distance)
    if hit.any():
        triangle, d = triangle[hit], directions[hit]
        normals = _normals(surfaces, triangle, uv[hit], d)
        color = _shade(surfaces.colors[triangle], normals, d, up)
        depth_map = distance.reshape(shape)
        shadow = look.hollows * _hollows(depth_map, look.samples)[hit.reshape(shape)]
        label = np.zeros(len(directions), np.int64)
        label[hit] = surfaces.label[triangle]
        line = look.outline * _edges(depth_map, label.reshape(shape))[hit.reshape(shape)]
        rgba[hit, :3] = color * (1 - shadow)[:, None] * (1 - line)[:, None]
        rgba[hit, 3] = 1
    return _Near(rgba.reshape(*shape, 4), distance)


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


def _peel(
    clear: _Surfaces, origin: np.ndarray, directions: np.ndarray, near: _Near, look: Look, up: np.ndarray | None
) -> np.ndarray:
    """Composite translucent layers, front to back, and what is opaque behind them."""
    rgba = np.zeros((len(directions), 4), np.float32)
    start = np.broadcast_to(origin.astype(np.float32), directions.shape).copy()
    travelled = np.zeros(len(directions), np.float32)
    alive = np.arange(len(directions))
    for _ in range(look.layers):
        if len(alive) == 0:
            break
        distance, triangle, uv = _cast(clear.scene, start[alive], directions[alive])
        seen = np.isfinite(distance) & (travelled[alive] + distance < near.distance[alive])
        alive, distance, triangle, uv = alive[seen], distance[seen], triangle[seen], uv[seen]
        if len(alive) == 0:
            break
        d = directions[alive]
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
    behind = near.rgba.reshape(-1, 4)
    rgba += (1 - rgba[:, 3:]) * behind
    return rgba.reshape(near.rgba.shape)
