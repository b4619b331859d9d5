"""Colours of points on the subject: its texture, a fine fabric fixed to its rest pose, and light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from data_tools.asset import AnimatedAsset
from data_tools.solid_noise import fabric_noise, gradient_noise
from geomocap.model.surface import vertex_normals

MEAN_LEVEL = 125.0  # grey levels, of the subject under light of strength 1
DARKEST, BRIGHTEST = 0.08, 0.85  # fractions of the light that black and white surfaces return, so that both show fabric


@dataclass(frozen=True)
class ShadedSurface:
    """What of an asset's appearance stays the same over time, in the form that the kernel takes.

    Attributes
    ----------
    faces : (F, 3) int32
    fabric : (V, 3) float64
        Where a vertex is in the fabric's space: its place in the rest pose, metres.
    normals_group : (V,) int64
    uv : (V, 2) float32
    colors : (V, 3) float32
    face_textures : (F,) int32
    texels : (N, 3) uint8
        All textures, one after the other, row by row.
    texture_shapes : (K, 3) int64
        Of each texture: first texel, height, width.
    exponent : float
        Of the asset's colours (0 … 1), so that dark and bright subjects are well exposed; black and white stay.
    cells, weights : (O,) float64
        Cell sizes (metres) and weights of the fabric's octaves.
    seed : int
    """

    faces: np.ndarray
    fabric: np.ndarray
    normals_group: np.ndarray
    uv: np.ndarray
    colors: np.ndarray
    face_textures: np.ndarray
    texels: np.ndarray
    texture_shapes: np.ndarray
    exponent: float
    cells: np.ndarray
    weights: np.ndarray
    seed: int

    @classmethod
    def of(cls, asset: AnimatedAsset, footprint: float, contrast: float, seed: int) -> ShadedSurface:
        """Prepare an asset for cameras that see it with a pixel every `footprint` metres.

        The fabric's finest octave has cells of 2.5 pixels: features of about 4 pixels, which least squares matching
        can hold on to and the image can still show. Textures finer than half a pixel are smoothed beforehand.

        Parameters
        ----------
        footprint : float
            Size of a pixel on the subject, metres.
        contrast : float
            Standard deviation of the fabric relative to the brightness.
        """
        rest = asset.vertices(None)
        triangles, uvs = rest[asset.faces], asset.uv[asset.faces]
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        e, f = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
        uv_area = np.abs(e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0])
        textures = []
        for k, texture in enumerate(asset.textures):
            own = asset.face_textures == k
            texels = uv_area[own].sum() * texture.shape[0] * texture.shape[1]
            texel = np.sqrt(area[own].sum() / texels) if texels > 0 else footprint
            shrink = min(1.0, max(texel / (0.5 * footprint), 4 / min(texture.shape[:2])))
            size = (max(1, round(texture.shape[1] * shrink)), max(1, round(texture.shape[0] * shrink)))
            textures.append(cv2.resize(texture, size, interpolation=cv2.INTER_AREA))
        shapes, first = [], 0
        for texture in textures:
            shapes.append((first, *texture.shape[:2]))
            first += texture.shape[0] * texture.shape[1]
        cells = footprint * np.array([2.5, 5.0, 10.0, 24.0])
        weights = np.array([1.0, 1.0, 0.8, 0.7])
        surface = cls(
            faces=np.ascontiguousarray(asset.faces, dtype=np.int32),
            fabric=np.ascontiguousarray(rest),
            normals_group=np.unique(asset.normals_group, return_inverse=True)[1].astype(np.int64),
            uv=np.ascontiguousarray(asset.uv, dtype=np.float32),
            colors=np.ascontiguousarray(asset.vertex_colors, dtype=np.float32),
            face_textures=np.ascontiguousarray(asset.face_textures, dtype=np.int32),
            texels=np.concatenate([t.reshape(-1, 3) for t in textures] or [np.zeros((1, 3), np.uint8)]),
            texture_shapes=np.array(shapes, dtype=np.int64).reshape(-1, 3),
            exponent=1.0,
            cells=cells,
            # Gradient noise has a standard deviation of 0.27; octaves are independent
            weights=contrast * weights / (0.27 * np.linalg.norm(weights)),
            seed=seed,
        )
        return surface._exposed(area)

    def _exposed(self, area: np.ndarray) -> ShadedSurface:
        """Return the surface with the exponent that makes its mean colour a good middle grey."""
        n = len(self.faces)
        flat = replace(self, weights=np.zeros_like(self.weights))
        white, centers = np.array([0.0, 0, 1, 0, 0, 1, 1.0, 0, 0]), np.full((n, 2), 1 / 3, np.float32)
        low, high = 0.25, 3.0
        for _ in range(20):
            middle = (low + high) / 2
            colors = replace(flat, exponent=middle).shade(np.zeros_like(self.fabric), np.arange(n), centers, white)
            mean = float(np.average(colors.mean(axis=1), weights=np.maximum(area, 1e-12)))
            low, high = (middle, high) if mean > MEAN_LEVEL else (low, middle)
        return replace(self, exponent=(low + high) / 2)

    def normals(self, vertices: np.ndarray) -> np.ndarray:
        """Smooth vertex normals, weighted by area, of a posed mesh: (V, 3) float64."""
        return vertex_normals(vertices, self.faces, self.normals_group)

    def shade(self, normals: np.ndarray, triangles: np.ndarray, uvs: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Colours of surface points, (N, 3) float32, grey levels (not clipped).

        Parameters
        ----------
        normals : (V, 3) float
            Of the posed mesh.
        triangles : (N,) int
        uvs : (N, 2) float
            Barycentric coordinates of the triangle's second and third corner.
        light : (9,) float
            `Light.vector`.
        """
        return _shade(
            np.asarray(triangles, dtype=np.int64),
            np.asarray(uvs, dtype=np.float32),
            self.faces,
            self.fabric,
            np.ascontiguousarray(normals, dtype=np.float64),
            self.uv,
            self.colors,
            self.face_textures,
            self.texels,
            self.texture_shapes,
            self.exponent,
            self.cells,
            self.weights,
            self.seed,
            light,
        )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _texel(texels: np.ndarray, first: int, height: int, width: int, u: float, v: float, k: int) -> float:
    """Bilinear look-up with repetition; texel centres at half coordinates."""
    x, y = u * width - 0.5, v * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    a, b = x - x0, y - y0
    left, right = x0 % width, (x0 + 1) % width
    top, bottom = first + (y0 % height) * width, first + ((y0 + 1) % height) * width
    upper = (1 - a) * texels[top + left, k] + a * texels[top + right, k]
    lower = (1 - a) * texels[bottom + left, k] + a * texels[bottom + right, k]
    return (1 - b) * upper + b * lower


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(
    triangles: np.ndarray,
    uvs: np.ndarray,
    faces: np.ndarray,
    fabric: np.ndarray,
    normals: np.ndarray,
    uv: np.ndarray,
    colors: np.ndarray,
    face_textures: np.ndarray,
    texels: np.ndarray,
    texture_shapes: np.ndarray,
    exponent: float,
    cells: np.ndarray,
    weights: np.ndarray,
    seed: int,
    light: np.ndarray,
) -> np.ndarray:
    out = np.empty((len(triangles), 3), dtype=np.float32)
    place, normal, color = np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(triangles)):
        t = triangles[i]
        w1, w2 = float(uvs[i, 0]), float(uvs[i, 1])
        w0 = 1.0 - w1 - w2
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        for k in range(3):
            place[k] = w0 * fabric[a, k] + w1 * fabric[b, k] + w2 * fabric[c, k]
            normal[k] = w0 * normals[a, k] + w1 * normals[b, k] + w2 * normals[c, k]
            color[k] = w0 * colors[a, k] + w1 * colors[b, k] + w2 * colors[c, k]
        # Light
        norm = max(1e-12, np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2))
        toward_key = (normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]) / norm
        toward_fill = (normal[0] * light[3] + normal[1] * light[4] + normal[2] * light[5]) / norm
        level = light[6] + light[7] * max(0.0, toward_key) + light[8] * max(0.0, toward_fill)
        # Fabric: brightness in all octaves, a little hue in a coarse one
        weave = 1.0
        hue = 0.0
        if weights[0] > 0.0:
            noise = fabric_noise(place[0], place[1], place[2], cells, weights, seed)
            weave = min(1.9, max(0.12, 1.0 + noise))
            coarse = 1.3 * cells[len(cells) - 1]
            hue = weights[0] * gradient_noise(place[0] / coarse, place[1] / coarse, place[2] / coarse, seed + 99)
        level *= 255.0 * weave
        material = face_textures[t]
        for k in range(3):
            value = 1.0
            if material >= 0:
                u = w0 * uv[a, 0] + w1 * uv[b, 0] + w2 * uv[c, 0]
                v = w0 * uv[a, 1] + w1 * uv[b, 1] + w2 * uv[c, 1]
                first, height, width = texture_shapes[material]
                value = _texel(texels, first, height, width, u, v, k) / 255.0
            tint = 1.0 + (hue if k == 0 else (-0.7 * hue if k == 2 else 0.0)) * 0.4
            albedo = max(0.0, value * color[k]) ** exponent
            out[i, k] = level * tint * (DARKEST + (BRIGHTEST - DARKEST) * albedo)
    return out
