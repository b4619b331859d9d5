"""Named points in motion: joints, key-points, centres of ellipsoids, or another system's markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from geomocap.export.conventions import Axis
from geomocap.export.export_errors import MotionError
from geomocap.export.names import Names

LEAST_RESIDUAL = 0.0001  # m; 0 stands for points that were not measured


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
    skeleton: Mapping[str, np.ndarray],
    *,
    ellipsoids: Mapping[str, np.ndarray] | None = None,
    keypoints: Mapping[str, np.ndarray] | None = None,
    names: Names | None = None,
    up: Axis = "z",
) -> Markers:
    """Gather a run's joints, key-points and ellipsoid centres as markers; the bodies' centres if it has none.

    An ellipsoid is missing in the frames in which no points belong to it.

    Parameters
    ----------
    skeleton, ellipsoids, keypoints : mapping
        Arrays of `skeleton.npz`, `ellipsoids.npz`, `keypoints.npz`.
    names : Names, optional
        The user's names.
    up : "x", "y" or "z"
    """
    names = names or Names()
    joint_bodies = np.asarray(skeleton["joint_bodies"], int).reshape(-1, 2)
    joints = np.asarray(skeleton["joint_positions"], float)
    n_frames, n_bodies = skeleton["body_positions"].shape[:2]
    body_names = names.body_names(n_bodies, _texts(skeleton, "body_names"))
    labels = list(names.joint_names(joint_bodies, body_names, _texts(skeleton, "joint_names")))
    told = [f"joint between {body_names[a]} and {body_names[b]}" for a, b in joint_bodies]
    positions = [joints.reshape(n_frames, -1, 3)]
    residuals = [np.full((n_frames, len(labels)), np.nan)]
    if keypoints is not None:
        points = keypoint_markers(keypoints, float(skeleton["fps"]), up)
        labels += points.names
        told += points.descriptions or ()
        positions.append(points.positions)
        residuals.append(np.full(points.present.shape, np.nan) if points.residuals is None else points.residuals)
    if ellipsoids is not None:
        bodies = [body_names[b] if 0 <= b < n_bodies else "no body" for b in ellipsoids["body"].astype(int)]
        labels += [f"ellipsoid{k:03d}" for k in range(len(bodies))]
        told += [f"centre of an ellipsoid of {b}" for b in bodies]
        centers = np.asarray(ellipsoids["centers"], float)
        if "counts" in ellipsoids:
            centers = np.where(ellipsoids["counts"][..., None] > 0, centers, np.nan)
        positions.append(centers)
        residuals.append(np.full(centers.shape[:2], np.nan))
    if not labels:
        labels, told = list(body_names), ["centre of a body"] * n_bodies
        positions = [np.asarray(skeleton["body_positions"])]
        residuals = [np.full(positions[0].shape[:2], np.nan)]
    lengths = {len(p) for p in positions}
    if len(lengths) > 1:
        raise MotionError(f"skeleton, key-points and ellipsoids have {sorted(lengths)} frames; run the stages again")
    return Markers(
        tuple(labels),
        np.concatenate(positions, axis=1).astype(float),
        float(skeleton["fps"]),
        up,
        np.concatenate(residuals, axis=1),
        descriptions=tuple(told),
    )


def keypoint_markers(keypoints: Mapping[str, np.ndarray], fps: float, up: Axis = "z") -> Markers:
    """Return the key-points of `keypoints.npz` as markers.

    Their residuals are the standard deviations, but not known in bridged frames: C3D has 0 there, as it is customary
    for points that were not measured but filled in.

    Parameters
    ----------
    keypoints : mapping
        Arrays of `keypoints.npz`, of which only names, positions and radius must be there.
    fps : float
    up : "x", "y" or "z"
    """
    positions = np.asarray(keypoints["positions"], float)
    residuals = None
    if "std" in keypoints and "bridged" in keypoints:
        residuals = np.where(keypoints["bridged"], np.nan, np.maximum(keypoints["std"], LEAST_RESIDUAL))
    return Markers(
        tuple(str(n) for n in keypoints["names"]),
        positions,
        fps,
        up,
        residuals,
        tuple(f"key-point, radius {r * 1000:.0f} mm" for r in keypoints["radius"]),
    )


def _texts(arrays: Mapping[str, np.ndarray], key: str) -> list[str] | None:
    return [str(x) for x in arrays[key]] if key in arrays else None
