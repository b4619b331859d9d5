"""Colour consistency: surface voxels go whose colours differ between the cameras that see them.

The visual hull fills what no silhouette shows, as hollows and the space between limbs. A voxel out there is seen by
cameras that look at different places of the true surface behind it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.carving.carving_settings import ConsistencySettings
from geomocap.carving.occupancy import Occupancy
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.visibility import SurfaceVoxels, VoxelVisibility, depth_buffers, observations
from geomocap.carving.voxel_grid import Grid


def carve_inconsistent(
    views: PinholeViews, images: np.ndarray, grid: Grid, occupancy: Occupancy, settings: ConsistencySettings
) -> Occupancy:
    """Carve inconsistent surface voxels, layer by layer, until nothing changes or `max_passes` is reached.

    Each pass draws the surface anew, so that visibility follows the carving, and takes at most one layer: no hole gets
    deeper than `max_passes` voxels.

    Parameters
    ----------
    views : PinholeViews
    images : (C, H, W, 3) uint8
        Undistorted images on the canvas of the views.
    grid : Grid
    occupancy : Occupancy
        The visual hull.
    settings : ConsistencySettings

    References
    ----------
    Kutulakos & Seitz, A theory of shape by space carving, IJCV 38(3), 2000; the window is the shuffle transform of
    Kutulakos, Approximate N-view stereo, ECCV 2000.
    """
    bits = occupancy.bits.copy()
    judged, bad = np.zeros_like(bits), np.zeros_like(bits)
    changed = np.ones_like(bits, dtype=np.bool_)
    gains = np.ones((len(views), 3), np.float32)
    depth = None
    for step in range(settings.max_passes):
        surface = SurfaceVoxels.of(Occupancy(bits, occupancy.shape))
        depth = depth_buffers(views, grid, surface, depth)
        voxels = surface if step == 0 else surface.select(_near(changed, surface.indices))
        seen = observations(views, images, grid, voxels, depth, settings.window)
        if step == 0 and settings.gain:
            gains = camera_gains(seen)
        deviation = color_deviation(seen, gains, settings.min_cameras)
        _judge(voxels.indices, deviation, settings.threshold, judged, bad)
        changed[:] = False
        if _take(bits, surface.indices, settings.support, judged, bad, changed) == 0:
            break
    return Occupancy(bits, occupancy.shape)


def camera_gains(seen: VoxelVisibility, samples: int = 2000) -> np.ndarray:
    """Estimate one factor a camera and channel that brings its colours to the middle of all, (C, 3) float32.

    The median over voxels that three or more cameras see of (median colour of the cameras / this camera's colour).
    """
    several = np.flatnonzero(_sums(seen.seen) >= 3)
    several = several[:: max(1, len(several) // samples)]
    C = seen.seen.shape[1]
    gains = np.ones((C, 3), np.float32)
    if len(several) < 50:
        return gains
    sees, colors = seen.seen[several], seen.colors[several]
    middle = _middle_colors(sees, colors)
    for c in range(C):
        usable = (sees[:, c] != 0) & (colors[:, c] > 16).all(axis=1)
        if usable.sum() >= 50:
            gains[c] = np.clip(np.median(middle[usable] / colors[usable, c], axis=0), 0.5, 2.0)
    return gains


@njit(cache=True, nogil=True, error_model="numpy")
def _sums(seen):
    """How many cameras see each voxel, (N,) int64."""
    sums = np.zeros(len(seen), np.int64)
    for n in range(seen.shape[0]):
        for c in range(seen.shape[1]):
            sums[n] += seen[n, c]
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def _middle_colors(seen, colors):
    """Median colour of the cameras that see each voxel, (N, 3) float32; there is one at least."""
    N, C = seen.shape
    middle, values = np.empty((N, 3), np.float32), np.empty(C, np.float32)
    for n in range(N):
        for a in range(3):
            count = 0
            for c in range(C):
                if seen[n, c]:
                    count = _insert(colors[n, c, a], values, count)
            middle[n, a] = np.float32(0.5) * (values[(count - 1) // 2] + values[count // 2])
    return middle


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _insert(value, values, count):
    """Insert a value into the sorted first few; return how many there are then."""
    at = count
    while at > 0 and values[at - 1] > value:
        values[at] = values[at - 1]
        at -= 1
    values[at] = value
    return count + 1


def color_deviation(seen: VoxelVisibility, gains: np.ndarray, min_cameras: int) -> np.ndarray:
    """Standard deviation of a voxel's colours about their median, (N,) float32, grey values; -1 where too few see it.

    A camera whose window holds the median colour counts as deviating by nothing.
    """
    out = np.empty(len(seen.seen), np.float32)
    _deviate(seen.seen, seen.colors, seen.low, seen.high, gains, min_cameras, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _deviate(seen, colors, low, high, gains, min_cameras, out):
    N, C = seen.shape
    values = np.empty(C, np.float32)
    for n in range(N):
        count = 0
        total = np.float32(0)
        for a in range(3):
            count = 0
            for c in range(C):
                if seen[n, c]:
                    count = _insert(colors[n, c, a] * gains[c, a], values, count)
            if count < min_cameras:
                break
            middle = np.float32(0.5) * (values[(count - 1) // 2] + values[count // 2])
            for c in range(C):
                if seen[n, c]:
                    below = low[n, c, a] * gains[c, a] - middle
                    above = middle - high[n, c, a] * gains[c, a]
                    off = max(below, above, np.float32(0))
                    total += off * off
        out[n] = np.sqrt(total / (3 * count)) if count >= min_cameras else np.float32(-1)


@njit(cache=True, nogil=True, error_model="numpy")
def _near(changed, surface):
    """Mark the surface voxels within a word or so of a change; what is farther away is not judged again."""
    X, Y, K = changed.shape
    around = np.zeros_like(changed)
    for i in range(X):
        for j in range(Y):
            for k in range(K):
                if changed[i, j, k]:
                    around[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2, max(k - 1, 0) : k + 2] = True
    near = np.empty(len(surface), np.bool_)
    for n in range(len(surface)):
        near[n] = around[surface[n, 0], surface[n, 1], surface[n, 2] >> 5]
    return near


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(voxels, deviation, threshold, judged, bad):
    """Write into the bits which voxels could be judged and which are inconsistent."""
    for n in range(len(voxels)):
        i, j, k = voxels[n, 0], voxels[n, 1], voxels[n, 2]
        bit = np.uint32(1 << (k & 31))
        judged[i, j, k >> 5] &= ~bit
        bad[i, j, k >> 5] &= ~bit
        if deviation[n] >= 0:
            judged[i, j, k >> 5] |= bit
            if deviation[n] > threshold:
                bad[i, j, k >> 5] |= bit


@njit(cache=True, nogil=True, error_model="numpy")
def _take(bits, surface, support, judged, bad, changed):
    """Take from `bits` the inconsistent voxels whose surroundings (5³) are inconsistent too; return how many."""
    X, Y, K = bits.shape
    gone, taken = np.empty(len(surface), np.int64), 0
    for n in range(len(surface)):
        i, j, k = surface[n, 0], surface[n, 1], surface[n, 2]
        bit = np.uint32(1 << (k & 31))
        if not bad[i, j, k >> 5] & bit:
            continue
        n_judged, n_bad = 0, 0
        for a in range(max(i - 2, 0), min(i + 3, X)):
            for b in range(max(j - 2, 0), min(j + 3, Y)):
                for z in range(max(k - 2, 0), min(k + 3, 32 * K)):
                    shift = np.uint32(z & 31)
                    if (judged[a, b, z >> 5] >> shift) & np.uint32(1):
                        n_judged += 1
                        n_bad += (bad[a, b, z >> 5] >> shift) & np.uint32(1)
        if n_bad >= support * n_judged:
            bits[i, j, k >> 5] &= ~bit
            changed[i, j, k >> 5] = True
            gone[taken] = n
            taken += 1
    for n in gone[:taken]:  # what is gone no longer counts for its neighbours
        i, j, k = surface[n, 0], surface[n, 1], surface[n, 2]
        bit = np.uint32(1 << (k & 31))
        judged[i, j, k >> 5] &= ~bit
        bad[i, j, k >> 5] &= ~bit
    return taken
