"""Which camera sees which surface voxel, and the colour that it sees there.

Surface voxels are drawn into one depth buffer a camera, each as the rectangle round its projected cube. A voxel is seen
if one of its free faces is turned to the camera and nothing lies clearly before its centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.voxel_grid import Grid

TOGETHER = 256  # voxels that all cameras look at before the next ones
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
    _draw(P, camera_centers(P), surface.indices, surface.faces, grid.origin, grid.voxel_size, depth)
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
        camera_centers(views.projections),
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


def enclosing_normals(surface: np.ndarray) -> np.ndarray:
    """Outward unit normals (N, 3) of the surface voxels (N, 3) of a solid, away from it and from what it encloses.

    They are 0 where it is a single voxel thick. Planes through points leave the side open, and on thin parts
    neighbours don't tell it: of the hull of a flapping bird 0.3 to 0.5 of the normals that agree with their neighbours'
    (Hoppe et al. 1992) pointed inwards, of a galloping stag's 0.1; of these 0.01 and 0.002.
    """
    if not len(surface):
        return np.zeros((0, 3))
    places = surface - surface.min(axis=0) + 1  # with room around
    free = np.ones(places.max(axis=0) + 2, bool)
    free[tuple(places.T)] = False
    part, _ = ndimage.label(free)
    return normals(Occupancy.of_dense(part != part[0, 0, 0]), places).astype(float)


def camera_centers(P: np.ndarray) -> np.ndarray:
    """Centres of cameras with projections (C, 3, 4): (C, 3), metres."""
    return -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _free_faces(bits, surface):
    X, Y, K = bits.shape
    none = np.uint32(0)
    around = np.zeros(6, np.uint32)  # of a word's voxels, which neighbours are occupied
    last_i, last_j, last_w = -1, -1, -1
    faces = np.zeros(len(surface), np.uint8)
    for n in range(len(surface)):
        i, j, w = surface[n, 0], surface[n, 1], surface[n, 2] >> 5
        if i != last_i or j != last_j or w != last_w:
            last_i, last_j, last_w = i, j, w
            word = bits[i, j, w]
            around[0] = bits[i - 1, j, w] if i > 0 else none
            around[1] = bits[i + 1, j, w] if i < X - 1 else none
            around[2] = bits[i, j - 1, w] if j > 0 else none
            around[3] = bits[i, j + 1, w] if j < Y - 1 else none
            around[4] = word << np.uint32(1) | (bits[i, j, w - 1] >> np.uint32(31) if w > 0 else none)
            around[5] = word >> np.uint32(1) | (bits[i, j, w + 1] << np.uint32(31) if w < K - 1 else none)
        bit, occupied = np.uint32(surface[n, 2] & 31), np.uint32(0)
        for f in range(6):
            occupied |= ((around[f] >> bit) & np.uint32(1)) << np.uint32(f)
        faces[n] = ~occupied & np.uint32(63)
    return faces


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _faces_camera(faces, dx, dy, dz, half):
    """Whether a free face is turned to a camera that lies (dx, dy, dz) from the voxel's centre."""
    turned = (dx < -half) | (dx > half) << 1 | (dy < -half) << 2 | (dy > half) << 3
    turned |= (dz < -half) << 4 | (dz > half) << 5
    return (turned & faces) != 0


@njit(cache=True, nogil=True, error_model="numpy")
def _places(surface, origin, edge):
    """Centres of voxels, (3, N) float64, metres."""
    places = np.empty((3, len(surface)))
    for a in range(3):
        for n in range(len(surface)):
            places[a, n] = origin[a] + (surface[n, a] + 0.5) * edge
    return places


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(P, centers, surface, faces, origin, edge, depth):
    C, N = len(depth), len(surface)
    places = _places(surface, origin, edge)
    box, near, drawn = np.empty((4, N), np.int32), np.empty(N, np.float32), np.empty(N, np.uint32)
    for c in range(C):
        _project_cubes(P[c], centers[c], places, faces, 0.5 * edge, depth.shape[1:], box, near)
        flat, width = depth[c].ravel(), depth.shape[2]
        left, right, top, bottom = box[0], box[1], box[2], box[3]
        count = 0
        for n in range(N):
            drawn[count] = n
            count += bottom[n] >= 0
        for n in drawn[:count]:
            d = near[n]
            if left[n] == right[n] and top[n] == bottom[n]:  # nearly all where voxels are as small as pixels
                at = np.uint32(top[n] * width + left[n])
                flat[at] = min(flat[at], d)
                continue
            for row in range(top[n], bottom[n] + 1):
                for column in range(left[n], right[n] + 1):
                    at = np.uint32(row * width + column)
                    flat[at] = min(flat[at], d)


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
def voxel_boxes(P, center, surface, faces, origin, edge, size, box):
    """Rectangles (4, N) of surface voxels in one image: first and last column, first and last row; see `_draw`."""
    _project_cubes(
        P, center, _places(surface, origin, edge), faces, 0.5 * edge, size, box, np.empty(len(surface), np.float32)
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _look(
    P, centers, masks, valid, images, depth, surface, faces, origin, edge, slack, window, seen, colors, low, high
):
    C, N = len(masks), len(surface)
    places = _places(surface, origin, edge)
    pixel, point = np.empty(TOGETHER, np.int32), np.empty((3, TOGETHER))
    for begin in range(0, N, TOGETHER):  # what is written of so many stays in the cache
        part = slice(begin, min(begin + TOGETHER, N))
        for c in range(C):
            _project_centers(P[c], centers[c], places[:, part], faces[part], edge, masks.shape[1:], pixel, point)
            half = 0.5 * edge * np.sqrt(P[c, 0, 0] ** 2 + P[c, 0, 1] ** 2 + P[c, 0, 2] ** 2)  # at a metre, pixels
            _look_from(
                masks[c], valid[c], images[c], depth[c], pixel, point, half, slack, window,
                seen[part, c], colors[part, c], low[part, c], high[part, c],
            )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _look_from(mask, valid, image, depth, pixel, point, half, slack, window, seen, colors, low, high):
    """Fill in what one camera sees of some voxels, from `_project_centers`."""
    H, W = np.int64(mask.shape[0]), np.int64(mask.shape[1])
    subject, see, nearest, grey = mask.ravel(), valid.ravel(), depth.ravel(), image.ravel()
    for n in range(seen.size):
        if pixel[n] < 0:
            continue
        center, u, v, w = np.uint32(pixel[n]), point[0, n], point[1, n], point[2, n]
        if see[center] == 0 or w > nearest[center] + slack:
            continue
        seen[n] = 1
        # mean colour under the voxel's own square, range of colours in the window
        iu, iv = np.int64(u), np.int64(v)
        reach = min(half / w, 4.0)
        own_u0, own_u1 = np.int64(np.floor(u - reach)), np.int64(np.floor(u + reach))
        own_v0, own_v1 = np.int64(np.floor(v - reach)), np.int64(np.floor(v + reach))
        r = g = b = 0
        count = 0
        r0 = g0 = b0 = np.uint8(255)
        r1 = g1 = b1 = np.uint8(0)
        u0, u1 = max(min(iu - window, own_u0), 0), min(max(iu + window, own_u1), W - 1)
        v0, v1 = max(min(iv - window, own_v0), 0), min(max(iv + window, own_v1), H - 1)
        for row in range(v0, v1 + 1):
            for column in range(u0, u1 + 1):
                at = np.uint32(row * W + column)
                if subject[at] == 0 and at != center:
                    continue
                place = np.uint32(3) * at
                red, green, blue = grey[place], grey[place + np.uint32(1)], grey[place + np.uint32(2)]
                r0, r1 = min(r0, red), max(r1, red)
                g0, g1 = min(g0, green), max(g1, green)
                b0, b1 = min(b0, blue), max(b1, blue)
                if own_v0 <= row <= own_v1 and own_u0 <= column <= own_u1:
                    r += red
                    g += green
                    b += blue
                    count += 1
        colors[n, 0], colors[n, 1], colors[n, 2] = r / count, g / count, b / count
        low[n, 0], low[n, 1], low[n, 2] = r0, g0, b0
        high[n, 0], high[n, 1], high[n, 2] = r1, g1, b1


@njit(cache=True, nogil=True, error_model="numpy")
def _project_centers(P, center, places, faces, edge, size, pixel, point):
    """Project the voxels' centres into an image: pixel (row · width + column), and its coordinates and depth.

    The pixel is -1 outside of the image, before the camera, and where no free face is turned to the camera. Without
    branches, as `_project_cubes`.
    """
    H, W = np.float64(size[0]), np.float64(size[1])
    p00, p01, p02, p03 = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    p10, p11, p12, p13 = P[1, 0], P[1, 1], P[1, 2], P[1, 3]
    p20, p21, p22, p23 = P[2, 0], P[2, 1], P[2, 2], P[2, 3]
    xs, ys, zs = places[0], places[1], places[2]
    us, vs, ws = point[0], point[1], point[2]
    for n in range(faces.size):
        x, y, z = xs[n], ys[n], zs[n]
        w = p20 * x + p21 * y + p22 * z + p23
        u = (p00 * x + p01 * y + p02 * z + p03) / w
        v = (p10 * x + p11 * y + p12 * z + p13) / w
        inside = _faces_camera(faces[n], center[0] - x, center[1] - y, center[2] - z, 0.5 * edge) & (w > edge)
        inside &= (u >= 0) & (v >= 0) & (u < W) & (v < H)
        at = np.int32(v) * np.int32(size[1]) + np.int32(u)
        pixel[n] = at if inside else np.int32(-1)
        us[n], vs[n], ws[n] = u, v, w


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
