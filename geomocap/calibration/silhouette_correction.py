"""Cameras corrected by the silhouettes of the recording itself, where these contradict the calibration.

A tripod that was touched after the calibration, or a calibration from a few points, puts cameras a few pixels wrong;
then silhouettes that are right carve limbs away. The subject's outlines tell by how much (`silhouette_tangents`):
their poses are adjusted until the epipolar tangents agree, robustly, and as little as will do. The poses given count
as observations with the uncertainty that the disagreement itself shows, so that what silhouettes can't tell (place,
direction and scale of the world, and what the subject's motion doesn't show) stays as it was.

A correction has to prove itself on frames that it wasn't found from: each half of the frames is predicted by the
other half. It is made only if the calibration explains the greater part of the disagreement, and if with it every pair
of cameras agrees to within the pixels of the outlines: what is left otherwise is silhouettes that are wrong, and these
must not move a camera.

References
----------
Sinha, Pollefeys, McMillan, Camera network calibration from dynamic silhouettes, CVPR 2004.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.calibration.silhouette_tangents import OutlineRays, Tangents
from geomocap.model.camera_correction import CameraCorrection
from geomocap.model.rig import Rig

POSE = 6  # numbers of a pose
LEAST_NOISE = 12**-0.5  # standard deviation of an outline that is only rounded to pixels
ROUNDS = 30
CONVERGED = 1e-3  # of the standard deviation of the poses given
SOONER = 0.7  # by which outliers are told the more strictly in each round
CAUCHY = 2.385  # standard deviations at which an observation counts half (95 % efficient where noise is normal)
STEP = 1e-4  # of the same, for differences


def disagreement(given: Rig, outlines: OutlineRays) -> float:
    """Median misfit of the two cameras that disagree most about the outlines, pixels.

    NaN where the outlines tell less than twice what a pose has numbers of any camera.
    """
    rest = _poses(given, np.zeros(POSE * len(given)))
    tangents = Tangents.of(outlines, *rest)
    misfits = tangents.misfits(*rest)
    told = np.isfinite(misfits).sum(axis=(1, 2))
    least = min(told[tangents.of_camera(c)].sum() for c in range(len(given)))
    return _of_worst_pair(misfits) if least >= 2 * POSE else np.nan


def correct_cameras(given: Rig, outlines: OutlineRays, resolution: float = 1.0) -> CameraCorrection:
    """Correct a calibration by the subject's outlines if they contradict it by more than their resolution.

    Parameters
    ----------
    given : Rig
    outlines : OutlineRays
        Of frames spread over the recording.
    resolution : float, pixels
        Of the outlines; a smaller disagreement tells nothing.
    """
    halves = outlines.some(slice(0, None, 2)), outlines.some(slice(1, None, 2))
    start = np.zeros(POSE * len(given))
    first = [_misfits(given, half, start) for half in halves]
    if min(len(_known(misfits)) for misfits in first) < 2 * POSE * len(given):
        return CameraCorrection(given, given, np.nan, np.nan)
    before = _of_worst_pair(np.concatenate(first, axis=1))
    if before <= resolution:
        return CameraCorrection(given, given, before, np.nan)
    fitted = [_adjust(given, half) for half in halves]
    left = [_misfits(given, half, pose) for half, pose in zip(halves, fitted[::-1], strict=True)]
    after = _of_worst_pair(np.concatenate(left, axis=1))
    called_for = after <= resolution and after**2 < 0.5 * before**2
    return CameraCorrection(given, _moved(given, _adjust(given, outlines)) if called_for else given, before, after)


def _of_worst_pair(misfits: np.ndarray) -> float:
    """Median misfit of the pair of cameras that disagrees most, pixels."""
    each = [_known(pair) for pair in misfits]
    return max(float(np.median(np.abs(r))) for r in each if len(r))


def _known(misfits: np.ndarray) -> np.ndarray:
    return misfits[np.isfinite(misfits)]


def _misfits(given: Rig, outlines: OutlineRays, pose: np.ndarray) -> np.ndarray:
    poses = _poses(given, pose)
    return Tangents.of(outlines, *poses).misfits(*poses)


def _poses(given: Rig, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres after changes (6 C,): rotation vectors in the cameras' axes, and metres in the world's."""
    change = pose.reshape(-1, POSE)
    rotations = Rotation.from_rotvec(change[:, :3]).as_matrix() @ given.cam_from_world[:, :, :3]
    return rotations, given.centers + change[:, 3:]


def _moved(given: Rig, pose: np.ndarray) -> Rig:
    rotations, centers = _poses(given, pose)
    shift = -np.einsum("cij,cj->ci", rotations, centers)
    return Rig(given.names, given.cameras, np.concatenate([rotations, shift[..., None]], axis=2))


def _adjust(given: Rig, outlines: OutlineRays) -> np.ndarray:
    """Change of the poses (6 C,) that makes the tangents agree: iteratively reweighted least squares, Cauchy's loss."""
    pose = np.zeros(POSE * len(given))
    here = _poses(given, pose)
    tangents = Tangents.of(outlines, *here)
    noise = _noise(tangents.misfits(*here))
    scale = _uncertainty(given, outlines, noise, tangents)
    reach = float(noise.max())  # first all is heeded, then what fits
    for _ in range(ROUNDS):
        misfits = tangents.misfits(*here)
        known = np.isfinite(misfits)
        residual = np.where(known, misfits, 0.0)
        slopes = np.zeros((*misfits.shape, len(pose)))
        for k in range(len(pose)):
            rows = tangents.of_camera(k // POSE)
            there = tangents.misfits(*_poses(given, pose + np.eye(len(pose))[k] * STEP * scale), rows)
            slopes[rows, :, :, k] = np.where(known[rows], there - residual[rows], 0.0) / STEP
        reach = max(SOONER * reach, _noise(misfits[None])[0])
        weight = np.where(known, 1.0 / (1.0 + (residual / (CAUCHY * reach)) ** 2), 0.0) / reach**2
        J, r, w = slopes[known], residual[known], weight[known]
        normal = (J * w[:, None]).T @ J + np.eye(len(pose))  # the poses given are observations too
        step = np.linalg.solve(normal, -(J * w[:, None]).T @ r - pose / scale)
        pose = pose + step * scale
        here = _poses(given, pose)
        tangents = Tangents.of(outlines, *here)
        if np.abs(step).max() < CONVERGED and reach <= noise.max() * SOONER:
            break
    return pose


def _noise(misfits: np.ndarray) -> np.ndarray:
    """Robust standard deviation of the misfits of each pair, (P,) pixels."""
    each = [np.abs(_known(pair)) for pair in misfits]
    return np.array([max(1.4826 * float(np.median(r)), LEAST_NOISE) if len(r) else 1.0 for r in each])


def _uncertainty(given: Rig, outlines: OutlineRays, noise: np.ndarray, tangents: Tangents) -> np.ndarray:
    """Standard deviations (6 C,) of the poses given, rad and metres: they shift the subject by as many pixels as a
    camera disagrees with the others, half of these more and half less."""
    pixels = np.array([np.median(noise[tangents.of_camera(c)]) for c in range(len(given))])
    axes = np.einsum("cfki,cij->cfj", outlines.rays, given.cam_from_world[:, :, :3])
    axes = (axes * outlines.seen[..., None]).sum(axis=1)
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-12)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = np.linalg.lstsq(across.sum(axis=0), np.einsum("cij,cj->i", across, given.centers), rcond=None)[0]
    distance = np.linalg.norm(given.centers - middle, axis=1)
    angle = pixels / outlines.focal
    return np.column_stack([angle, angle, angle, *[angle * distance] * 3]).ravel()
