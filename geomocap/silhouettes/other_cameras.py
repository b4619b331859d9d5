"""What the other cameras say of each camera's pixels: a coarse volume between them.

A voxel that holds the subject is background to a camera in one of 50 cases only (MISSED); one that doesn't is often
subject to it, before or behind what is (CROSSED). With a camera's log odds o at the voxel's pixel this makes it
say

    log (p(pixel | voxel holds the subject) / p(pixel | it doesn't))
        = log ((1 - MISSED) e^o + MISSED) - log (CROSSED e^o + 1 - CROSSED)

Undecided pixels say nothing, nor do cameras that don't see the voxel if their image cuts the subject off. The word of
the others on a pixel is their sum for the voxel on its ray that they confirm best. How sure it is that the subject is
there depends on how large what they confirm is around that ray: by its width across the ray and its length along it.
Space that no camera looks into is mostly thin.

References
----------
Franco & Boyer, Fusion of multi-view silhouette cues using a space occupancy grid, ICCV 2005 (the sensor model).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from scipy.ndimage import label

from geomocap.carving.block_kernels import summed
from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.hull import heard
from geomocap.carving.silhouette_views import PinholeViews, Undistortion, pad
from geomocap.carving.subject_bounds import SMALLEST_PART, halve, space_seen
from geomocap.carving.voxel_grid import Grid
from geomocap.model.rig import Rig
from geomocap.silhouettes.likelihood import SURE

MISSED = 0.02  # how often a camera takes a pixel of the subject for background
CROSSED = 0.3  # how often a ray near the subject meets it elsewhere
RESOLUTION = 96  # voxels along the subject
LONGEST = 480  # longer side of the images that are asked, pixels
MARGIN = 0.04  # of the longest side of the subject's box
TOLERANT = 4  # from so many cameras on the box may be bounded by all but one
STEPS = 16.0  # of a say, per unit of log odds
NOWHERE = -12.0  # word on pixels before which the others see no common volume at all
CELLS, MOST_CELLS = 24, 30_000  # of that box along the subject, and in all
DOUBLINGS = 4  # of the distance of the farthest camera, beyond which the subject is said to have no end
SPECK = 0.02  # of the largest piece of a first silhouette: smaller ones bound no box
YES = float(np.log(1.0 / CROSSED))  # what a sure camera says at most


@dataclass(frozen=True)
class Reduced:
    """One camera's image, reduced by a whole factor.

    Attributes
    ----------
    step : int
        Pixels of the image along one of the reduced one.
    size : (int, int)
        Width and height of the part of the image that fills whole reduced pixels.
    maps : (H', W') float32, twice
        Where the pixels of the reduced undistorted image come from, array indices into the reduced image.
    origin : (3,) float64
    rays : (H'', W'', 3) float32
        Of the reduced pixels' centres, world, unit length.
    """

    step: int
    size: tuple[int, int]
    maps: tuple[np.ndarray, np.ndarray]
    origin: np.ndarray
    rays: np.ndarray

    def voxel(self, grid: Grid) -> float:
        """Return how large a voxel in the middle of a grid looks, reduced pixels."""
        row, column = self.rays.shape[0] // 2, self.rays.shape[1] // 2
        apart = float(np.linalg.norm(self.rays[row, column] - self.rays[row, column - 1]))
        middle = grid.origin + 0.5 * grid.voxel_size * np.array(grid.shape)
        return grid.voxel_size / (apart * max(float(np.linalg.norm(middle - self.origin)), grid.voxel_size))

    def shrink(self, image: np.ndarray) -> np.ndarray:
        """Reduce an image (H, W) of this camera."""
        w, h = self.size
        return cv2.resize(image[:h, :w], (w // self.step, h // self.step), interpolation=cv2.INTER_AREA)

    def enlarge(self, image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Bring a reduced image back to the size (H, W); what it doesn't reach is as its border."""
        w, h = self.size
        full = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_LINEAR))
        return np.pad(full, ((0, shape[0] - h), (0, shape[1] - w)), mode="edge") if full.shape != shape else full


@dataclass(frozen=True)
class Word:
    """What the other cameras say of one camera's pixels.

    Attributes
    ----------
    odds : (H, W) float32
        Log odds of the voxel on a pixel's ray that they confirm best.
    size : (H, W) float32
        How large what they confirm is around the ray, voxels: geometric mean of its width and its length; 0: nothing.
    """

    odds: np.ndarray
    size: np.ndarray


@dataclass(frozen=True)
class OtherCameras:
    """The cameras that are asked about each other's pixels.

    Attributes
    ----------
    names : tuple of C str
    cameras : tuple of C Reduced
    projections : (C, 3, 4) float
        World metres to pixels of the reduced undistorted images.
    valid : (C, H, W) uint8
        1 where the real image sees anything.
    """

    names: tuple[str, ...]
    cameras: tuple[Reduced, ...]
    projections: np.ndarray
    valid: np.ndarray

    @classmethod
    def of(cls, rig: Rig) -> OtherCameras:
        """Compute the reduced images' maps and rays, once for a rig."""
        cameras, projections, valid = [], [], []
        flat = Undistortion.of(rig)
        for c, (w, h) in enumerate(rig.sizes):
            step = max(2, round(max(w, h) / LONGEST))
            whole = (int(w) // step * step, int(h) // step * step)
            map_x, map_y = rig.undistortion_map(c)
            size = map_x.shape[1] // step, map_x.shape[0] // step
            inner = slice(size[1] * step), slice(size[0] * step)
            small = [
                (np.asarray(cv2.resize(m[inner], size, interpolation=cv2.INTER_AREA)) + 0.5) / step - 0.5
                for m in (map_x, map_y)
            ]
            seen = flat.valid[c, : map_x.shape[0], : map_x.shape[1]][inner]
            valid.append(cv2.erode(seen, np.ones((step, step), np.uint8))[step // 2 :: step, step // 2 :: step])
            projections.append(np.diag([1 / step, 1 / step, 1.0]) @ flat.projections[c])
            v, u = np.mgrid[0 : whole[1] : step, 0 : whole[0] : step] + step / 2
            origin, rays = rig.rays(c, np.column_stack([u.ravel(), v.ravel()]))
            rays = rays.astype(np.float32).reshape(*u.shape, 3)
            cameras.append(Reduced(step, whole, (small[0], small[1]), np.array(origin), rays))
        return cls(rig.names, tuple(cameras), np.array(projections), pad(valid))

    def words(self, odds: list[np.ndarray]) -> list[Word] | None:
        """Ask the other cameras.

        Parameters
        ----------
        odds : list of C arrays (H, W) float32
            Log odds of each pixel with its neighbours' vote.

        Returns
        -------
        list of C Word, or None
            None if they see no common volume, or one without end: then nobody can confirm anything.
        """
        small = [camera.shrink(o) for camera, o in zip(self.cameras, odds, strict=True)]
        views, flat = self._views(small)
        grid = _grid(views)
        if grid is None:
            return None
        beyond = np.where(views.cut_off(), 0, say(np.full(len(small), -SURE)))
        says = np.where(views.valid, say(flat), beyond[:, None, None]).astype(np.int8)
        blind = views.blind()
        says[blind], beyond[blind] = 0, 0
        volume = np.empty((len(small), *grid.shape), np.int8)
        gather(self.projections, says, beyond, grid.origin, grid.voxel_size, volume)
        total = volume.sum(axis=0, dtype=np.int16)
        least = STEPS * agreement(len(small))
        enough = int(max(STEPS * SURE, least))
        result = []
        for c, camera in enumerate(self.cameras):
            others = total - volume[c]
            about = camera.origin, camera.rays, others, grid.origin, grid.voxel_size
            word, length = best_on_rays(*about, least, enough)
            width = 2.0 * cv2.distanceTransform((length > 0).view(np.uint8), cv2.DIST_L2, 3) / camera.voxel(grid)
            size = np.sqrt(width * length)
            result.append(Word(*(camera.enlarge(image, odds[c].shape) for image in (word, size))))
        return result

    def _views(self, small: list[np.ndarray]) -> tuple[PinholeViews, np.ndarray]:
        """First silhouettes and log odds, undistorted and reduced."""
        flat = np.zeros(self.valid.shape, np.float32)
        for c, (camera, image) in enumerate(zip(self.cameras, small, strict=True)):
            moved = cv2.remap(image, *camera.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            flat[c, : moved.shape[0], : moved.shape[1]] = moved
        masks = np.stack([large_pieces(f > 0) for f in flat]) & self.valid
        return PinholeViews(self.names, self.projections, masks, self.valid), flat


def _grid(views: PinholeViews) -> Grid | None:
    """Voxels round what the cameras have in common; None if that is nothing or has no end."""
    sighted = np.count_nonzero(~views.blind())
    if sighted < 2:
        return None
    settings = [HullSettings(tolerance=1)] if sighted >= TOLERANT else []
    if not settings or views.cut_off().any():
        settings.append(HullSettings(min_views=2))
    boxes = [box for box in (common_box(views, s) for s in settings) if box is not None]
    if not boxes:
        return None
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    margin = MARGIN * float((high - low).max())
    return Grid.of_box(low - margin, high + margin, resolution=RESOLUTION)


def common_box(views: PinholeViews, settings: HullSettings) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the box of what the cameras have in common: as `subject_box`, coarser, and None also if it has no end.

    Returns
    -------
    low, high : (3,) float, metres, world
    """
    heeded, unseen, least = heard(views, settings)
    subject = summed(heeded.masks)
    tables = subject, summed(heeded.valid) if unseen.any() else subject, unseen, least
    center, reach = space_seen(views)
    for _ in range(DOUBLINGS):
        origin, edge = center - reach, 2 * reach
        cells = np.zeros((1, 3), np.int64)
        while 0 < len(cells) < MOST_CELLS and np.ptp(cells, axis=0).max() + 1 < CELLS:
            cells = halve(heeded, settings, tables, cells, origin, edge)
            edge /= 2
        if len(cells) == 0:
            return None
        if cells.min() > 0 and cells.max() < round(2 * reach / edge) - 1:
            low = cells.min(axis=0)
            dense = np.zeros(cells.max(axis=0) - low + 1, bool)
            dense[tuple((cells - low).T)] = True
            parts, _ = label(dense, np.ones((3, 3, 3)))
            part = parts[tuple((cells - low).T)]
            sizes = np.bincount(part)
            cells = cells[sizes[part] >= SMALLEST_PART * sizes.max()]
            return origin + cells.min(axis=0) * edge, origin + (cells.max(axis=0) + 1) * edge
        reach *= 2  # the subject reaches the border of the space that was searched
    return None


def large_pieces(mask: np.ndarray) -> np.ndarray:
    """Leave specks out of a first silhouette (H, W) bool: uint8."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA]
    keep = areas >= SPECK * areas[1:].max(initial=1)
    keep[0] = False
    return keep[labels].view(np.uint8)


def agreement(cameras: int) -> float:
    """Log odds from which the others of so many cameras may be said to confirm a pixel: half of what they can say."""
    return 0.5 * YES * (cameras - 1)


def say(odds: np.ndarray) -> np.ndarray:
    """What a camera with these log odds says of a voxel, in STEPS per unit of log odds, int8.

    The equation at the head of this module.
    """
    e = np.exp(np.clip(odds, -20, 20))
    return np.rint(STEPS * np.log(((1 - MISSED) * e + MISSED) / (CROSSED * e + 1 - CROSSED))).astype(np.int8)


@njit(cache=True, nogil=True, error_model="numpy")
def gather(P, says, beyond, origin, edge, volume):
    """Read what each camera says of each voxel's centre.

    Parameters
    ----------
    P : (C, 3, 4) float
    says : (C, H, W) int8
    beyond : (C,) int8
        What it says of voxels outside its image.
    origin : (3,) float
    edge : float
    volume : (C, X, Y, Z) int8
        Filled in.
    """
    C, H, W = says.shape
    heights = origin[2] + (np.arange(volume.shape[3]) + 0.5) * edge
    pixels = np.empty(heights.size, np.int32)
    for c in range(C):
        said = says[c].ravel()
        along = P[c, 0, 2], P[c, 1, 2], P[c, 2, 2]
        for i in range(volume.shape[1]):
            x = origin[0] + (i + 0.5) * edge
            for j in range(volume.shape[2]):
                y = origin[1] + (j + 0.5) * edge
                a = P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 3]
                b = P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 3]
                d = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 3]
                for k in range(heights.size):  # without branches, several at once
                    w = d + along[2] * heights[k]
                    u, v = (a + along[0] * heights[k]) / w, (b + along[1] * heights[k]) / w
                    inside = (w > 0) & (u >= 0) & (u < W) & (v >= 0) & (v < H)
                    pixel = np.int32(v) * np.int32(W) + np.int32(u)
                    pixels[k] = pixel if inside else np.int32(-1)
                column = volume[c, i, j]
                for k in range(heights.size):
                    column[k] = said[np.uint32(pixels[k])] if pixels[k] >= 0 else beyond[c]


@njit(cache=True, nogil=True, error_model="numpy")
def best_on_rays(origin, rays, others, low, edge, least, enough):
    """Largest sum of what the other cameras say of a voxel on each ray, and how many voxels they confirm.

    Parameters
    ----------
    origin : (3,) float
    rays : (H, W, 3) float32
    others : (X, Y, Z) int16
        What all other cameras together say.
    low : (3,) float
        Lowest corner of the grid.
    edge : float
    least : float
        Sum from which a voxel is confirmed.
    enough : int
        Sum beyond which more makes no difference.

    Returns
    -------
    best : (H, W) float32
        Log odds; NOWHERE at least and on rays that miss the grid.
    length : (H, W) float32
        Voxels.
    """
    result, length = np.empty(rays.shape[:2], np.float32), np.empty(rays.shape[:2], np.float32)
    shape = others.shape
    columns, cells = np.uint32(shape[1]), np.uint32(shape[2])
    flat = others.ravel()
    start, ray = np.empty(3), np.empty(3)
    for y in range(rays.shape[0]):
        for x in range(rays.shape[1]):
            near, far = 0.0, 1e30
            for axis in range(3):
                ray[axis] = rays[y, x, axis]
                d = ray[axis] if abs(ray[axis]) >= 1e-9 else 1e-9
                t0, t1 = (low[axis] - origin[axis]) / d, (low[axis] + shape[axis] * edge - origin[axis]) / d
                near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
            best, confirmed = np.int64(NOWHERE * STEPS), 0
            if near < far:
                for axis in range(3):
                    start[axis] = (origin[axis] + near * ray[axis] - low[axis]) / edge
                # Steps of a voxel; rounding may put the first and the last ones outside
                n, last = 0, int((far - near) / edge)
                while n <= last and not _inside(start, ray, n + 0.5, shape):
                    n += 1
                while n < last and not _inside(start, ray, last + 0.5, shape):
                    last -= 1
                a, b, c, u, v, w = start[0], start[1], start[2], ray[0], ray[1], ray[2]
                while n <= last:
                    t = n + 0.5
                    i, j, k = np.int32(a + t * u), np.int32(b + t * v), np.int32(c + t * w)
                    at = (np.uint32(i) * columns + np.uint32(j)) * cells + np.uint32(k)
                    best = max(best, np.int64(flat[at]))
                    confirmed += flat[at] >= least
                    n += 1
            result[y, x], length[y, x] = min(best, enough) / STEPS, confirmed
    return result, length


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(start, ray, t, shape):
    """Whether a ray is in the grid at t; all in voxels."""
    for axis in range(3):
        if not 0 <= start[axis] + t * ray[axis] < shape[axis]:
            return False
    return True
