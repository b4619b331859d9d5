"""Silhouettes as pinhole cameras see them, all cameras in one array, and what each camera can see at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.ndimage import label

from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig

BORDER = 3  # a silhouette that comes as near as this to the border of the image reaches it (pixels)
LEAST_CUT = 3  # if so many of its pixels do
_WHOLE = np.empty((0, 0), np.uint16)  # parts of a pixel, as `cv2.remap` wants them: none
_TILE = 32  # pixels
SPECK = 0.01  # of the area that silhouettes have


@dataclass(frozen=True)
class PinholeViews:
    """Silhouettes of one frame in undistorted images, padded to one common canvas.

    Attributes
    ----------
    names : tuple of C str
    projections : (C, 3, 4) float
        World metres to COLMAP pixels of the canvas.
    masks : (C, H, W) uint8
        1 where the subject is, 0 elsewhere and wherever `valid` is 0.
    valid : (C, H, W) uint8
        1 where the real image sees anything, 0 outside it: beyond its border and in the padding.
    """

    names: tuple[str, ...]
    projections: np.ndarray
    masks: np.ndarray
    valid: np.ndarray

    def __post_init__(self) -> None:
        P = np.ascontiguousarray(self.projections, dtype=np.float64)
        C = len(self.names)
        if P.shape != (C, 3, 4) or self.masks.ndim != 3 or len(self.masks) != C or self.valid.shape != self.masks.shape:
            raise CalibrationError(
                f"{C} cameras with projections {P.shape}, masks {self.masks.shape} and valid {self.valid.shape}: "
                "expected one 3×4 matrix, one mask and one valid region of the same size a camera"
            )
        object.__setattr__(self, "projections", P)

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def of(
        cls,
        projections: np.ndarray,
        masks: Sequence[np.ndarray],
        valid: Sequence[np.ndarray] | None = None,
        names: Sequence[str] | None = None,
    ) -> PinholeViews:
        """Gather masks of pinhole images.

        Parameters
        ----------
        projections : (C, 3, 4) float
        masks : C arrays (H_c, W_c), subject where not 0; sizes may differ
        valid : C arrays (H_c, W_c), seen where not 0; all is seen if not given
        names : C str, optional
        """
        region = [np.ones(m.shape, np.uint8) for m in masks] if valid is None else valid
        seen = pad([(v != 0).view(np.uint8) for v in region])
        inside = pad([(m != 0).view(np.uint8) for m in masks])
        inside &= seen
        return cls(tuple(names or (str(c) for c in range(len(masks)))), np.asarray(projections), inside, seen)

    def cut_off(self) -> np.ndarray:
        """Tell which cameras may see a part of the subject only, (C,) bool: it reaches the border of what they see."""
        cut = np.zeros(len(self), bool)
        window = np.ones((2 * BORDER + 1,) * 2, np.uint8)
        for c, (mask, valid) in enumerate(zip(self.masks, self.valid, strict=True)):
            x, y, w, h = cv2.boundingRect(mask)
            part = slice(max(0, y - BORDER), y + h + BORDER), slice(max(0, x - BORDER), x + w + BORDER)
            within = cv2.erode(valid[part], window, borderType=cv2.BORDER_CONSTANT, borderValue=0)
            cut[c] = np.count_nonzero(mask[part] & (valid[part] ^ within)) >= LEAST_CUT
        return cut

    def blind(self) -> np.ndarray:
        """Tell which cameras see nothing of the subject, (C,) bool: nothing at all, or specks against other cameras."""
        areas = np.array([np.count_nonzero(mask) for mask in self.masks])
        return areas < max(SPECK * float(np.quantile(areas, 0.75)), 1.0)

    def without(self, camera: int) -> PinholeViews:
        """Return the views of all other cameras."""
        keep = [c for c in range(len(self)) if c != camera]
        return PinholeViews(
            tuple(self.names[c] for c in keep), self.projections[keep], self.masks[keep], self.valid[keep]
        )

    def everything(self) -> PinholeViews:
        """Return the same cameras with silhouettes that fill all they see."""
        return PinholeViews(self.names, self.projections, self.valid, self.valid)


@dataclass(frozen=True)
class Undistortion:
    """How the images of a rig become pinhole images: made once for a rig, used for every frame.

    Attributes
    ----------
    names : tuple of C str
    sizes : (C, 2) int
        Width and height of the original images.
    projections : (C, 3, 4) float
        World metres to COLMAP pixels of the undistorted images.
    sources : tuple of C (H'_c, W'_c, 2) int16
        Column and row of the original pixel that holds the centre of each undistorted pixel; 0 where none does.
    maps : tuple of C pairs
        Fixed-point maps for interpolating `cv2.remap`.
    valid : (C, H, W) uint8
        1 where the original image sees the undistorted pixel, on the common canvas.
    """

    names: tuple[str, ...]
    sizes: np.ndarray
    projections: np.ndarray
    sources: tuple[np.ndarray, ...]
    maps: tuple[tuple[np.ndarray, np.ndarray], ...]
    valid: np.ndarray

    @classmethod
    def of(cls, rig: Rig) -> Undistortion:
        """Compute the maps of a rig."""
        flat = rig.undistorted()
        sources, maps, valid = [], [], []
        for c, camera in enumerate(rig.cameras):
            map_x, map_y = rig.undistortion_map(c)
            # the pixel that holds a coordinate is its floor; the maps are coordinates minus 0.5
            x, y = np.floor(map_x.astype(np.float64) + 0.5), np.floor(map_y.astype(np.float64) + 0.5)
            seen = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
            if not camera.is_undistorted():
                seen &= _unfolded(map_x, map_y, flat.cameras[c].principal_point_x, flat.cameras[c].principal_point_y)
            sources.append(np.where(seen, [x, y], 0).transpose(1, 2, 0).astype(np.int16))
            maps.append(cv2.convertMaps(map_x, map_y, cv2.CV_16SC2))
            valid.append(seen.view(np.uint8))
        return cls(rig.names, rig.sizes, flat.projections, tuple(sources), tuple(maps), pad(valid))

    def views(self, masks: Sequence[np.ndarray]) -> PinholeViews:
        """Undistort the silhouettes (H_c, W_c) of one frame: the centre of a pixel decides (nearest neighbour)."""
        self._check(masks)
        C, H, W = self.valid.shape
        flat = np.zeros((C, H, W), np.uint8)
        for c, (mask, source) in enumerate(zip(masks, self.sources, strict=True)):
            subject = (mask != 0).view(np.uint8)
            box = self._box(c, subject)
            if source[box].size > 0:
                flat[(c, *box)] = cv2.remap(subject, source[box], _WHOLE, cv2.INTER_NEAREST)
                flat[(c, *box)] &= self.valid[(c, *box)]
        return PinholeViews(self.names, self.projections, flat, self.valid)

    @cached_property
    def _reaches(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """Least and largest column and row that the seen pixels of each tile come from, (rows, columns, 2) int16."""
        found = []
        for source, valid in zip(self.sources, self.valid, strict=True):
            height, width = source.shape[:2]
            seen = valid[:height, :width, None] != 0
            rows, columns = np.arange(0, height, _TILE), np.arange(0, width, _TILE)
            least = np.minimum.reduceat(np.where(seen, source, np.int16(2**15 - 1)), rows)
            largest = np.maximum.reduceat(np.where(seen, source, np.int16(-1)), rows)
            found.append((np.minimum.reduceat(least, columns, axis=1), np.maximum.reduceat(largest, columns, axis=1)))
        return tuple(found)

    def _box(self, camera: int, subject: np.ndarray) -> tuple[slice, slice]:
        """Rows and columns of the tiles that may come from the subject, (H_c, W_c) uint8, in the original image."""
        x, y, w, h = cv2.boundingRect(subject)
        least, largest = self._reaches[camera]
        touched = np.asarray(((largest >= (x, y)) & (least < (x + w, y + h))).all(axis=2), np.uint8)
        x, y, w, h = (int(n) * _TILE for n in cv2.boundingRect(touched))
        height, width = self.sources[camera].shape[:2]
        return slice(y, min(y + h, height)), slice(x, min(x + w, width))

    def images(self, images: Sequence[np.ndarray], of_subject: PinholeViews | None = None) -> np.ndarray:
        """Undistort the images (H_c, W_c, 3) of one frame, bilinear: (C, H, W, 3) uint8.

        With silhouettes, `of_subject`, only the boxes around them are wanted; the rest stays black.
        """
        self._check(images)
        C, H, W = self.valid.shape
        flat = np.zeros((C, H, W, 3), np.uint8)
        for c, (image, (whole, part)) in enumerate(zip(images, self.maps, strict=True)):
            h, w = whole.shape[:2]
            x, y, wide, high = (0, 0, w, h) if of_subject is None else cv2.boundingRect(of_subject.masks[c])
            box = slice(y, y + high), slice(x, x + wide)
            if wide * high > 0:
                flat[(c, *box)] = cv2.remap(
                    image, whole[box], part[box], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
        return flat

    def _check(self, images: Sequence[np.ndarray]) -> None:
        if len(images) != len(self.names):
            raise CalibrationError(f"{len(images)} images for {len(self.names)} cameras")
        for name, image, (w, h) in zip(self.names, images, self.sizes, strict=True):
            if image.shape[:2] != (h, w):
                raise CalibrationError(
                    f"camera {name}: image of {image.shape[1]}×{image.shape[0]}, but calibrated for {w}×{h}"
                )


def pad(images: Sequence[np.ndarray]) -> np.ndarray:
    """Gather images (H_c, W_c, …) uint8 at the top left of one array (C, H, W, …) with zeros elsewhere."""
    height, width = max(i.shape[0] for i in images), max(i.shape[1] for i in images)
    canvas = np.zeros((len(images), height, width, *images[0].shape[2:]), np.uint8)
    for c, image in enumerate(images):
        canvas[c, : image.shape[0], : image.shape[1]] = image
    return canvas


def _unfolded(map_x: np.ndarray, map_y: np.ndarray, cx: float, cy: float) -> np.ndarray:
    """Where a distortion polynomial is still one-to-one: the region round the principal point with positive area."""
    xv, xu = np.gradient(map_x.astype(np.float64))
    yv, yu = np.gradient(map_y.astype(np.float64))
    upright = np.asarray(xu * yv - xv * yu > 0)
    labels = np.asarray(label(upright)[0])
    h, w = upright.shape
    center = labels[min(max(int(cy), 0), h - 1), min(max(int(cx), 0), w - 1)]
    return (labels == center) & upright
