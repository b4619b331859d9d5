"""How the surface around each sample turns, and how differently two samples turn."""

from __future__ import annotations

import numba
import numpy as np

from geomocap.model.rotations import nearest_rotation
from geomocap.scheduling import spread

_LEAST_FRAMES = 8


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments_of(i, positions, reference, weights, first, members, nearness, moments):
    """Add up the moments of sample i."""
    center = np.empty(3)
    start = np.empty(3)
    for t in range(weights.shape[1]):
        total = 0.0
        center[:] = 0.0
        start[:] = 0.0
        for q in range(first[i], first[i + 1]):
            j = members[q]
            w = nearness[q] * weights[j, t]
            total += w
            for c in range(3):
                center[c] += w * positions[j, t, c]
                start[c] += w * reference[j, c]
        if total <= 0.0:
            continue
        for c in range(3):
            center[c] /= total
            start[c] /= total
        for q in range(first[i], first[i + 1]):
            j = members[q]
            w = nearness[q] * weights[j, t] / total
            for a in range(3):
                moved = w * (positions[j, t, a] - center[a])
                for b in range(3):
                    moments[i, t, a, b] += moved * (reference[j, b] - start[b])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _local_moments(begin, end, positions, reference, weights, first, members, nearness, moments):
    for i in range(begin, end):
        _moments_of(i, positions, reference, weights, first, members, nearness, moments)


def local_rotations(
    positions: np.ndarray, reference: np.ndarray, weights: np.ndarray, geodesics: np.ndarray, radius: float
) -> np.ndarray:
    """Rotation of each sample's neighbourhood since the reference, by weighted Kabsch.

    Weights fall with the distance along the surface as a Gaussian of 0.6 radii, so that limbs that touch do not mix.

    Parameters
    ----------
    positions : (N, T, 3) float, metres
        Complete.
    reference : (N, 3) float, metres
    weights : (N, T) float
        Of the positions.
    geodesics : (N, N) float, metres
        Distances along the surface; infinite where farther than the radius.
    radius : float, metres

    Returns
    -------
    (N, T, 3, 3) float
        world from reference.
    """
    near = geodesics <= radius
    rows, members = np.nonzero(near)
    first = np.concatenate([[0], np.cumsum(near.sum(axis=1))])
    nearness = np.exp(-((geodesics[rows, members] / (0.6 * radius)) ** 2))
    moments = np.zeros((*weights.shape, 3, 3))
    arrays = np.ascontiguousarray(positions), np.ascontiguousarray(reference), weights, first, members, nearness
    spread(_local_moments, len(weights), *arrays, moments)
    # what flat or thin neighbourhoods leave open stays as it was in the reference
    size = np.trace(moments, axis1=2, axis2=3)[..., None, None]
    return nearest_rotation(moments + (1e-9 * np.abs(size) + 1e-15) * np.eye(3))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turns_of(i, flat, known, fraction, least_frames, result):
    """Compare sample i with those before it."""
    frames = known.shape[1]
    least = np.empty(1 + int(fraction * (frames - 1)), np.float32)
    for j in range(i):
        common = 0
        for t in range(frames):
            common += known[i, t] and known[j, t]
        every = common < least_frames
        rank = 1 + int(fraction * ((frames if every else common) - 1))
        least[:] = 3.0
        for t in range(frames):
            if not (every or (known[i, t] and known[j, t])):
                continue
            trace = np.float32(0.0)
            for c in range(9):
                trace += flat[i, t, c] * flat[j, t, c]
            if trace < least[0]:  # least holds the smallest traces so far, largest of them first
                k = 0
                while k + 1 < rank and least[k + 1] > trace:
                    least[k] = least[k + 1]
                    k += 1
                least[k] = trace
        cosine = min(max((least[0] - np.float32(1.0)) / np.float32(2.0), np.float32(-1.0)), np.float32(1.0))
        result[i, j] = result[j, i] = np.arccos(cosine)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn_distances(begin, end, flat, known, fraction, least_frames, result):
    for i in range(begin, end):
        _turns_of(i, flat, known, fraction, least_frames, result)


def turn_distances(
    rotations: np.ndarray, known: np.ndarray | None = None, fraction: float = 0.05, most_frames: int = 120
) -> np.ndarray:
    """Angle by which two samples turn differently, exceeded in a small fraction of the frames.

    Parameters
    ----------
    rotations : (N, T, 3, 3) float
        Since a common reference.
    known : (N, T) bool, optional
        Where the rotation of a sample is known. Frames in which that of one of the two is not are left out, unless
        hardly any are left.
    fraction : float
        Fraction of the frames in which the angle is larger; 0.05: the 95th percentile.
    most_frames : int
        Longer sequences are looked at in so many frames, spread evenly.

    Returns
    -------
    (N, N) float32, radians
    """
    count, frames = rotations.shape[:2]
    known = np.ones((count, frames), bool) if known is None else known
    if frames > most_frames:
        looked_at = np.linspace(0, frames - 1, most_frames).round().astype(int)
        rotations, known = rotations[:, looked_at], known[:, looked_at]
    flat = np.ascontiguousarray(rotations.reshape(*known.shape, 9), np.float32)
    result = np.zeros((count, count), np.float32)
    least = min(_LEAST_FRAMES, known.shape[1])
    spread(_turn_distances, count, flat, np.ascontiguousarray(known), fraction, least, result)
    return result
