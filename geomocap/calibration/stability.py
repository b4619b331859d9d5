"""Cameras that were knocked during the recording: which, when and by how much."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.calibration.bundle_adjustment import AdjustedNetwork, Prior, adjust
from geomocap.calibration.initial import in_front
from geomocap.calibration.network import Network
from geomocap.calibration.orientation import ideal_coordinates
from geomocap.calibration.projection import project_point
from geomocap.calibration.target_observations import TargetObservations

LEAST = 6
"""Frames on either side of a knock that are needed to tell it."""


@dataclass(frozen=True)
class Moved:
    """A camera that moved.

    Attributes
    ----------
    camera : str
    before, after : int
        Last frame in the old and first frame in the new position.
    angle_deg : float
    shift : float
        Of the projection centre, metres.
    """

    camera: str
    before: int
    after: int
    angle_deg: float
    shift: float


def moved_of(network: Network, view_of: np.ndarray, frames: np.ndarray) -> tuple[Moved, ...]:
    """Describe the cameras of a network that have two views.

    Parameters
    ----------
    view_of : (C, T) int
        View of each camera in each frame.
    frames : (T,) int
    """
    out = []
    for c, name in enumerate(network.names):
        for k in np.flatnonzero(np.diff(view_of[c])):
            a, b = view_of[c, k], view_of[c, k + 1]
            turn = Rotation.from_matrix(network.rotation[b] @ network.rotation[a].T).magnitude()
            centers = [-network.rotation[v].T @ network.translation[v] for v in (a, b)]
            shift = float(np.linalg.norm(centers[1] - centers[0]))
            out.append(Moved(name, int(frames[k]), int(frames[k + 1]), float(np.degrees(turn)), shift))
    return tuple(out)


def sudden_loss(observations: TargetObservations, chosen: np.ndarray, view_of: np.ndarray) -> tuple[int, int] | None:
    """Find the camera whose targets stop, or begin, to fit the others' at some frame.

    Parameters
    ----------
    chosen : (C, T, 2) int
        From `labelling.identify`.
    view_of : (C, T) int
        Cameras that have two views already are left alone.

    Returns
    -------
    (camera, index of the first frame after the change), or None
    """
    found: np.ndarray = np.asarray((chosen >= 0).any(axis=2))
    elsewhere = found.sum(axis=0)
    best: tuple[float, int, int] | None = None
    for c in range(len(found)):
        if len(np.unique(view_of[c])) > 1:
            continue
        usable = np.flatnonzero((observations.counts[c] >= 2) & (elsewhere - found[c] >= 2))
        fits = found[c, usable].astype(float)
        n = len(usable)
        for k in range(LEAST, n - LEAST + 1):
            contrast = abs(fits[:k].mean() - fits[k:].mean())
            weight = contrast * np.sqrt(k * (n - k))
            if contrast > 0.6 and (best is None or weight > best[0]):
                best = (float(weight), c, int(usable[k]))
    return None if best is None else (best[1], best[2])


def sudden_shift(adjusted: AdjustedNetwork, view_of: np.ndarray, frames: np.ndarray) -> tuple[int, int] | None:
    """Find the camera whose residuals call most for another pose from some frame on.

    A step of the pose is fitted to the residuals of each camera from each frame on; the step that explains most of them
    is returned if it is far beyond chance.

    Returns
    -------
    (camera, index of the first frame after the change), or None
    """
    n = adjusted.network
    r = adjusted.residuals / n.sigmas[:, None]
    J = np.empty((2, 22))
    xy = np.empty(2)
    A = np.zeros((len(n.bar), 2, 6))
    for m in range(len(n.bar)):
        v = n.view[m]
        project_point(n.interior[n.view_camera[v]], n.rotation[v], n.translation[v], n.bars[n.bar[m], n.end[m]], xy, J)
        A[m] = J[:, 13:19] / n.sigmas[m]
    # Gross residuals must not decide
    size = np.linalg.norm(r, axis=1)
    unit = max(float(np.median(size)), 1e-12)
    w = 1.0 / np.maximum(1.0, size / (6 * unit))
    N = np.einsum("mia,mib,m->mab", A, A, w)
    b = np.einsum("mia,mi,m->ma", A, r, w)
    time = np.searchsorted(frames, n.frames)[n.bar]
    best: tuple[float, int, int] | None = None
    for c in range(len(n.names)):
        if len(np.unique(view_of[c])) > 1:
            continue
        own = n.view_camera[n.view] == c
        seen = np.unique(time[own])
        for k in range(LEAST, len(seen) - LEAST + 1):
            gain = 0.0
            for part in (own & (time >= seen[k]), own & (time < seen[k])):
                total, right = N[part].sum(axis=0), b[part].sum(axis=0)
                gain += float(right @ np.linalg.lstsq(total, right, rcond=1e-12)[0])
            if best is None or gain > best[0]:
                best = (gain, c, int(seen[k]))
    if best is None or best[0] < 100 * unit**2:
        return None
    return best[1], best[2]


def refined_changes(
    network: Network, observations: TargetObservations, view_of: np.ndarray, limit: np.ndarray
) -> np.ndarray:
    """Move each change of a camera's pose to the frame that explains its targets best.

    Parameters
    ----------
    view_of : (C, T) int
    limit : (C,) float
        Errors beyond this count no more, pixels.

    Returns
    -------
    view_of : (C, T) int
    """
    out = view_of.copy()
    time = np.searchsorted(observations.frames, network.frames)
    J = np.empty((2, 22))
    xy = np.empty(2)
    for c in range(len(view_of)):
        views = [int(view_of[c, 0]), int(view_of[c, -1])]
        if views[0] == views[1]:
            continue
        cost = np.zeros((2, len(observations.frames)))
        for p, t in enumerate(time):
            targets = observations.pixels[c, t]
            if np.isfinite(targets[:, 0]).sum() < 2:
                continue
            for k, v in enumerate(views):
                for end in network.bars[p]:
                    near = np.inf
                    if project_point(network.interior[c], network.rotation[v], network.translation[v], end, xy, J):
                        near = float(np.nanmin(((targets - xy) ** 2).sum(axis=1)))
                    cost[k, t] += min(near, limit[c] ** 2)
        before = np.r_[0.0, np.cumsum(cost[0])]
        after = np.r_[np.cumsum(cost[1][::-1])[::-1], 0.0]
        total = before + after
        old = int(np.flatnonzero(np.diff(view_of[c]))[0]) + 1
        best = int(np.flatnonzero(total <= total.min() * (1 + 1e-9))[0])
        start = best if total[best] < total[old] else old
        if LEAST <= start <= len(observations.frames) - LEAST:
            out[c] = np.where(np.arange(len(out[c])) < start, views[0], views[1])
    return out


def split_view(view_of: np.ndarray, camera: int, start: int, n_views: int) -> np.ndarray:
    """Give a camera a new view from frame index `start` on."""
    out = view_of.copy()
    out[camera, start:] = n_views
    return out


def with_views(network: Network, view_of: np.ndarray, frames: np.ndarray, camera: int) -> Network:
    """Let a network use a camera's new view, which begins at its old pose."""
    old = int(np.flatnonzero(network.view_camera == camera)[-1])
    time = np.searchsorted(frames, network.frames)[network.bar]
    view = view_of[network.view_camera[network.view], time]
    order = np.lexsort((network.end, view, network.bar))
    return replace(
        network,
        view_camera=np.r_[network.view_camera, camera],
        rotation=np.concatenate([network.rotation, network.rotation[old : old + 1]]),
        translation=np.concatenate([network.translation, network.translation[old : old + 1]]),
        bar=network.bar[order],
        view=view[order],
        end=network.end[order],
        pixels=network.pixels[order],
        sigmas=network.sigmas[order],
    )


def test_split(
    adjusted: AdjustedNetwork,
    view_of: np.ndarray,
    frames: np.ndarray,
    change: tuple[int, int],
    prior: Prior,
    loss: float,
) -> tuple[AdjustedNetwork, np.ndarray] | None:
    """Adjust with a camera in two positions; None if that explains no more than chance."""
    camera, start = change
    split = split_view(view_of, camera, start, adjusted.network.n_views)
    network = in_front(with_views(adjusted.network, split, frames, camera))
    trial = adjust(network, adjusted.columns.free_interior, prior, loss=loss, tolerance=1e-6)
    unit = trial.cost / max(trial.redundancy, 1)
    if adjusted.cost - trial.cost < max(60 * unit, 0.15 * adjusted.cost):
        return None
    return trial, split


def resect(
    network: Network,
    observations: TargetObservations,
    camera: int,
    frames: np.ndarray,
    limit: float,
    rng: np.random.Generator,
    least_fraction: float = 0.4,
) -> np.ndarray | None:
    """Find the pose of a camera from bars that the others know, the ends not told apart.

    Random samples of three frames with all 2³ assignments of their ends.

    Parameters
    ----------
    camera : int
    frames : (n,) int
        Indices of the frames to use.
    limit : float
        Largest error of a fitting target, pixels.
    least_fraction : float
        Fraction of the frames that must fit.

    Returns
    -------
    pose : (3, 4) float or None
    """
    known = {int(f): p for p, f in enumerate(network.frames)}
    usable = [t for t in frames if observations.counts[camera, t] == 2 and int(observations.frames[t]) in known]
    if len(usable) < LEAST:
        return None
    bars = network.bars[[known[int(observations.frames[t])] for t in usable]]
    pixels = observations.pixels[camera, usable, :2]
    all_cameras = np.full((len(observations.cameras), len(usable), 2, 2), np.nan)
    all_cameras[camera] = pixels
    ideal = ideal_coordinates(all_cameras, network.interior, observations.sizes)[camera]
    threshold = limit / network.interior[camera, 0]

    def errors(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        Y = bars @ pose[:, :3].T + pose[:, 3]
        image = Y[..., :2] / np.where(Y[..., 2:] > 1e-6, Y[..., 2:], np.nan)
        straight = np.linalg.norm(image - ideal, axis=2).max(axis=1)
        crossed = np.linalg.norm(image - ideal[:, ::-1], axis=2).max(axis=1)
        swap = crossed < straight
        return np.nan_to_num(np.minimum(straight, crossed), nan=np.inf), swap

    def solve(X: np.ndarray, x: np.ndarray) -> np.ndarray | None:
        ok, rvec, tvec = cv2.solvePnP(X, x, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
        if not ok:
            return None
        return np.column_stack([Rotation.from_rotvec(rvec.ravel()).as_matrix(), tvec.ravel()])

    best: tuple[int, np.ndarray] | None = None
    for _ in range(40):
        sample = rng.choice(len(usable), 3, replace=False)
        for swaps in product((False, True), repeat=3):
            x = np.where(np.array(swaps)[:, None, None], ideal[sample][:, ::-1], ideal[sample])
            pose = solve(bars[sample].reshape(-1, 3), x.reshape(-1, 2))
            if pose is None:
                continue
            error, _ = errors(pose)
            count = int((error < threshold).sum())
            if best is None or count > best[0]:
                best = (count, pose)
        if best is not None and best[0] > 0.9 * len(usable):
            break
    if best is None or best[0] < max(LEAST, least_fraction * len(usable)):
        return None
    pose = best[1]
    for _ in range(3):
        error, swap = errors(pose)
        fits = error < threshold
        x = np.where(swap[fits, None, None], ideal[fits][:, ::-1], ideal[fits])
        better = solve(bars[fits].reshape(-1, 3), x.reshape(-1, 2))
        if better is None:
            break
        pose = better
    return pose
