"""Triangles that rays are cast at (Open3D's Embree), and the pixels of an image on which triangles may fall."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numba import njit

_STRIP = 1 << 20  # rays cast at once: bounds the memory
_TILE = 4  # pixels
_MARGIN = 1.5  # pixels
_BEND = 0.03  # of a triangle's image: distortion bends the edges of large ones outwards

NOTHING = o3d.t.geometry.RaycastingScene.INVALID_ID
"""Triangle number of a ray that hits none."""


class TriangleScene:
    """Triangles, sorted for rays when they are made, so that threads may cast rays side by side.

    Parameters
    ----------
    vertices : (V, 3) float
    faces : (F, 3) int
    threads : int
        That sort and cast; 0: as many as there are cores.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, threads: int = 0) -> None:
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
        self._scene.add_triangles(_tensor(vertices, np.float32), _tensor(faces, np.uint32))
        self.cast(np.array([[0, 0, 0, 1, 1, 1]]))  # the first ray sorts them

    def cast(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of rays.

        Parameters
        ----------
        rays : (N, 6) float
            Origins and directions.

        Returns
        -------
        distance : (N,) float32
            In lengths of the direction; infinite where nothing is hit.
        triangle : (N,) uint32
            `NOTHING` where nothing is hit.
        uv : (N, 2) float32
            Weights of the triangle's second and third corner.
        """
        strips = range(0, max(len(rays), 1), _STRIP)
        parts = [self._scene.cast_rays(_tensor(rays[i : i + _STRIP], np.float32)) for i in strips]
        distance, triangle, uv = (
            np.concatenate([p[k].numpy() for p in parts]) for k in ("t_hit", "primitive_ids", "primitive_uvs")
        )
        return distance, triangle, uv

    def occluded(self, rays: np.ndarray) -> np.ndarray:
        """Whether each of rays (…, 6) hits anything, (…) bool."""
        return self._scene.test_occlusions(_tensor(rays, np.float32)).numpy()

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points of the triangles that are closest to points (N, 3).

        Returns
        -------
        closest : (N, 3) float32
        triangle : (N,) int
        corner_weights : (N, 3) float
        normals : (N, 3) float32
            Of the triangles.
        """
        found = self._scene.compute_closest_points(_tensor(points, np.float32))
        uv = found["primitive_uvs"].numpy().astype(float)
        corners = np.stack([1 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        triangle, normals = found["primitive_ids"].numpy().astype(int), found["primitive_normals"].numpy()
        return found["points"].numpy(), triangle, corners, normals


def _tensor(array: np.ndarray, kind: type) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array, dtype=kind))


def touched_pixels(corners: np.ndarray, faces: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pixels on which triangles may fall, (H, W) bool, in tiles of 4 × 4 pixels.

    Parameters
    ----------
    corners : (V, 2) float
        COLMAP pixels of the vertices; if any isn't finite, as behind the camera, all pixels may be touched.
    faces : (F, 3) int
    """
    if not np.isfinite(corners).all():
        return np.ones((height, width), bool)
    tiles = np.zeros((-(-height // _TILE), -(-width // _TILE)), bool)
    mark_tiles(np.ascontiguousarray(corners), np.ascontiguousarray(faces, np.int64), tiles)
    return np.repeat(np.repeat(tiles, _TILE, axis=0), _TILE, axis=1)[:height, :width]


@njit(cache=True, nogil=True, error_model="numpy")
def mark_tiles(corners, faces, tiles):
    """Set the tiles (rows, columns) that the boxes of triangles meet; `corners` (V, 2) must be finite."""
    rows, columns = tiles.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        left = min(corners[a, 0], corners[b, 0], corners[c, 0])
        right = max(corners[a, 0], corners[b, 0], corners[c, 0])
        top = min(corners[a, 1], corners[b, 1], corners[c, 1])
        bottom = max(corners[a, 1], corners[b, 1], corners[c, 1])
        margin = _MARGIN + _BEND * max(right - left, bottom - top)
        left, right, top, bottom = left - margin, right + margin, top - margin, bottom + margin
        if right < 0 or bottom < 0 or left >= columns * _TILE or top >= rows * _TILE:
            continue
        first, last = int(max(left, 0.0)) // _TILE, min(int(right) // _TILE, columns - 1)
        for row in range(int(max(top, 0.0)) // _TILE, min(int(bottom) // _TILE, rows - 1) + 1):
            for column in range(first, last + 1):
                tiles[row, column] = True
