"""From approximate values to the final adjustment: labels, cameras that moved, outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomocap.calibration.bundle_adjustment import AdjustedNetwork, Prior, adjust
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.eccentricity import ball_radius, observed_radii, shifts
from geomocap.calibration.initial import network_of
from geomocap.calibration.labelling import identify, observed
from geomocap.calibration.network import Network
from geomocap.calibration.stability import refined_changes, resect, split_view, sudden_loss, sudden_shift, test_split
from geomocap.calibration.target_observations import TargetObservations
from geomocap.errors import CalibrationError


@dataclass(frozen=True)
class Estimate:
    """Final adjustment and what was made of the observations.

    Attributes
    ----------
    adjusted : AdjustedNetwork
    chosen : (C, T, 2) int
        Candidate that is each end in each image, -1 where none was found.
    rejected : (C, T, 2) bool
        Candidates found to be an end, but left out as outliers.
    view_of : (C, T) int
        View of each camera in each frame.
    target_radius : float
        Radius of the balls for which image centres were corrected, metres; 0 without correction.
    sigma_factor : float
        By how much the targets' a-priori standard deviations had to be enlarged.
    """

    adjusted: AdjustedNetwork
    chosen: np.ndarray
    rejected: np.ndarray
    view_of: np.ndarray
    target_radius: float
    sigma_factor: float


def poses_of(network: Network) -> np.ndarray:
    """Poses of the views, (V, 3, 4) float."""
    return np.concatenate([network.rotation, network.translation[:, :, None]], axis=2)


def scale_of(network: Network, residuals: np.ndarray) -> float:
    """Robust factor between actual and a-priori standard deviations of image coordinates."""
    return float(1.4826 * np.median(np.abs(residuals / network.sigmas[:, None])))


def estimate(
    observations: TargetObservations,
    begin: AdjustedNetwork,
    length: float,
    settings: BarSettings,
    prior: Prior,
    free: tuple[int, ...],
    length_sigma: float | None = None,
    target_radius: float | None = None,
) -> Estimate:
    """Go from approximate values to the final adjustment.

    Rounds of labelling with all cameras and robust adjustment, each with a tighter limit, that also look for cameras
    that were moved; then least squares without outliers, repeated until the set of outliers stays.

    Parameters
    ----------
    length, length_sigma : float
        Of the bar, metres.
    prior : Prior
    free : tuple of int
        Interior parameters to estimate.
    target_radius : float, optional
        Of the balls, metres; estimated if not given. Only for spheres.
    """
    length_sigma = length_sigma or settings.length_sigma
    rough = adjust(begin.network, free, prior, loss=2.0, max_iterations=40, tolerance=1e-5)
    side = observations.sizes.max(axis=1).astype(float)
    C, T = observations.pixels.shape[:2]
    view_of = np.tile(np.arange(C)[:, None], (1, T))
    for fraction in (settings.pairing_threshold, 0.006, 0.004):
        spread = 1.4826 * float(np.median(np.abs(rough.residuals)))
        limit = np.minimum(np.maximum(8 * spread, 1.0), fraction * side)
        chosen = identify(observations, rough.network.interior, poses_of(rough.network), length, limit, view_of=view_of)
        widest = settings.pairing_threshold * side
        found = _found_again(observations, chosen, rough.network, view_of, widest, settings.seed)
        if found is not None:
            rough = replace(rough, network=found)
            chosen = identify(observations, found.interior, poses_of(found), length, limit, view_of=view_of)
        rough = _relabelled(observations, chosen, rough, spread, free, prior, view_of)
        change = sudden_loss(observations, chosen, view_of)
        if change is not None:
            moved = _with_new_pose(observations, chosen, rough, change, view_of, float(limit[change[0]]), settings.seed)
            if moved is not None:
                view_of, network = moved
                rough = replace(rough, network=network)
                chosen = identify(observations, network.interior, poses_of(network), length, limit, view_of=view_of)
                rough = _relabelled(observations, chosen, rough, spread, free, prior, view_of)
        change = sudden_shift(rough, view_of, observations.frames)
        if change is not None:
            split = test_split(rough, view_of, observations.frames, change, prior, loss=2.0)
            if split is not None:
                rough, view_of = split
    view_of = refined_changes(rough.network, observations, view_of, limit)
    chosen = identify(observations, rough.network.interior, poses_of(rough.network), length, limit, view_of=view_of)
    network = _network(observations, chosen, rough.network, 0.0, length_sigma, view_of)
    final, factor = clean(network, free, prior, settings)
    radius = 0.0
    radii = observed_radii(final.network, observations, chosen)
    if settings.targets.shape == "sphere" and np.all(radii > 0):
        radius = target_radius or ball_radius(final.network, radii)
        # Once more with the images of the balls' centres instead of the centres of their images
        n = network.with_state(final.network.interior, final.network.rotation, final.network.translation, network.bars)
        n = _network(observations, chosen, n, 0.0, length_sigma, view_of)
        n = replace(n, pixels=n.pixels - shifts(n, radius))
        final, factor = clean(n, free, prior, settings)
    kept = np.zeros(chosen.shape, dtype=bool)
    n = final.network
    for v, c in enumerate(n.view_camera):
        bars = len(np.unique(n.bar[n.view == v]))
        if bars < 5:
            raise CalibrationError(
                f"camera {n.names[c]}: only {bars} bar positions fit the other cameras; check its synchronization, and "
                "record more positions where it and two others see the bar"
            )
    kept[n.view_camera[n.view], _times(n, observations), n.end] = True
    return Estimate(final, chosen, (chosen >= 0) & ~kept, view_of, radius, factor)


def _network(
    observations: TargetObservations,
    chosen: np.ndarray,
    state: Network,
    least_sigma: float,
    length_sigma: float,
    view_of: np.ndarray,
) -> Network:
    pixels, sigmas = observed(observations, chosen)
    sigmas = np.maximum(sigmas, least_sigma)
    poses = poses_of(state)
    return network_of(observations, pixels, sigmas, state.interior, poses, state.length, length_sigma, view_of)


def _relabelled(
    observations: TargetObservations,
    chosen: np.ndarray,
    rough: AdjustedNetwork,
    spread: float,
    free: tuple[int, ...],
    prior: Prior,
    view_of: np.ndarray,
) -> AdjustedNetwork:
    length_sigma = max(0.002 * rough.network.length, 1e-6)
    network = _network(observations, chosen, rough.network, 0.5 * spread, length_sigma, view_of)
    return adjust(network, free, prior, loss=2.0, max_iterations=40, tolerance=1e-5)


def _found_again(
    observations: TargetObservations,
    chosen: np.ndarray,
    network: Network,
    view_of: np.ndarray,
    limit: np.ndarray,
    seed: int,
) -> Network | None:
    """Give new poses to cameras that fit few of the bars, found from the bars that the others know.

    A camera that was chained wrongly can't mend itself; its interior orientation starts again from the others' as well.
    """
    fits = (chosen >= 0).any(axis=2)
    checkable = (observations.counts >= 2) & (fits.sum(axis=0) - fits >= 2)
    rate = (checkable & fits).sum(axis=1) / np.maximum(checkable.sum(axis=1), 1)
    lost = [c for c in range(len(rate)) if rate[c] < 0.75 and view_of[c].min() == view_of[c].max()]
    side = network.sizes.max(axis=1)
    others = [c for c in range(len(rate)) if c not in lost]
    if not lost or len(others) < 2:
        return None
    interior, rotation, translation = network.interior.copy(), network.rotation.copy(), network.translation.copy()
    changed = False
    for c in lost:
        trial = interior.copy()
        trial[c] = np.median(interior[others], axis=0)
        trial[c, :2] = side[c] * np.median(interior[others, :2] / side[others, None])
        trial[c, 2:4] = network.sizes[c] / 2
        rng = np.random.default_rng((seed, c))
        known = replace(network, interior=trial)
        pose = resect(known, observations, c, np.flatnonzero(checkable[c]), float(limit[c]), rng, 0.35)
        if pose is not None:
            interior[c], rotation[c], translation[c] = trial[c], pose[:, :3], pose[:, 3]
            changed = True
    return replace(network, interior=interior, rotation=rotation, translation=translation) if changed else None


def _with_new_pose(
    observations: TargetObservations,
    chosen: np.ndarray,
    rough: AdjustedNetwork,
    change: tuple[int, int],
    view_of: np.ndarray,
    limit: float,
    seed: int,
) -> tuple[np.ndarray, Network] | None:
    """Give a camera that does not fit from (or up to) some frame a second pose, found from the others' bars."""
    camera, start = change
    before = (chosen[camera, :start] >= 0).any(axis=1).mean()
    after = (chosen[camera, start:] >= 0).any(axis=1).mean()
    T = len(observations.frames)
    lost = np.arange(start, T) if before > after else np.arange(start)
    rng = np.random.default_rng((seed, camera, start))
    pose = resect(rough.network, observations, camera, lost, max(limit, 2.0), rng)
    if pose is None:
        return None
    n = rough.network
    split = split_view(view_of, camera, start, n.n_views)
    rotation = np.concatenate([n.rotation, n.rotation[camera : camera + 1]])
    translation = np.concatenate([n.translation, n.translation[camera : camera + 1]])
    target = n.n_views if before > after else camera
    rotation[target], translation[target] = pose[:, :3], pose[:, 3]
    return split, replace(n, view_camera=np.r_[n.view_camera, camera], rotation=rotation, translation=translation)


def clean(
    network: Network, free: tuple[int, ...], prior: Prior, settings: BarSettings
) -> tuple[AdjustedNetwork, float]:
    """Adjust robustly, then by least squares without outliers until their set stays.

    Where the residuals are well beyond what the targets' precision lets expect (cameras not quite synchronized, say),
    errors are not normal and outliers have no clear limit: standard deviations are enlarged then, and the final
    adjustment stays robust.

    Returns
    -------
    adjusted : AdjustedNetwork
    factor : float
        By how much the standard deviations of image points were enlarged.
    """
    begin = network
    everything = adjust(network, free, prior, loss=3.0, max_iterations=40, tolerance=1e-6)
    network = everything.network
    result = everything
    for _ in range(5):
        bad = _outliers(result, settings.outlier_threshold)
        if result is not everything and not bad.any():
            break
        if bad.mean() > 0.5:
            raise CalibrationError(
                "more than half of the observed targets contradict any calibration; check that the cameras are "
                "synchronized, that they did not move, and that nothing else bright was recorded"
            )
        network = network.with_observations(~bad)
        result = adjust(network, free, prior)
        network = result.network
    factor = 1.0
    if result.sigma0 > 1.5:
        factor = 1.2 * result.sigma0  # of the cleaned observations; the tails come back in
        wide = replace(everything.network, sigmas=begin.sigmas * factor)
        result = adjust(wide, free, prior, loss=2.0)
        wide = result.network.with_observations(~_outliers(result, 1.5 * settings.outlier_threshold))
        result = adjust(wide, free, prior, loss=2.0)
    return result, factor


def _outliers(adjusted: AdjustedNetwork, threshold: float) -> np.ndarray:
    """Observations (M,) bool beyond so many standard deviations, and all of bars whose length is."""
    network = adjusted.network
    # Residuals are smaller than errors by the fraction of the observations that checks the others
    fraction = np.sqrt((2 * len(network.bar) + len(network.bars)) / max(adjusted.redundancy, 1))
    scale = max(scale_of(network, adjusted.residuals), 0.5) * max(0.9 * fraction, 1.0)
    bad = np.linalg.norm(adjusted.residuals / network.sigmas[:, None], axis=1) > threshold * scale
    lengths = np.linalg.norm(network.bars[:, 0] - network.bars[:, 1], axis=1) - network.length
    return bad | (np.abs(lengths) > threshold * scale * network.length_sigma)[network.bar]


def _times(network: Network, observations: TargetObservations) -> np.ndarray:
    return np.searchsorted(observations.frames, network.frames)[network.bar]
