"""Which camera sees which surface voxel, and the colour that it sees there.

Surface voxels are drawn into one depth buffer a camera, each as the rectangle round its projected cube. A voxel is seen
if one of its free faces is turned to the camera and nothing lies clearly before its centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.voxel_grid import Grid

DEPTH_SLACK = 1.5  # voxels that something must lie before a centre to hide it: a slanted surface doesn't hide itself


@dataclass(frozen=True)
class VoxelVisibility:
    """What the cameras see of surface voxels.

    Attributes
    ----------
    seen : (N, C) uint8
        1 where the camera sees the voxel.
    colors : (N, C, 3) float32
        Mean colour of the subject's pixels under the voxel; 0 where it is not seen.
    low, high : (N, C, 3) uint8
        Range of the colours within the window round it.
    """

    seen: np.ndarray
    colors: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class SurfaceVoxels:
    """Surface voxels with their free faces.

    Attributes
    ----------
    indices : (N, 3) int32
    faces : (N,) uint8
        Bits 0 to 5: nothing occupied on the side of −x, +x, −y, +y, −z, +z.
    """

    indices: np.ndarray
    faces: np.ndarray

    @classmethod
    def of(cls, occupancy: Occupancy) -> SurfaceVoxels:
        """Find the surface of an occupancy."""
        indices = occupancy.surface_indices()
        return cls(indices, _free_faces(occupancy.bits, indices))

    def select(self, which: np.ndarray) -> SurfaceVoxels:
        """Return some of them, by a mask or by positions."""
        return SurfaceVoxels(self.indices[which], self.faces[which])


def depth_buffers(views: PinholeViews, grid: Grid, surface: SurfaceVoxels, out: np.ndarray | None = None) -> np.ndarray:
    """Draw surface voxels as cubes: depth of the nearest, (C, H, W) float32, metres; inf where none is.

    Parameters
    ----------
    views : PinholeViews
    grid : Grid
    surface : SurfaceVoxels
    out : (C, H, W) float32, optional
        Array to fill and return, to be used again.
    """
    depth = np.empty(views.masks.shape, np.float32) if out is None else out
    depth.fill(np.inf)
    P = views.projections
    _draw(P, _centers(P), surface.indices, surface.faces, grid.origin, grid.voxel_size, depth)
    return depth


def observations(
    views: PinholeViews, images: np.ndarray, grid: Grid, voxels: SurfaceVoxels, depth: np.ndarray, window: int = 0
) -> VoxelVisibility:
    """Find which cameras see each of some surface voxels and with which colour.

    Parameters
    ----------
    views : PinholeViews
    images : (C, H, W, 3) uint8
        Undistorted images on the canvas of the views.
    grid : Grid
    voxels : SurfaceVoxels
    depth : (C, H, W) float32
        Depth buffers of the whole surface.
    window : int
        Radius of the window of `low` and `high`, pixels; 0: the voxel's own pixels.
    """
    N, C = len(voxels.indices), len(views)
    seen = np.zeros((N, C), np.uint8)
    colors = np.zeros((N, C, 3), np.float32)
    low, high = np.zeros((N, C, 3), np.uint8), np.zeros((N, C, 3), np.uint8)
    _look(
        views.projections,
        _centers(views.projections),
        views.masks,
        views.valid,
        images,
        depth,
        voxels.indices,
        voxels.faces,
        grid.origin,
        grid.voxel_size,
        DEPTH_SLACK * grid.voxel_size,
        window,
        seen,
        colors,
        low,
        high,
    )
    return VoxelVisibility(seen, colors, low, high)


def normals(occupancy: Occupancy, surface: np.ndarray) -> np.ndarray:
    """Outward directions at surface voxels (N, 3), away from the occupied voxels within two: (N, 3) float32, unit."""
    n = _away(occupancy.bits, np.ascontiguousarray(surface, np.int32))
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-6)


def _centers(P: np.ndarray) -> np.ndarray:
    return -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _free_faces(bits, surface):
    X, Y, K = bits.shape
    steps = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))
    faces = np.zeros(len(surface), np.uint8)
    for n in range(len(surface)):
        free = 0
        for f in range(6):
            i, j, k = surface[n, 0] + steps[f][0], surface[n, 1] + steps[f][1], surface[n, 2] + steps[f][2]
            inside = 0 <= i < X and 0 <= j < Y and 0 <= k < 32 * K
            if not inside or not (bits[i, j, k >> 5] >> np.uint32(k & 31)) & np.uint32(1):
                free |= 1 << f
        faces[n] = free
    return faces


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _faces_camera(faces, dx, dy, dz, half):
    """Whether a free face is turned to a camera that lies (dx, dy, dz) from the voxel's centre."""
    turned = (dx < -half) | (dx > half) << 1 | (dy < -half) << 2 | (dy > half) << 3
    turned |= (dz < -half) << 4 | (dz > half) << 5
    return (turned & faces) != 0


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(P, centers, surface, faces, origin, edge, depth):
    C, N = len(depth), len(surface)
    places = np.empty((3, N))
    for a in range(3):
        for n in range(N):
            places[a, n] = origin[a] + (surface[n, a] + 0.5) * edge
    box, near = np.empty((4, N), np.int32), np.empty(N, np.float32)
    for c in range(C):
        _project_cubes(P[c], centers[c], places, faces, 0.5 * edge, depth.shape[1:], box, near)
        for n in range(N):
            d = near[n]
            for row in range(box[2, n], box[3, n] + 1):
                for column in range(box[0, n], box[1, n] + 1):
                    if d < depth[c, row, column]:
                        depth[c, row, column] = d


@njit(cache=True, nogil=True, error_model="numpy")
def _project_cubes(P, center, places, faces, half, size, box, near):
    """Find the rectangle (first and last column, first and last row) of each voxel's cube in an image, and its depth.

    It holds the pixels whose centres lie in the rectangle round the projected cube, and the one of the voxel's centre.
    There are none (the last row is -1) where no free face is turned to the camera. Without branches, so that several
    voxels are done at once.
    """
    H, W = np.float64(size[0]), np.float64(size[1])
    p00, p01, p02, p03 = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    p10, p11, p12, p13 = P[1, 0], P[1, 1], P[1, 2], P[1, 3]
    p20, p21, p22, p23 = P[2, 0], P[2, 1], P[2, 2], P[2, 3]
    xs, ys, zs = places[0], places[1], places[2]
    first_column, last_column, first_row, last_row = box[0], box[1], box[2], box[3]
    for n in range(faces.size):
        x, y, z = xs[n], ys[n], zs[n]
        w = p20 * x + p21 * y + p22 * z + p23
        u = (p00 * x + p01 * y + p02 * z + p03) / w
        v = (p10 * x + p11 * y + p12 * z + p13) / w
        du = (abs(p00 - u * p20) + abs(p01 - u * p21) + abs(p02 - u * p22)) * (half / w)
        dv = (abs(p10 - v * p20) + abs(p11 - v * p21) + abs(p12 - v * p22)) * (half / w)
        drawn = _faces_camera(faces[n], center[0] - x, center[1] - y, center[2] - z, half) & (w > 2 * half)
        drawn &= (u + du >= 0) & (v + dv >= 0) & (u - du < W) & (v - dv < H)
        first_column[n] = np.int32(max(min(np.ceil(u - du - 0.5), np.floor(u)), 0.0))
        first_row[n] = np.int32(max(min(np.ceil(v - dv - 0.5), np.floor(v)), 0.0))
        last_column[n] = np.int32(min(max(np.trunc(u + du - 0.5), np.floor(u)), W - 1))
        bottom = np.int32(min(max(np.trunc(v + dv - 0.5), np.floor(v)), H - 1))
        last_row[n] = bottom if drawn else np.int32(-1)
        near[n] = w


@njit(cache=True, nogil=True, error_model="numpy")
def _look(
    P, centers, masks, valid, images, depth, surface, faces, origin, edge, slack, window, seen, colors, low, high
):
    C, H, W = masks.shape
    half = 0.5 * edge
    reaches = half * np.sqrt(P[:, 0, 0] ** 2 + P[:, 0, 1] ** 2 + P[:, 0, 2] ** 2)  # half a voxel's, at a metre, pixels
    for n in range(len(surface)):
        x = origin[0] + (surface[n, 0] + 0.5) * edge
        y = origin[1] + (surface[n, 1] + 0.5) * edge
        z = origin[2] + (surface[n, 2] + 0.5) * edge
        for c in range(C):
            if not _faces_camera(faces[n], centers[c, 0] - x, centers[c, 1] - y, centers[c, 2] - z, half):
                continue
            w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
            if w <= edge:
                continue
            u = (P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 2] * z + P[c, 0, 3]) / w
            v = (P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 2] * z + P[c, 1, 3]) / w
            if not (u >= 0 and v >= 0 and u < W and v < H):
                continue
            iu, iv = int(u), int(v)
            if valid[c, iv, iu] == 0 or w > depth[c, iv, iu] + slack:
                continue
            seen[n, c] = 1
            # mean colour under the voxel's own square, range of colours in the window
            reach = min(reaches[c] / w, 4.0)
            own_u0, own_u1 = int(np.floor(u - reach)), int(np.floor(u + reach))
            own_v0, own_v1 = int(np.floor(v - reach)), int(np.floor(v + reach))
            r = g = b = 0
            count = 0
            r0 = g0 = b0 = np.uint8(255)
            r1 = g1 = b1 = np.uint8(0)
            u0, u1 = max(min(iu - window, own_u0), 0), min(max(iu + window, own_u1), W - 1)
            v0, v1 = max(min(iv - window, own_v0), 0), min(max(iv + window, own_v1), H - 1)
            for row in range(v0, v1 + 1):
                for column in range(u0, u1 + 1):
                    if masks[c, row, column] == 0 and not (row == iv and column == iu):
                        continue
                    red, green, blue = images[c, row, column, 0], images[c, row, column, 1], images[c, row, column, 2]
                    r0, r1 = min(r0, red), max(r1, red)
                    g0, g1 = min(g0, green), max(g1, green)
                    b0, b1 = min(b0, blue), max(b1, blue)
                    if own_v0 <= row <= own_v1 and own_u0 <= column <= own_u1:
                        r += red
                        g += green
                        b += blue
                        count += 1
            colors[n, c, 0] = r / count
            colors[n, c, 1] = g / count
            colors[n, c, 2] = b / count
            low[n, c, 0], low[n, c, 1], low[n, c, 2] = r0, g0, b0
            high[n, c, 0], high[n, c, 1], high[n, c, 2] = r1, g1, b1


@njit(cache=True, nogil=True, error_model="numpy")
def _away(bits, surface):
    X, Y, K = bits.shape
    # of five bits along z: how many are set, and the sum of their offsets −2 … 2
    counts, moments = np.zeros(32, np.int64), np.zeros(32, np.int64)
    for pattern in range(32):
        for b in range(5):
            if (pattern >> b) & 1:
                counts[pattern] += 1
                moments[pattern] += b - 2
    out = np.zeros((len(surface), 3), np.float32)
    for n in range(len(surface)):
        i, j, k = surface[n, 0], surface[n, 1], surface[n, 2]
        word, shift = k >> 5, k & 31
        x = y = z = 0
        for a in range(max(-2, -i), min(3, X - i)):
            for b in range(max(-2, -j), min(3, Y - j)):
                # the word with its neighbours' nearest two bits, so that bit k − 2 comes first
                row = np.int64(bits[i + a, j + b, word]) << 2
                if word > 0:
                    row |= np.int64(bits[i + a, j + b, word - 1]) >> 30
                if word < K - 1:
                    row |= (np.int64(bits[i + a, j + b, word + 1]) & 3) << 34
                pattern = (row >> shift) & 31
                x -= a * counts[pattern]
                y -= b * counts[pattern]
                z -= moments[pattern]
        out[n, 0], out[n, 1], out[n, 2] = x, y, z
    return out
