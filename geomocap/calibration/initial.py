"""Approximate values from nothing but image sizes: pairings, relative orientations, a chain over all cameras.

1. Every pair of cameras: which bar ends belong together, and its fundamental matrix (`pairs`).
2. For each of several camera constants: relative orientations, their scale by the bar, and the tree of the best ones.
3. A short robust adjustment of each; the camera constant with the smallest cost is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from geomocap.calibration.adjustment import Adjusted, Prior, adjust, image_residuals, interior_indices
from geomocap.calibration.network import Network
from geomocap.calibration.pairs import Pairing, pair_ends
from geomocap.calibration.projection import N_INTERIOR, camera_of
from geomocap.calibration.settings import BarSettings
from geomocap.calibration.sightings import Sightings
from geomocap.errors import CalibrationError


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


def two_candidates(sightings: Sightings) -> np.ndarray:
    """Return the two candidates of the images that have just two, (C, T, 2, 2) float, NaN elsewhere."""
    two = np.full((*sightings.pixels.shape[:2], 2, 2), np.nan)
    just = sightings.counts == 2
    two[just] = sightings.pixels[just][:, :2]
    return two


def image_coordinates(pixels: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Bring pixels (C, …, 2) to the image's centre as 0 and its longer side as 1."""
    shape = (len(sizes), *([1] * (pixels.ndim - 2)), 2)
    return (pixels - sizes.reshape(shape) / 2) / sizes.max(axis=1).reshape(*shape[:-1], 1)


def pair_all(sightings: Sightings, settings: BarSettings) -> dict[tuple[int, int], Pairing]:
    """Pair the bar ends of all pairs of cameras."""
    x = image_coordinates(two_candidates(sightings), sightings.sizes)
    found = {}
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            rng = np.random.default_rng((settings.seed, i, j))
            pairing = pair_ends(x[i], x[j], settings.pairing_threshold, settings.pairing_samples, rng)
            if pairing is not None and len(pairing.frames) >= 0.4 * pairing.used:
                found[i, j] = pairing
    return found


def consistent_ends(sightings: Sightings, pairings: dict[tuple[int, int], Pairing]) -> tuple[np.ndarray, np.ndarray]:
    """Tell the ends apart over all cameras that the pairings connect, frame by frame.

    Returns
    -------
    member : (C, T) bool
        Whether the camera is in the frame's largest connected set.
    swapped : (C, T) bool
        Whether its first candidate is the bar's second end.
    """
    C, T = sightings.counts.shape
    group = np.tile(np.arange(C)[:, None], (1, T))
    swapped = np.zeros((C, T), dtype=bool)
    for (i, j), p in sorted(pairings.items(), key=lambda item: -len(item[1].frames)):
        for t, swap in zip(p.frames, p.swapped, strict=True):
            gi, gj = group[i, t], group[j, t]
            if gi != gj:
                joined = group[:, t] == gj
                if swapped[i, t] ^ swapped[j, t] != swap:
                    swapped[joined, t] ^= True
                group[joined, t] = gi
    member = np.zeros((C, T), dtype=bool)
    for t in range(T):
        ids, counts = np.unique(group[:, t], return_counts=True)
        if counts.max() >= 2:
            member[:, t] = group[:, t] == ids[counts.argmax()]
    return member, swapped


def triangulate(origins: np.ndarray, directions: np.ndarray, point: np.ndarray, n_points: int) -> np.ndarray:
    """Points nearest to their rays, least squares.

    Parameters
    ----------
    origins, directions : (M, 3) float
        Rays, directions of unit length.
    point : (M,) int
        The point that each ray belongs to.
    n_points : int

    Returns
    -------
    points : (n_points, 3) float
        NaN with fewer than two rays, or parallel ones.
    """
    P = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    A = np.zeros((n_points, 3, 3))
    b = np.zeros((n_points, 3))
    np.add.at(A, point, P)
    np.add.at(b, point, np.einsum("mij,mj->mi", P, origins))
    good = np.linalg.det(A) > 1e-9
    out = np.full((n_points, 3), np.nan)
    out[good] = np.linalg.solve(A[good], b[good][:, :, None])[:, :, 0]
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
    index = np.arange(len(ra))
    best: tuple[int, np.ndarray, np.ndarray, np.ndarray] | None = None
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            origins = np.concatenate([np.zeros_like(ra), np.broadcast_to(-R.T @ t, rb.shape)])
            X = triangulate(origins, np.concatenate([ra, rb @ R]), np.concatenate([index, index]), len(ra))
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


def weak_prior(sizes: np.ndarray, focal: np.ndarray, settings: BarSettings) -> Prior:
    """What every lens obeys: principal point near the middle, nearly square pixels, moderate distortion."""
    C = len(sizes)
    side = sizes.max(axis=1).astype(float)
    mean = np.zeros((C, N_INTERIOR))
    mean[:, 0] = mean[:, 1] = focal
    mean[:, 2:4] = sizes / 2
    sigma = np.full((C, N_INTERIOR), np.inf)
    sigma[:, 0] = sigma[:, 1] = settings.focal_sigma * focal
    sigma[:, 2] = sigma[:, 3] = settings.principal_point_sigma * side
    sigma[:, 4:6] = settings.radial_sigma
    sigma[:, 6:8] = settings.tangential_sigma
    sigma[:, 8:12] = settings.radial_sigma
    sigma[:, 12] = settings.aspect_sigma * focal
    return Prior(mean, sigma, settings.aspect_sigma * focal)


def ideal_coordinates(pixels: np.ndarray, interior: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Remove interior orientation and distortion from pixels (C, …, 2); NaN stays NaN."""
    out = np.full(pixels.shape, np.nan)
    for c in range(len(pixels)):
        good = np.isfinite(pixels[c]).all(axis=-1)
        if good.any():
            camera = camera_of(interior[c], (int(sizes[c, 0]), int(sizes[c, 1])))
            out[c][good] = camera.cam_from_img(pixels[c][good])
    return out


def network_of(
    sightings: Sightings,
    pixels: np.ndarray,
    sigmas: np.ndarray,
    interior: np.ndarray,
    poses: np.ndarray,
    length: float,
    length_sigma: float,
    view_of: np.ndarray | None = None,
) -> Network:
    """Build a network from bar ends told apart, with the bars by forward intersection.

    Parameters
    ----------
    pixels : (C, T, 2, 2) float
        Both ends in every image, NaN where not seen.
    sigmas : (C, T, 2) float
    interior : (C, 13) float
    poses : (V, 3, 4) float
        Of the views.
    view_of : (C, T) int, optional
        View of each camera in each frame; one view a camera if not given.
    """
    if view_of is None:
        view_of = np.tile(np.arange(len(pixels))[:, None], (1, pixels.shape[1]))
    rays_per_end = np.isfinite(pixels[..., 0]).sum(axis=0)
    pixels = np.where((rays_per_end >= 2).all(axis=1)[None, :, None, None], pixels, np.nan)
    ideal = ideal_coordinates(pixels, interior, sightings.sizes)
    seen = np.isfinite(ideal).all(axis=-1)
    bar, camera, end = np.nonzero(np.moveaxis(seen, 0, 1))
    view = view_of[camera, bar]
    order = np.lexsort((end, view, bar))
    bar, camera, view, end = bar[order], camera[order], view[order], end[order]
    rays = np.concatenate([ideal[camera, bar, end], np.ones((len(bar), 1))], axis=1)
    R, t = poses[:, :, :3], poses[:, :, 3]
    directions = np.einsum("mji,mj->mi", R[view], rays)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = -np.einsum("cji,cj->ci", R, t)
    T = len(sightings.frames)
    points = triangulate(origins[view], directions, 2 * bar + end, 2 * T)
    view_camera = np.zeros(len(poses), dtype=np.int64)
    view_camera[view_of] = np.arange(len(pixels))[:, None]
    network = Network(
        sightings.cameras,
        sightings.sizes,
        interior,
        view_camera,
        np.array(R),
        np.array(t),
        points.reshape(T, 2, 3),
        sightings.frames,
        bar,
        view,
        end,
        pixels[camera, bar, end],
        sigmas[camera, bar, end],
        length,
        length_sigma,
    )
    return in_front(network)


def in_front(network: Network) -> Network:
    """Leave out rays to points that are behind their camera or unknown."""
    depth = np.einsum("mj,mj->m", network.rotation[network.view][:, 2], network.bars[network.bar, network.end])
    depth = depth + network.translation[network.view, 2]
    finite = np.isfinite(image_residuals(network)).all(axis=1)
    return network.with_observations((depth > 1e-3) & finite)


FIRST = interior_indices(("fx", "fy", "k1"))


def start(
    sightings: Sightings,
    length: float,
    settings: BarSettings,
    given: np.ndarray | None = None,
) -> Adjusted:
    """Find approximate values of everything.

    Parameters
    ----------
    sightings : Sightings
    length : float
        Of the bar, metres.
    settings : BarSettings
    given : (C, 13) float, optional
        Known interior orientations; without them a range of camera constants is tried.

    Raises
    ------
    CalibrationError
        If the cameras can't be connected or nothing consistent is found.
    """
    pairings = pair_all(sightings, settings)
    if not pairings:
        raise CalibrationError(
            "no two cameras see both ends of the bar in at least eight common frames that fit together; "
            "record more positions, all over the volume, and check that the frames are synchronized"
        )
    member, swapped = consistent_ends(sightings, pairings)
    two = two_candidates(sightings)
    ends = np.where(swapped[..., None, None], two[:, :, ::-1], two)
    ends = np.where(member[..., None, None], ends, np.nan)
    side = sightings.sizes.max(axis=1).astype(float)
    sigmas = np.broadcast_to(settings.start_sigma * side[:, None, None], ends.shape[:3])
    best: Adjusted | None = None
    best_score = np.inf
    failure: CalibrationError | None = None
    for factor in settings.focal_candidates if given is None else (1.0,):
        focal = factor * side
        if given is None:
            interior = np.zeros((len(side), N_INTERIOR))
            interior[:, 0] = interior[:, 1] = focal
            interior[:, 2:4] = sightings.sizes / 2
            free = FIRST
        else:
            interior, free = given, ()
        try:
            poses = _oriented(sightings, two, pairings, interior, length)
            network = network_of(sightings, ends, sigmas, interior, poses, length, 0.02 * length)
            prior = weak_prior(sightings.sizes, interior[:, 0], settings)
            result = adjust(network, free, prior, loss=2.0, max_iterations=25, tolerance=1e-3)
        except CalibrationError as error:
            failure = failure or error
            continue
        lost = 2 * (np.isfinite(ends[..., 0]).sum() - len(result.network.bar))
        score = result.cost + 16.0 * lost
        if best is None or score < best_score:
            best, best_score = result, score
    if best is None:
        raise failure or CalibrationError("no approximate values found")
    return best


def _oriented(
    sightings: Sightings,
    two: np.ndarray,
    pairings: dict[tuple[int, int], Pairing],
    interior: np.ndarray,
    length: float,
) -> np.ndarray:
    ideal = ideal_coordinates(two, interior, sightings.sizes)
    relatives = {}
    for (i, j), p in pairings.items():
        a = ideal[i, p.frames]
        b = np.where(p.swapped[:, None, None], ideal[j, p.frames][:, ::-1], ideal[j, p.frames])
        good = np.isfinite(a).all(axis=(1, 2)) & np.isfinite(b).all(axis=(1, 2))
        if good.sum() < 6:
            continue
        # From the pairing's image coordinates to ideal ones
        side_i, side_j = sightings.sizes[i].max(), sightings.sizes[j].max()
        scale_i = np.diag([interior[i, 0] / side_i, interior[i, 1] / side_i, 1.0])
        scale_j = np.diag([interior[j, 0] / side_j, interior[j, 1] / side_j, 1.0])
        scale_i[:2, 2] = (interior[i, 2:4] - sightings.sizes[i] / 2) / side_i
        scale_j[:2, 2] = (interior[j, 2:4] - sightings.sizes[j] / 2) / side_j
        relative = relative_orientation(a[good], b[good], scale_j.T @ p.F @ scale_i, length)
        if relative is not None:
            relatives[i, j] = relative
    return chain(relatives, sightings.cameras)
