"""Where patches are looked for in the next frame: their own motion, optical flow in all cameras, their neighbours'."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.tracking.frame_views import FrameViews

_FLOW_WINDOW = (13, 13)
_FLOW_LEVELS = 3
_FLOW_SIGMA = 1.5  # px; residual from which a camera's flow counts less
_WEAK = 0.3  # m; a shift that no camera sees is taken as zero with this standard deviation


def extrapolate(
    positions: np.ndarray, frames: np.ndarray, velocity: np.ndarray, spin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move patches on by their last shift (N, 3) and turn (N, 3), a rotation vector in world axes."""
    return positions + velocity, Rotation.from_rotvec(spin).as_matrix() @ frames


def image_flow(previous: FrameViews, view: FrameViews, positions: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Follow the patches' centres in each image with pyramidal Lucas–Kanade: (N, C, 2) px, NaN where not followed.

    Parameters
    ----------
    previous, view : FrameViews
        The frame that the positions belong to, and the next.
    positions : (N, 3) float, metres, world
    seen : (N, C) bool
        Cameras that see the patch in the previous frame.
    """
    pixel, _ = previous.project(positions)
    flow = np.full(pixel.shape, np.nan)
    for c in range(view.count):
        rows = np.flatnonzero(seen[:, c] & np.isfinite(pixel[:, c]).all(axis=1))
        both = (previous.masks[c] | view.masks[c]) != 0
        if not len(rows) or not both.any():
            continue
        box = _box(both, 24)
        before, after = (np.clip(v.levels[-1, c][box], 0, 255).astype(np.uint8) for v in (previous, view))
        corner = np.array([box[1].start, box[0].start], float)
        start = (pixel[rows, c] - corner).astype(np.float32)[:, None]
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            before, after, start, start.copy(), winSize=_FLOW_WINDOW, maxLevel=_FLOW_LEVELS
        )
        moved = (found - start)[:, 0].astype(float)
        flow[rows, c] = np.where(status == 1, moved, np.nan)
    return flow


def lift_flow(view: FrameViews, positions: np.ndarray, flow: np.ndarray, neighbours: int = 8) -> np.ndarray:
    """Find the shifts in space (N, 3), metres, that explain image flow (N, C, 2), robustly, median over neighbours."""
    P = view.projections
    pixel, depth = view.project(positions)
    # ∂(x, y)/∂X = (p_xy − xy p_z) / depth
    slope = (P[None, :, :2, :3] - pixel[..., None] * P[None, :, 2:, :3]) / depth[:, :, None, None]
    known = np.isfinite(flow).all(axis=2) & np.isfinite(slope).all(axis=(2, 3))
    slope, value = np.where(known[..., None, None], slope, 0.0), np.where(known[..., None], flow, 0.0)
    weight = known.astype(float)
    shift = np.zeros_like(positions)
    flat = slope.reshape(len(slope), -1, 3)
    for _ in range(4):
        weighted = flat * np.repeat(weight, 2, axis=1)[:, :, None]
        N = np.swapaxes(weighted, 1, 2) @ flat + np.eye(3) / _WEAK**2
        b = np.swapaxes(weighted, 1, 2) @ value.reshape(len(value), -1, 1)
        shift = np.linalg.solve(N, b)[:, :, 0]
        residual = np.linalg.norm(value - (flat @ shift[:, :, None]).reshape(value.shape), axis=2)
        weight = known / (1 + (residual / _FLOW_SIGMA) ** 2)
    enough = np.flatnonzero(known.sum(axis=1) >= 2)
    if len(enough) < neighbours:
        return shift
    near = cKDTree(positions[enough]).query(positions, neighbours)[1]
    return np.median(shift[enough[near]], axis=1)


def carried(
    positions: np.ndarray,
    frames: np.ndarray,
    source: np.ndarray,
    new_positions: np.ndarray,
    new_frames: np.ndarray,
    which: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Move patches `which` (A,) by the rigid motions of patches `source` (A, K): positions (A, K, 3), frames."""
    turn = new_frames[source] @ np.swapaxes(frames[source], -1, -2)
    arm = positions[which][:, None] - positions[source]
    return new_positions[source] + np.einsum("akij,akj->aki", turn, arm), turn @ frames[which][:, None]


def nearest(positions: np.ndarray, of: np.ndarray, among: np.ndarray, count: int) -> np.ndarray:
    """Return the `count` nearest of `among` (B,) to each patch `of` (A,), itself left out: (A, ≤ count) indices."""
    count = min(count, len(among) - 1)
    if count < 1:
        return np.zeros((len(of), 0), int)
    found = among[cKDTree(positions[among]).query(positions[of], count + 1)[1]]
    # put the patch itself last, then cut it off
    order = np.argsort(found == of[:, None], axis=1, kind="stable")
    return np.take_along_axis(found, order, axis=1)[:, :count]


def _box(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )
