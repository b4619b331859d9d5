"""Epipolar tangents: what two cameras must agree on in the outline of any subject, whatever its shape.

A plane through the centres of two cameras that touches the subject touches its silhouette in both images. The two
outermost such planes are seen by both cameras, so the angles at which they find them, round the baseline, must be
equal. No correspondence is needed, and only the convex hull of a silhouette counts.

References
----------
Sinha, Pollefeys, McMillan, Camera network calibration from dynamic silhouettes, CVPR 2004.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from geomocap.model.rig import Rig

MARGIN = 2  # pixels from the border of an image in which an outline may be where the image ends
WIDEST = 0.75 * np.pi  # angle round a baseline that a silhouette may fill: more, and the epipole is in it or beside it


@dataclass(frozen=True)
class OutlineRays:
    """Convex hulls of silhouettes as rays of their cameras.

    Attributes
    ----------
    rays : (C, F, K, 3) float
        Unit vectors in the cameras' axes; a hull of fewer corners repeats its first.
    cut : (C, F, K) bool
        The corner is where the image ends.
    seen : (C, F) bool
        There is a silhouette.
    focal : (C,) float
        Focal lengths, pixels.
    """

    rays: np.ndarray
    cut: np.ndarray
    seen: np.ndarray
    focal: np.ndarray

    @classmethod
    def of(cls, rig: Rig, frames: Sequence[Sequence[np.ndarray]]) -> OutlineRays:
        """Take the outlines of silhouettes.

        Parameters
        ----------
        rig : Rig
        frames : F sequences of C arrays (H, W)
            Subject where not 0, as the cameras saw it; an image may be reduced. Its largest piece counts.
        """
        hulls = [[_hull(mask) for mask in frame] for frame in frames]
        most = max((len(hull) for frame in hulls for hull, _ in frame), default=0)
        shape = len(rig), len(frames), max(most, 1)
        rays, cut, seen = np.zeros((*shape, 3)), np.zeros(shape, bool), np.zeros(shape[:2], bool)
        for f, frame in enumerate(hulls):
            for c, ((hull, ends), mask) in enumerate(zip(frame, frames[f], strict=True)):
                if not len(hull):
                    continue
                pixels = (hull + 0.5) * (rig.sizes[c] / mask.shape[::-1])
                flat = np.column_stack([rig.cameras[c].cam_from_img(pixels), np.ones(len(hull))])
                corners = np.minimum(np.arange(shape[2]), len(hull) * (np.arange(shape[2]) < len(hull)))
                rays[c, f] = (flat / np.linalg.norm(flat, axis=1, keepdims=True))[corners]
                cut[c, f], seen[c, f] = ends[corners], True
        return cls(rays, cut, seen, np.array([camera.mean_focal_length() for camera in rig.cameras]))

    def some(self, frames: slice) -> OutlineRays:
        """Return the outlines of some of the frames."""
        return OutlineRays(self.rays[:, frames], self.cut[:, frames], self.seen[:, frames], self.focal)


def _hull(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convex hull of the largest piece of a mask, (K, 2) array indices, and which corners are at the image's border."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((mask != 0).view(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros((0, 2)), np.zeros(0, bool)
    piece = labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    contours, _ = cv2.findContours(piece.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(contours[0])[:, 0].astype(float)
    ends = (hull < MARGIN) | (hull > np.array(mask.shape[::-1]) - 1 - MARGIN)
    return hull, ends.any(axis=1)


def camera_pairs(count: int) -> list[tuple[int, int]]:
    """All pairs of so many cameras."""
    return list(combinations(range(count), 2))


def tangent_misfits(
    outlines: OutlineRays, rotations: np.ndarray, centers: np.ndarray, pairs: Sequence[tuple[int, int]]
) -> np.ndarray:
    """Disagreement of cameras about the outermost planes through their centres.

    Parameters
    ----------
    outlines : OutlineRays
    rotations : (C, 3, 3) float
        Camera axes from world axes.
    centers : (C, 3) float, metres
    pairs : sequence of P pairs of cameras

    Returns
    -------
    (P, F, 2) float, pixels
        Difference of the angles in standard deviations of an outline that is uncertain by one pixel. NaN where a
        camera sees no silhouette, or its tangent is where the image ends, or the epipole is in the silhouette.
    """
    misfits = np.full((len(pairs), outlines.rays.shape[1], 2), np.nan)
    for row, (a, b) in enumerate(pairs):
        baseline = centers[b] - centers[a]
        length = float(np.linalg.norm(baseline))
        if length == 0:
            continue
        baseline = baseline / length
        rays = [outlines.rays[c] @ rotations[c] for c in (a, b)]
        towards = rays[0].mean(axis=1) + rays[1].mean(axis=1)
        x = towards - (towards @ baseline)[:, None] * baseline
        x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
        y = np.cross(baseline, x)
        angles, variances, known = [], [], outlines.seen[a] & outlines.seen[b]
        ends = np.zeros((outlines.rays.shape[1], 2), bool)
        for c, ray in zip((a, b), rays, strict=True):
            angle = np.arctan2(np.einsum("fki,fi->fk", ray, y), np.einsum("fki,fi->fk", ray, x))
            known = known & (np.ptp(angle, axis=1) < WIDEST)
            at = np.stack([angle.argmin(axis=1), angle.argmax(axis=1)], axis=1)
            touching = np.take_along_axis(ray, at[..., None], axis=1)
            angles.append(np.take_along_axis(angle, at, axis=1))
            squared = np.maximum(1.0 - (touching @ baseline) ** 2, 1e-12)  # sine of the angle at the baseline
            variances.append(1.0 / (squared * outlines.focal[c] ** 2))
            ends |= np.take_along_axis(outlines.cut[c], at, axis=1)
        misfit = (angles[0] - angles[1]) / np.sqrt(variances[0] + variances[1])
        misfits[row] = np.where(known[:, None] & ~ends, misfit, np.nan)
    return misfits
