"""Approximate values from nothing but image sizes: pairings, relative orientations, a chain over all cameras.

1. Every pair of cameras: which bar ends belong together, and its fundamental matrix (`pairs`).
2. For each of several camera constants: relative orientations, their scale by the bar, and the tree of the best ones.
3. A short robust adjustment of each; the camera constant with the smallest cost is kept.
"""

from __future__ import annotations

import numpy as np

from geomocap.calibration.bundle_adjustment import AdjustedNetwork, adjust, image_residuals, interior_indices
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.lens_model import weak_prior
from geomocap.calibration.network import Network
from geomocap.calibration.orientation import chain, ideal_coordinates, relative_orientation
from geomocap.calibration.pairs import Pairing, pair_ends
from geomocap.calibration.projection import N_INTERIOR
from geomocap.calibration.target_observations import TargetObservations
from geomocap.errors import CalibrationError
from geomocap.model.triangulation import nearest_to_rays


def two_candidates(observations: TargetObservations) -> np.ndarray:
    """Return the two candidates of the images that have just two, (C, T, 2, 2) float, NaN elsewhere."""
    two = np.full((*observations.pixels.shape[:2], 2, 2), np.nan)
    just = observations.counts == 2
    two[just] = observations.pixels[just][:, :2]
    return two


def image_coordinates(pixels: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Bring pixels (C, …, 2) to the image's centre as 0 and its longer side as 1."""
    shape = (len(sizes), *([1] * (pixels.ndim - 2)), 2)
    return (pixels - sizes.reshape(shape) / 2) / sizes.max(axis=1).reshape(*shape[:-1], 1)


def pair_all(observations: TargetObservations, settings: BarSettings) -> dict[tuple[int, int], Pairing]:
    """Pair the bar ends of all pairs of cameras."""
    x = image_coordinates(two_candidates(observations), observations.sizes)
    found = {}
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            rng = np.random.default_rng((settings.seed, i, j))
            pairing = pair_ends(x[i], x[j], settings.pairing_threshold, settings.pairing_samples, rng)
            if pairing is not None and len(pairing.frames) >= 0.4 * pairing.used:
                found[i, j] = pairing
    return found


def consistent_ends(
    observations: TargetObservations, pairings: dict[tuple[int, int], Pairing]
) -> tuple[np.ndarray, np.ndarray]:
    """Tell the ends apart over all cameras that the pairings connect, frame by frame.

    Returns
    -------
    member : (C, T) bool
        Whether the camera is in the frame's largest connected set.
    swapped : (C, T) bool
        Whether its first candidate is the bar's second end.
    """
    C, T = observations.counts.shape
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


def network_of(
    observations: TargetObservations,
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
    ideal = ideal_coordinates(pixels, interior, observations.sizes)
    seen = np.isfinite(ideal).all(axis=-1)
    bar, camera, end = np.nonzero(np.moveaxis(seen, 0, 1))
    view = view_of[camera, bar]
    order = np.lexsort((end, view, bar))
    bar, camera, view, end = bar[order], camera[order], view[order], end[order]
    R, t = poses[:, :, :3], poses[:, :, 3]
    directions = np.concatenate([ideal, np.ones((*ideal.shape[:3], 1))], axis=3) @ R[view_of]
    directions /= np.linalg.norm(directions, axis=3, keepdims=True)
    origins = -np.einsum("cji,cj->ci", R, t)[view_of]
    T = len(observations.frames)
    points = nearest_to_rays(np.repeat(origins, 2, axis=1), directions.reshape(len(pixels), 2 * T, 3))
    view_camera = np.zeros(len(poses), dtype=np.int64)
    view_camera[view_of] = np.arange(len(pixels))[:, None]
    network = Network(
        observations.cameras,
        observations.sizes,
        interior,
        view_camera,
        np.array(R),
        np.array(t),
        points.reshape(T, 2, 3),
        observations.frames,
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
    observations: TargetObservations,
    length: float,
    settings: BarSettings,
    given: np.ndarray | None = None,
) -> AdjustedNetwork:
    """Find approximate values of everything.

    Parameters
    ----------
    observations : TargetObservations
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
    pairings = pair_all(observations, settings)
    if not pairings:
        raise CalibrationError(
            "no two cameras see both ends of the bar in at least eight common frames that fit together; "
            "record more positions, all over the volume, and check that the frames are synchronized"
        )
    member, swapped = consistent_ends(observations, pairings)
    two = two_candidates(observations)
    ends = np.where(swapped[..., None, None], two[:, :, ::-1], two)
    ends = np.where(member[..., None, None], ends, np.nan)
    side = observations.sizes.max(axis=1).astype(float)
    sigmas = np.broadcast_to(settings.start_sigma * side[:, None, None], ends.shape[:3])
    best: AdjustedNetwork | None = None
    best_score = np.inf
    failure: CalibrationError | None = None
    for factor in settings.focal_candidates if given is None else (1.0,):
        focal = factor * side
        if given is None:
            interior = np.zeros((len(side), N_INTERIOR))
            interior[:, 0] = interior[:, 1] = focal
            interior[:, 2:4] = observations.sizes / 2
            free = FIRST
        else:
            interior, free = given, ()
        try:
            poses = _oriented(observations, two, pairings, interior, length)
            network = network_of(observations, ends, sigmas, interior, poses, length, 0.02 * length)
            prior = weak_prior(observations.sizes, interior[:, 0], settings)
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
    observations: TargetObservations,
    two: np.ndarray,
    pairings: dict[tuple[int, int], Pairing],
    interior: np.ndarray,
    length: float,
) -> np.ndarray:
    ideal = ideal_coordinates(two, interior, observations.sizes)
    relatives = {}
    for (i, j), p in pairings.items():
        a = ideal[i, p.frames]
        b = np.where(p.swapped[:, None, None], ideal[j, p.frames][:, ::-1], ideal[j, p.frames])
        good = np.isfinite(a).all(axis=(1, 2)) & np.isfinite(b).all(axis=(1, 2))
        if good.sum() < 6:
            continue
        # From the pairing's image coordinates to ideal ones
        side_i, side_j = observations.sizes[i].max(), observations.sizes[j].max()
        scale_i = np.diag([interior[i, 0] / side_i, interior[i, 1] / side_i, 1.0])
        scale_j = np.diag([interior[j, 0] / side_j, interior[j, 1] / side_j, 1.0])
        scale_i[:2, 2] = (interior[i, 2:4] - observations.sizes[i] / 2) / side_i
        scale_j[:2, 2] = (interior[j, 2:4] - observations.sizes[j] / 2) / side_j
        relative = relative_orientation(a[good], b[good], scale_j.T @ p.F @ scale_i, length)
        if relative is not None:
            relatives[i, j] = relative
    return chain(relatives, observations.cameras)
