"""Named points in motion: joints, key-points, centres of ellipsoids, or another system's markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.export.conventions import Axis
from geomocap.export.export_errors import MotionError
from geomocap.export.names import Names
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.model.keypoint_paths import KeyPoints
from geomocap.model.skeleton import Skeleton

LEAST_RESIDUAL = 0.0001  # m; 0 stands for points that were not measured


FARTHEST = 1e9
"""Metres from the origin beyond which nothing is measured; a number that is larger is damaged."""


@dataclass(frozen=True)
class Markers:
    """Named points in motion.

    Attributes
    ----------
    names : tuple of str
        K of them, each once.
    positions : (T, K, 3) float
        Metres; NaN in gaps.
    fps : float
    up : "x", "y" or "z"
        Axis that points up.
    residuals : (T, K) float or None
        How well each was determined, metres; NaN where it isn't known.
    descriptions : tuple of str or None
        One for each marker.
    """

    names: tuple[str, ...]
    positions: np.ndarray
    fps: float
    up: Axis = "z"
    residuals: np.ndarray | None = None
    descriptions: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.positions.ndim != 3 or self.positions.shape[1:] != (len(self.names), 3):
            raise MotionError(f"markers: {len(self.names)} names, but positions of shape {self.positions.shape}")
        if len(self.positions) == 0 or not self.names:
            raise MotionError("markers: holds no markers or no frames")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise MotionError(f"markers: {self.fps} frames per second; expected a positive number")
        if len(set(self.names)) < len(self.names):
            twice = next(n for n in self.names if self.names.count(n) > 1)
            raise MotionError(f"markers: two are called {twice}; give each its own name")
        if (np.abs(self.positions) > FARTHEST).any():
            frame, marker = np.argwhere((np.abs(self.positions) > FARTHEST).any(axis=2))[0]
            far = np.abs(self.positions[frame, marker]).max()
            raise MotionError(f"markers: {self.names[marker]} is {far:.3g} m away in frame {frame}; mend that number")
        if self.residuals is not None and self.residuals.shape != self.positions.shape[:2]:
            raise MotionError(
                f"markers: residuals of shape {self.residuals.shape} for {self.positions.shape[:2]} points"
            )
        if self.descriptions is not None and len(self.descriptions) != len(self.names):
            raise MotionError(f"markers: {len(self.descriptions)} descriptions of {len(self.names)} markers")

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.positions)

    @property
    def present(self) -> np.ndarray:
        """Where a marker has a position: (T, K) bool."""
        return np.isfinite(self.positions).all(axis=-1)


def markers_from_run(
    skeleton: Skeleton,
    *,
    ellipsoids: Ellipsoids | None = None,
    keypoints: KeyPoints | None = None,
    names: Names | None = None,
    up: Axis = "z",
) -> Markers:
    """Gather a run's joints, key-points and ellipsoid centres as markers; the bodies' centres if it has none.

    An ellipsoid is missing in the frames in which no points belong to it.

    Parameters
    ----------
    skeleton : Skeleton
    ellipsoids : Ellipsoids, optional
    keypoints : KeyPoints, optional
    names : Names, optional
        The user's names.
    up : "x", "y" or "z"
    """
    names = names or Names()
    count = skeleton.body_count
    body_names = names.body_names(count, skeleton.body_names)
    labels = list(names.joint_names(skeleton.joint_bodies, body_names, skeleton.joint_names))
    told = [f"joint between {body_names[a]} and {body_names[b]}" for a, b in skeleton.joint_bodies]
    positions = [skeleton.joint_positions]
    residuals = [np.full(skeleton.joint_positions.shape[:2], np.nan)]
    if keypoints is not None:
        points = keypoint_markers(keypoints, skeleton.fps, up)
        labels += points.names
        told += points.descriptions or ()
        positions.append(points.positions)
        residuals.append(np.full(points.present.shape, np.nan) if points.residuals is None else points.residuals)
    if ellipsoids is not None:
        bodies = [body_names[b] if 0 <= b < count else "no body" for b in ellipsoids.bodies]
        labels += [f"ellipsoid{k:03d}" for k in range(len(bodies))]
        told += [f"centre of an ellipsoid of {b}" for b in bodies]
        positions.append(ellipsoids.seen_centers)
        residuals.append(np.full(ellipsoids.counts.shape, np.nan))
    if not labels:
        labels, told = list(body_names), ["centre of a body"] * count
        positions = [skeleton.body_positions]
        residuals = [np.full(positions[0].shape[:2], np.nan)]
    lengths = {len(p) for p in positions}
    if len(lengths) > 1:
        raise MotionError(f"skeleton, key-points and ellipsoids have {sorted(lengths)} frames; run the stages again")
    return Markers(
        tuple(labels),
        np.concatenate(positions, axis=1).astype(float),
        skeleton.fps,
        up,
        np.concatenate(residuals, axis=1),
        descriptions=tuple(told),
    )


def keypoint_markers(points: KeyPoints, fps: float, up: Axis = "z") -> Markers:
    """Return key-points as markers.

    Their residuals are the standard deviations, but not known in bridged frames: C3D has 0 there, as it is customary
    for points that were not measured but filled in.
    """
    paths = points.paths
    return Markers(
        points.names,
        paths.positions.astype(float),
        fps,
        up,
        np.where(paths.bridged, np.nan, np.maximum(paths.std, LEAST_RESIDUAL)),
        tuple(f"key-point, radius {r * 1000:.0f} mm" for r in points.radius),
    )
