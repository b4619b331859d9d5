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


@dataclass(frozen=True)
class Tangents:
    """Where the outermost planes through the centres of pairs of cameras touch the subject.

    Attributes
    ----------
    pairs : (P, 2) int
        The cameras.
    touching : (P, 2, F, 2, 3) float
        Of each pair and camera: rays of the corners that are touched, in the camera's axes.
    towards : (P, F, 3) float
        A direction, in the world, from which the angles round the baseline are counted.
    known : (P, F, 2) bool
        Not where a camera sees no silhouette, or its tangent is where the image ends, or the epipole is in the
        silhouette.
    focal : (C,) float
        Focal lengths, pixels.
    """

    pairs: np.ndarray
    touching: np.ndarray
    towards: np.ndarray
    known: np.ndarray
    focal: np.ndarray

    @classmethod
    def of(cls, outlines: OutlineRays, rotations: np.ndarray, centers: np.ndarray) -> Tangents:
        """Find them for all pairs of cameras with axes (C, 3, 3), from the world's, and centres (C, 3), metres."""
        pairs = np.array(list(combinations(range(len(centers)), 2)), int).reshape(-1, 2)
        shape = len(pairs), outlines.rays.shape[1]
        touching, towards = np.zeros((shape[0], 2, shape[1], 2, 3)), np.zeros((*shape, 3))
        known = np.zeros((*shape, 2), bool)
        world = outlines.rays @ rotations[:, None]
        for row, (a, b) in enumerate(pairs):
            baseline = centers[b] - centers[a]
            length = float(np.linalg.norm(baseline))
            if length == 0:
                continue
            towards[row] = world[a].mean(axis=1) + world[b].mean(axis=1)
            x, y = _across(baseline / length, towards[row])
            known[row] = (outlines.seen[a] & outlines.seen[b])[:, None]
            for side, c in enumerate((a, b)):
                angle = np.arctan2((world[c] * y[:, None]).sum(axis=2), (world[c] * x[:, None]).sum(axis=2))
                at = np.stack([angle.argmin(axis=1), angle.argmax(axis=1)], axis=1)
                touching[row, side] = np.take_along_axis(outlines.rays[c], at[..., None], axis=1)
                known[row] &= ~np.take_along_axis(outlines.cut[c], at, axis=1)
                known[row] &= (np.ptp(angle, axis=1) < WIDEST)[:, None]
        return cls(pairs, touching, towards, known, outlines.focal)

    def of_camera(self, camera: int) -> np.ndarray:
        """Which pairs a camera has part in, (P,) bool."""
        result: np.ndarray = (self.pairs == camera).any(axis=1)
        return result

    def misfits(self, rotations: np.ndarray, centers: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Disagreement of pairs of cameras about the planes through the same corners, if the cameras are elsewhere.

        Right for moves so small that no other corners are touched.

        Parameters
        ----------
        rotations : (C, 3, 3) float
            Camera axes from world axes.
        centers : (C, 3) float, metres
        rows : optional
            Pairs that are asked, all by default.

        Returns
        -------
        (P, F, 2) float, pixels
            Difference of the angles in standard deviations of an outline that is uncertain by one pixel. NaN where
            not known.
        """
        pairs = self.pairs[rows]
        baseline = centers[pairs[:, 1]] - centers[pairs[:, 0]]
        baseline = baseline / np.maximum(np.linalg.norm(baseline, axis=1, keepdims=True), 1e-12)
        x, y = _across(baseline[:, None], self.towards[rows])
        rays = self.touching[rows] @ rotations[pairs][:, :, None]
        angle = np.arctan2((rays * y[:, None, :, None]).sum(axis=-1), (rays * x[:, None, :, None]).sum(axis=-1))
        # squared sine of the angle at the baseline
        squared = np.maximum(1.0 - (rays * baseline[:, None, None, None]).sum(axis=-1) ** 2, 1e-12)
        variance = (1.0 / (squared * self.focal[pairs][:, :, None, None] ** 2)).sum(axis=1)
        return np.where(self.known[rows], (angle[:, 0] - angle[:, 1]) / np.sqrt(variance), np.nan)


def _across(baseline: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors across baselines (…, 3), one as near as can be to directions (…, 3), the other across that too."""
    x = towards - (towards * baseline).sum(axis=-1, keepdims=True) * baseline
    x /= np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
    return x, np.cross(baseline, x)
