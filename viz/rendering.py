"""Rendering without a screen or a graphics stack: rays cast by Open3D (Embree), shaded and composited here.

The same on every machine, to the pixel of a calibrated camera (distortion included), antialiased, and translucent by
depth peeling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomocap.model.ray_casting import TriangleScene, touched_pixels
from viz.ray_kernels import shade
from viz.shapes import EMPTY, Mesh
from viz.viewpoints import View

PAPER = (255, 255, 255)
"""Background, RGB 0–255."""


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
    reach : float
        How far around a surface that darkening is seen, pixels.
    """

    samples: int = 2
    layers: int = 2
    outline: float = 0.55
    hollows: float = 0.45
    reach: float = 5.0


@dataclass(frozen=True)
class Layer:
    """A rendered picture that still has to be put on a background.

    Attributes
    ----------
    rgba : (H, W, 4) float32
        Colour times opacity, and opacity, 0–1.
    """

    rgba: np.ndarray

    def above(self, below: Layer) -> Layer:
        """Return this picture and, where it is clear, another one behind it."""
        return Layer(self.rgba + (1 - self.rgba[..., 3:]) * below.rgba)

    def clear(self) -> np.ndarray:
        """Return the picture without a background: (H, W, 4) uint8, RGB and opacity."""
        opacity = np.clip(self.rgba[..., 3:], 0, 1)
        color = np.clip(self.rgba[..., :3] / np.maximum(opacity, 1e-6), 0, 1)
        return np.rint(255 * np.concatenate([color, opacity], axis=2)).astype(np.uint8)

    def over(self, background: np.ndarray | tuple[int, int, int] = PAPER, opacity: float = 1.0) -> np.ndarray:
        """Return the picture on a background: an image (H, W, 3) uint8 or one colour, RGB; (H, W, 3) uint8."""
        below = np.broadcast_to(np.asarray(background, np.float32) / 255, (*self.rgba.shape[:2], 3))
        above = self.rgba * np.float32(opacity)
        mixed = above[..., :3] + (1 - above[..., 3:]) * below
        return np.clip(np.rint(mixed * 255), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class _Surfaces:
    """Meshes as one ray casting scene with flat attribute arrays."""

    meshes: tuple[Mesh, ...]
    scene: TriangleScene
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    alpha: np.ndarray
    rim: np.ndarray
    label: np.ndarray  # of mesh and colour; 0 where no outline is wanted


def _surfaces(meshes: Sequence[Mesh], like: Sequence[_Surfaces | None] = ()) -> _Surfaces | None:
    """Sort meshes for rays, unless one of `like` has the same triangles in other colours."""
    if not meshes:
        return None
    vertices, faces = _triangles(meshes)
    sizes = [len(m.faces) for m in meshes]
    sorted_before = (other.scene for other in like if other is not None and _same_triangles(meshes, other.meshes))
    return _Surfaces(
        tuple(meshes),
        next(sorted_before, None) or TriangleScene(vertices, faces),
        faces,
        np.concatenate([m.normals for m in meshes]).astype(np.float32),
        np.concatenate([m.colors for m in meshes]).astype(np.float32),
        np.repeat([m.alpha for m in meshes], sizes).astype(np.float32),
        np.repeat([m.rim for m in meshes], sizes).astype(np.float32),
        np.concatenate([_labels(k, m) for k, m in enumerate(meshes)]),
    )


def _same_triangles(some: Sequence[Mesh], others: Sequence[Mesh]) -> bool:
    """Whether meshes are made of the very same arrays, as those are that were recoloured."""
    same = (a.vertices is b.vertices and a.faces is b.faces for a, b in zip(some, others, strict=False))
    return len(some) == len(others) and all(same)


def _triangles(meshes: Sequence[Mesh]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of all meshes."""
    meshes = meshes or [EMPTY]
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)])
    return np.concatenate([m.vertices for m in meshes]), np.ascontiguousarray(faces)


class Model:
    """Meshes, opaque and translucent, made ready once to be rendered from many views.

    Parameters
    ----------
    meshes : sequence of Mesh
        In any order; those without triangles are left out.
    like : Model, optional
        A model with some of these meshes in other colours: they aren't sorted for rays again.
    """

    def __init__(self, meshes: Sequence[Mesh], like: Model | None = None) -> None:
        known: Sequence[_Surfaces | None] = () if like is None else (like._opaque, like._clear)
        self.meshes = [m for m in meshes if len(m.faces)]
        self._triangles = _triangles(self.meshes)
        self._opaque: _Surfaces | None = _surfaces([m for m in self.meshes if m.alpha >= 1], known)
        self._clear: _Surfaces | None = _surfaces([m for m in self.meshes if m.alpha < 1], known)

    def render(self, view: View, look: Look | None = None, up: np.ndarray | None = None) -> Layer:
        """Render the meshes as a view sees them.

        Parameters
        ----------
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
        touched = _touched(*self._triangles, view)
        rows, columns = np.flatnonzero(touched.any(axis=1)), np.flatnonzero(touched.any(axis=0))
        if len(rows) == 0:
            return Layer(result)
        top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
        s = look.samples
        wanted = np.repeat(np.repeat(touched[top:bottom, left:right], s, axis=0), s, axis=1)
        y, x = np.nonzero(wanted)
        origin, directions = view.rays(np.column_stack([left + (x + 0.5) / s, top + (y + 0.5) / s]))
        rays = _Rays(origin.astype(np.float32), directions.astype(np.float32), wanted)

        near = _opaque(self._opaque, rays, look, up)
        rgba = near.rgba if self._clear is None else _peel(self._clear, rays, near, look, up)
        samples = np.zeros((*wanted.shape, 4), np.float32)
        samples[wanted] = rgba
        result[top:bottom, left:right] = cv2.resize(samples, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        return Layer(result)


def _labels(number: int, mesh: Mesh) -> np.ndarray:
    """One number for each mesh and colour, (F,) int64."""
    if not mesh.outlined:
        return np.zeros(len(mesh.faces), np.int64)
    return ((np.rint(mesh.colors * 255).astype(np.int64) @ [1 << 16, 1 << 8, 1]) << 16) + number + 1


def render(meshes: Sequence[Mesh], view: View, look: Look | None = None, up: np.ndarray | None = None) -> Layer:
    """Render meshes as one view sees them; see `Model.render`."""
    return Model(meshes).render(view, look, up)


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


def _touched(vertices: np.ndarray, faces: np.ndarray, view: View) -> np.ndarray:
    """Pixels (H, W) bool on which a triangle may fall; all if something reaches behind the view."""
    pixels, depth = view.project(vertices)
    pixels = np.where((depth > 1e-6)[:, None], pixels, np.nan)
    return touched_pixels(pixels, faces, *view.size)


@dataclass(frozen=True)
class _Near:
    """What is opaque: colour (N, 4), and distance along the ray (N,), infinite where there is nothing."""

    rgba: np.ndarray
    distance: np.ndarray


def _rays(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Rays (N, 6) from origins (3,) or (N, 3) in directions (N, 3)."""
    return np.concatenate([np.broadcast_to(origins, directions.shape), directions], axis=1)


def _shade(
    surfaces: _Surfaces, triangle: np.ndarray, uv: np.ndarray, directions: np.ndarray, up: np.ndarray | None
) -> np.ndarray:
    """Colours and opacities (N, 4) of hits, in soft light from the upper left of the viewer."""
    forward = directions.mean(axis=0)
    forward /= np.linalg.norm(forward)
    above = np.asarray(up if up is not None else -forward, np.float32)
    right = np.cross(forward, above)
    norm = np.linalg.norm(right)
    right = right / norm if norm > 0.05 else np.cross(forward, np.roll(forward, 1))
    head = np.cross(right, forward)
    key = -forward - 0.45 * right + 0.65 * head
    key = (key / np.linalg.norm(key)).astype(np.float32)
    rgba = np.empty((len(triangle), 4), np.float32)
    s = surfaces
    shade(triangle, uv, directions, s.faces, s.normals, s.colors, s.alpha, s.rim, key, above, rgba)
    return rgba


def _opaque(surfaces: _Surfaces | None, rays: _Rays, look: Look, up: np.ndarray | None) -> _Near:
    rgba = np.zeros((len(rays), 4), np.float32)
    if surfaces is None:
        return _Near(rgba, np.full(len(rays), np.inf, np.float32))
    distance, triangle, uv = surfaces.scene.cast(_rays(rays.origin, rays.directions))
    hit = np.isfinite(distance)
    if hit.any():
        triangle = triangle[hit]
        shaded = _shade(surfaces, triangle, uv[hit], rays.directions[hit], up)
        depth = rays.spread(distance, np.inf)
        label = np.zeros(len(rays), np.int64)
        label[hit] = surfaces.label[triangle]
        dark = 1 - look.hollows * _hollows(depth, look.reach * look.samples)
        dark *= 1 - look.outline * _edges(depth, rays.spread(label, 0))
        shaded[:, :3] *= dark[rays.wanted][hit, None]
        rgba[hit] = shaded
    return _Near(rgba, distance)


def _hollows(depth: np.ndarray, sigma: float) -> np.ndarray:
    """Darkness, 0–1, where nearer surfaces are close by in the picture (depth unsharp masking, Luft et al. 2006)."""
    hit = np.isfinite(depth)
    values = depth[hit]
    near, far = float(values.min()), float(values.max())
    filled = np.where(hit, depth, far).astype(np.float32)
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
        distance, triangle, uv = clear.scene.cast(_rays(start[alive], rays.directions[alive]))
        seen = np.isfinite(distance) & (travelled[alive] + distance < near.distance[alive])
        alive, distance, triangle, uv = alive[seen], distance[seen], triangle[seen], uv[seen]
        if len(alive) == 0:
            break
        d = rays.directions[alive]
        shaded = _shade(clear, triangle, uv, d, up)
        left = (1 - rgba[alive, 3]) * shaded[:, 3]
        rgba[alive, :3] += left[:, None] * shaded[:, :3]
        rgba[alive, 3] += left
        step = distance * np.float32(1 + 1e-5) + np.float32(1e-5)
        travelled[alive] += step
        start[alive] += step[:, None] * d
    return rgba + (1 - rgba[:, 3:]) * near.rgba
