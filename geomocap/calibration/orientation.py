"""Relative orientation of two cameras, and the chain of them over all cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from geomocap.calibration.projection import camera_of
from geomocap.errors import CalibrationError
from geomocap.model.triangulation import nearest_to_rays


@dataclass(frozen=True)
class Relative:
    """Relative orientation of two cameras, scaled by the bar.

    Attributes
    ----------
    pose : (3, 4) float
        Second camera from first, metres.
    weight : float
        Number of frames that agree with it, less if the rays are nearly parallel or the bar's length varies.
    """

    pose: np.ndarray
    weight: float


def ideal_coordinates(pixels: np.ndarray, interior: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Remove interior orientation and distortion from pixels (C, …, 2); NaN stays NaN."""
    out = np.full(pixels.shape, np.nan)
    for c in range(len(pixels)):
        good = np.isfinite(pixels[c]).all(axis=-1)
        if good.any():
            camera = camera_of(interior[c], (int(sizes[c, 0]), int(sizes[c, 1])))
            out[c][good] = camera.cam_from_img(pixels[c][good])
    return out


def relative_orientation(a: np.ndarray, b: np.ndarray, F: np.ndarray, length: float) -> Relative | None:
    """Relative orientation of two cameras from their essential matrix, scaled by the bars.

    Parameters
    ----------
    a, b : (n, 2, 2) float
        Ends of the bars in either camera, paired, ideal image coordinates (camera constant 1).
    F : (3, 3) float
        Matrix with x_bᵀ F x_a = 0; the nearest essential matrix is used (Hartley & Zisserman, 9.6).
    length : float
        Distance of the ends, metres.
    """
    U, _, Vt = np.linalg.svd(F)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    ra = np.concatenate([a.reshape(-1, 2), np.ones((2 * len(a), 1))], axis=1)
    rb = np.concatenate([b.reshape(-1, 2), np.ones((2 * len(b), 1))], axis=1)
    ra /= np.linalg.norm(ra, axis=1, keepdims=True)
    rb /= np.linalg.norm(rb, axis=1, keepdims=True)
    best: tuple[int, np.ndarray, np.ndarray, np.ndarray] | None = None
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            X = nearest_to_rays(np.stack([np.zeros(3), -R.T @ t])[:, None], np.stack([ra, rb @ R]))
            front = (X[:, 2] > 0) & ((X @ R.T + t)[:, 2] > 0)
            if best is None or front.sum() > best[0]:
                best = (int(front.sum()), R, t, np.where(front[:, None], X, np.nan))
    if best is None:
        return None
    count, R, t, X = best
    bars = X.reshape(-1, 2, 3)
    whole = np.isfinite(bars).all(axis=(1, 2))
    if whole.sum() < 6:
        return None
    lengths = np.linalg.norm(bars[whole, 0] - bars[whole, 1], axis=1)
    scale = length / np.median(lengths)
    angles = np.degrees(np.arccos(np.clip(np.abs(np.sum(ra * (rb @ R), axis=1)), -1, 1)))
    spread = np.median(np.abs(np.log(lengths / np.median(lengths))))
    weight = count * min(1.0, float(np.median(angles)) / 20.0) / (0.1 + spread)
    return Relative(np.column_stack([R, scale * t]), weight)


def chain(relatives: dict[tuple[int, int], Relative], names: tuple[str, ...]) -> np.ndarray:
    """Chain relative orientations over all cameras by the maximum spanning tree.

    Returns
    -------
    cam_from_world : (C, 3, 4) float
        The world is the camera at the root.

    Raises
    ------
    CalibrationError
        If the cameras fall apart into sets that share no bars.
    """
    C = len(names)
    cost = np.zeros((C, C))
    for (i, j), relative in relatives.items():
        cost[i, j] = 1.0 / (1e-6 + relative.weight)
    tree = minimum_spanning_tree(cost).toarray()
    root = int(np.argmax(((tree + tree.T) > 0).sum(axis=1)))
    order, parent = breadth_first_order(tree, root, directed=False)
    if len(order) < C:
        missing = ", ".join(names[c] for c in range(C) if c not in set(order.tolist()))
        raise CalibrationError(
            f"camera {missing}: its images of the bar can't be connected with the other cameras; "
            "record more positions where it and a neighbour see both ends"
        )
    poses = np.tile(np.eye(3, 4), (C, 1, 1))
    for c in order[1:]:
        p = parent[c]
        if (p, c) in relatives:
            R, t = relatives[p, c].pose[:, :3], relatives[p, c].pose[:, 3]
        else:
            R = relatives[c, p].pose[:, :3].T
            t = -R @ relatives[c, p].pose[:, 3]
        poses[c, :, :3] = R @ poses[p, :, :3]
        poses[c, :, 3] = R @ poses[p, :, 3] + t
    return poses
