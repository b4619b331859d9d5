"""What tracking needs of one frame: blurred grey images, silhouettes and the depth of the surface in every camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from scipy.stats import norm

from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.visibility import SurfaceVoxels, depth_buffers
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import GeometryError
from geomocap.model.frame_geometry import Voxels

_ALL_FACES = 63  # of a voxel: one bit each
_MARGIN_PX = 2  # pixels by which silhouettes are widened
_WIDE = 3.0  # blurs; the mean over that is taken away
_ROUGHNESS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
# Fraction of the pixels that tell the noise. Noise of 0.7 to 5 grey levels, rounded, under blurred texture came out
# within 3 %. Background counts, too: from the subject alone, fine texture of a distant man passed for noise, and his
# tracks drifted by 4.0 instead of 3.5 mm (median).
_SMOOTHEST = 0.25
_EMPTY = 1e-3  # fraction of subject under the blur below which a pixel has no value


@dataclass(frozen=True)
class FrameViews:
    """One frame as the pinhole cameras see it.

    Attributes
    ----------
    levels : (L, C, H, W) float32
        Grey images without background, blurred, coarsest first. The finest is less its mean over a wider piece: light
        and shade, which are wide, don't turn with the surface, and would pull patches along.
    noise : (L, C) float64
        Variance of what is no picture but noise in the levels, grey levels squared.
    masks : (C, H, W) uint8
        1 where the subject is.
    allowed : (C, H, W) uint8
        1 where the subject may be: the silhouettes widened by two pixels, and what the real image doesn't see.
    depth : (C, H, W) float32
        Depth of the surface along the optical axis, metres; inf where there is none.
    projections : (C, 3, 4) float
        World metres to *array indices* (COLMAP pixel minus 0.5), third row of unit length: it gives the depth.
    centers : (C, 3) float
        Camera centres, metres, world.
    surface : (M, 3) float
        Centres of the surface voxels, metres, world.
    voxel_size : float, metres
    """

    levels: np.ndarray
    noise: np.ndarray
    masks: np.ndarray
    allowed: np.ndarray
    depth: np.ndarray
    projections: np.ndarray
    centers: np.ndarray
    surface: np.ndarray
    voxel_size: float

    @classmethod
    def of(
        cls,
        views: PinholeViews,
        images: np.ndarray,
        voxels: Voxels,
        blurs_px: Sequence[float] = (2.5, 0.8),
        reduction: int = 1,
    ) -> FrameViews:
        """Prepare a frame.

        Parameters
        ----------
        views : PinholeViews
            Undistorted silhouettes.
        images : (C, H, W, 3) uint8
            Undistorted images on the same canvas.
        voxels : Voxels
            Surface of the subject.
        blurs_px : sequence of float
            Standard deviations of the Gaussian blurs, coarsest first, pixels (reduced ones).
        reduction : int
            So many pixels in each direction are averaged before all else.

        Raises
        ------
        GeometryError
            If the images don't fit the silhouettes, or there is no surface.
        """
        C, H, W = views.masks.shape
        if images.shape != (C, H, W, 3):
            raise GeometryError(f"images have shape {images.shape}, their silhouettes {views.masks.shape}")
        if not len(voxels.indices):
            raise GeometryError("a frame without surface voxels can't be tracked; carve it again")
        noise = np.array([_noise_around(i, m, v) for i, m, v in zip(images, views.masks, views.valid, strict=True)])
        if reduction > 1:
            views, images = _reduced(views, images, reduction)
            C, H, W = views.masks.shape
        P = views.projections / np.linalg.norm(views.projections[:, 2:, :3], axis=2, keepdims=True)
        P = P * np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
        P[:, :2] -= 0.5 * P[:, 2:]
        levels = np.zeros((len(blurs_px), C, H, W), np.float32)
        wide = np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8)
        allowed, blind = np.empty_like(views.masks), views.blind()  # an empty silhouette has no say
        for c in range(C):
            allowed[c] = cv2.dilate(views.masks[c], wide) | (views.valid[c] == 0) | blind[c]
            _blur(images[c], views.masks[c], blurs_px, levels[:, c])
        low = voxels.indices.min(axis=0)
        top = voxels.indices.max(axis=0) + 1 - low
        shape = (int(top[0]), int(top[1]), int(top[2]))
        grid = Grid(np.asarray(voxels.origin) + low * voxels.voxel_size, voxels.voxel_size, shape)
        indices = np.ascontiguousarray(voxels.indices - low, np.int32)
        depth = depth_buffers(views, grid, SurfaceVoxels(indices, np.full(len(indices), _ALL_FACES, np.uint8)))
        centers = -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0]
        return cls(
            levels,
            _noise_kept(blurs_px)[:, None] * noise / reduction**2,
            views.masks,
            allowed,
            depth,
            np.ascontiguousarray(P),
            centers,
            voxels.points,
            float(voxels.voxel_size),
        )

    @property
    def count(self) -> int:
        """Number of cameras C."""
        return len(self.masks)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (N, 3): array indices x, y (N, C, 2) and depths (N, C), metres."""
        pixel, depth = np.empty((len(points), self.count, 2)), np.empty((len(points), self.count))
        _project(self.projections, np.asarray(points, np.float64), pixel, depth)
        return pixel, depth

    def pixel_size(self, points: np.ndarray) -> np.ndarray:
        """Return the length that one pixel covers at world points (N, 3) in each camera: (N, C) float, metres."""
        focal = np.sqrt(np.abs(np.linalg.det(self.projections[:, :, :3])))
        depth = np.einsum("cj,nj->nc", self.projections[:, 2, :3], points) + self.projections[:, 2, 3]
        return np.maximum(depth, 0.0) / focal

    def depths(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the depths of world points (N, 3), and of the surface at the pixels that show them.

        Both are (N, C) float, metres; that of the surface is NaN where none is seen.
        """
        pixel, depth = self.project(points)
        surface = np.empty(depth.shape)
        _look_up(pixel, self.depth, surface)
        return depth, surface

    def may_be_subject(self, points: np.ndarray, asked: np.ndarray | None = None) -> np.ndarray:
        """Whether world points (N, 3) lie in the silhouettes of all cameras that see them, or close by: (N,) bool.

        `asked` (N, C) bool: of these cameras only, if given.
        """
        allowed = np.empty((len(points), self.count))
        _look_up(self.project(points)[0], self.allowed, allowed)
        return ((allowed != 0) | (False if asked is None else ~asked)).all(axis=1)


@njit(cache=True, nogil=True, error_model="numpy")
def _project(P: np.ndarray, points: np.ndarray, pixel: np.ndarray, depth: np.ndarray) -> None:
    """Project points (N, 3) with P (C, 3, 4) into `pixel` (N, C, 2), NaN behind a camera, and `depth` (N, C)."""
    for n in range(len(points)):
        x, y, z = points[n]
        for c in range(len(P)):
            w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
            depth[n, c] = w
            for i in range(2):
                v = P[c, i, 0] * x + P[c, i, 1] * y + P[c, i, 2] * z + P[c, i, 3]
                pixel[n, c, i] = v / w if w > 0 else np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _look_up(pixel: np.ndarray, images: np.ndarray, values: np.ndarray) -> None:
    """Read images (C, H, W) at the nearest of their pixels into `values` (N, C); NaN outside and where infinite."""
    C, H, W = images.shape
    for n in range(len(pixel)):
        for c in range(C):
            values[n, c] = np.nan
            x, y = pixel[n, c, 0], pixel[n, c, 1]
            if x >= -0.5 and y >= -0.5 and x <= W and y <= H:
                column, row = int(np.rint(x)), int(np.rint(y))
                if column < W and row < H and np.isfinite(images[c, row, column]):
                    values[n, c] = images[c, row, column]


def _reduced(views: PinholeViews, images: np.ndarray, factor: int) -> tuple[PinholeViews, np.ndarray]:
    """Average `factor` × `factor` pixels of the subject; what is left over on the right and below is cut off."""
    C, H, W = views.masks.shape
    height, width = H // factor, W // factor
    masks, valid = np.zeros((C, height, width), np.uint8), np.zeros((C, height, width), np.uint8)
    small = np.zeros((C, height, width, 3), np.uint8)
    for c in range(C):
        seen = views.valid[c][: height * factor, : width * factor]
        valid[c] = np.minimum.reduce([seen[y::factor, x::factor] for y in range(factor) for x in range(factor)])
        x, y, w, h = cv2.boundingRect(views.masks[c])
        low, high = (y // factor, x // factor), (min(-(-(y + h) // factor), height), min(-(-(x + w) // factor), width))
        rows, columns = high[0] - low[0], high[1] - low[1]
        if min(w, h, rows, columns) <= 0:
            continue
        box = slice(low[0], high[0]), slice(low[1], high[1])
        part = slice(low[0] * factor, high[0] * factor), slice(low[1] * factor, high[1] * factor)
        inside = views.masks[c][part]
        fraction = cv2.resize(inside.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
        colored = cv2.copyTo(images[c][part], inside).astype(np.float32)
        value = cv2.resize(colored, (columns, rows), interpolation=cv2.INTER_AREA)
        small[(c, *box)] = np.rint(value / np.maximum(fraction, 1 / factor**2)[:, :, None]).clip(0, 255)
        masks[(c, *box)] = fraction >= 0.5
    P = views.projections.copy()
    P[:, :2] /= factor
    return PinholeViews(views.names, P, masks & valid, valid), small


def _blur(image: np.ndarray, mask: np.ndarray, blurs_px: Sequence[float], out: np.ndarray) -> None:
    """Blur the subject without its background into `out` (L, H, W); 0 far from it."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return
    margin = int(np.ceil(4 * max(blurs_px))) + 1
    part = (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )
    inside = mask[part].astype(np.float32)
    grey = cv2.cvtColor(np.ascontiguousarray(image[part]), cv2.COLOR_RGB2GRAY).astype(np.float32) * inside
    for level, blur in enumerate(blurs_px):
        mean, weight = _mean(grey, inside, blur)
        if level == len(blurs_px) - 1:
            mean -= _mean(grey, inside, _WIDE * blur)[0]
        out[(level, *part)] = np.where(weight > _EMPTY, mean, 0.0)


def _noise_around(image: np.ndarray, mask: np.ndarray, valid: np.ndarray) -> float:
    """Return the noise of an image (H, W, 3) around its subject: what is behind it is often smoother than itself."""
    x, y, width, height = cv2.boundingRect(mask)
    part = slice(y, y + height), slice(x, x + width)
    if not mask.any():
        return 0.0
    return image_noise(cv2.cvtColor(np.ascontiguousarray(image[part]), cv2.COLOR_RGB2GRAY), valid[part])


def image_noise(grey: np.ndarray, where: np.ndarray) -> float:
    """Return the variance of the noise of an image (H, W) uint8, grey levels squared, where a mask is not 0.

    Second differences in both directions leave noise and hardly any picture (Immerkær 1996, "Fast noise variance
    estimation", Computer Vision and Image Understanding 64). Texture adds to them: the smoothest quarter tells.
    """
    rough = np.abs(cv2.filter2D(grey, cv2.CV_16S, _ROUGHNESS))[cv2.erode(where, np.ones((3, 3), np.uint8)) != 0]
    if not len(rough):
        return 0.0
    # these are whole numbers, each stands for half a level to both sides
    counts = np.cumsum(np.bincount(rough))
    ends = np.append(0.0, np.arange(len(counts)) + 0.5)
    quantile = np.interp(_SMOOTHEST, np.append(0.0, counts / counts[-1]), ends)
    return float(quantile / (norm.ppf(0.5 + 0.5 * _SMOOTHEST) * np.linalg.norm(_ROUGHNESS))) ** 2


def _noise_kept(blurs_px: Sequence[float]) -> np.ndarray:
    """Return how much of the variance of an image's noise is left in each level, see `FrameViews`: (L,) float."""
    side = 2 * int(np.ceil(4 * _WIDE * max(blurs_px))) + 1
    point = np.zeros((side, side), np.float32)
    point[side // 2, side // 2] = 1.0
    blurs = (*blurs_px, _WIDE * blurs_px[-1])
    spread_out = np.stack([cv2.GaussianBlur(point, (0, 0), blur) for blur in blurs]).astype(np.float64)
    spread_out[-2] -= spread_out[-1]
    return np.asarray((spread_out[:-1] ** 2).sum(axis=(1, 2)))


def _mean(grey: np.ndarray, inside: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian mean of the subject's grey levels, and the fraction of subject in it; 0 without any."""
    weight = cv2.GaussianBlur(inside, (0, 0), blur)
    value = cv2.GaussianBlur(grey, (0, 0), blur)
    return np.where(weight > _EMPTY, value / np.maximum(weight, _EMPTY), 0.0), weight
