"""Telling the bar's two ends from each other and from false blobs, with known cameras.

Within a frame every pair of rays from different cameras proposes a point; the cameras that have a candidate near its
image support it. The two points with the most support whose distance is the bar's are its ends. Which of them is called
first does not matter to the adjustment, but all cameras must agree.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.calibration.orientation import ideal_coordinates
from geomocap.calibration.projection import project_point
from geomocap.calibration.target_observations import TargetObservations


@njit(cache=True, nogil=True, error_model="numpy")
def identify_frame(pixels, ideal, interior, R, t, length, length_tolerance, threshold, chosen):
    """Find the bar in one frame.

    Parameters
    ----------
    pixels : (C, K, 2) float
        Candidates, COLMAP pixels, NaN where there is none.
    ideal : (C, K, 2) float
        The same without interior orientation and distortion.
    interior : (C, 13) float
    R : (C, 3, 3) float
    t : (C, 3) float
    length, length_tolerance : float
        The bar's length and by how much a pair of points may miss it, metres.
    threshold : (C,) float
        Largest distance of a candidate from a point's image, pixels.
    chosen : (C, 2) int
        Set to the candidate that is each end, -1 where there is none.

    Returns
    -------
    support : float
        How well the two ends are supported; 0 if the bar was not found.
    """
    C, K = pixels.shape[0], pixels.shape[1]
    J = np.empty((2, 22))
    xy = np.empty(2)
    limit = C * K * C * K // 2 + 1
    X = np.empty((limit, 3))
    pick = np.empty((limit, C), dtype=np.int64)
    score = np.empty(limit)
    n = 0
    A = np.empty((3, 3))
    b = np.empty(3)
    origins = np.empty((C, 3))
    for c in range(C):
        for k in range(3):
            origins[c, k] = -(R[c, 0, k] * t[c, 0] + R[c, 1, k] * t[c, 1] + R[c, 2, k] * t[c, 2])
    rays = np.empty((C, K, 3))
    for c in range(C):
        for i in range(K):
            u, v = ideal[c, i, 0], ideal[c, i, 1]
            norm = np.sqrt(1 + u * u + v * v)
            for k in range(3):
                rays[c, i, k] = (R[c, 0, k] * u + R[c, 1, k] * v + R[c, 2, k]) / norm
    for c in range(C):
        for d in range(c + 1, C):
            for i in range(K):
                if np.isnan(rays[c, i, 0]):
                    continue
                for j in range(K):
                    if np.isnan(rays[d, j, 0]):
                        continue
                    # Point nearest to the two rays
                    b[:] = 0.0
                    for k in range(3):
                        for m in range(3):
                            e = 1.0 if k == m else 0.0
                            p = e - rays[c, i, k] * rays[c, i, m]
                            q = e - rays[d, j, k] * rays[d, j, m]
                            A[k, m] = p + q
                            b[k] += p * origins[c, m] + q * origins[d, m]
                    if abs(np.linalg.det(A)) < 1e-6:
                        continue
                    X[n] = np.linalg.solve(A, b)
                    score[n] = 0.0
                    for a in range(C):
                        pick[n, a] = -1
                        if not project_point(interior[a], R[a], t[a], X[n], xy, J):
                            continue
                        nearest = threshold[a] * threshold[a]
                        for m in range(K):
                            dx, dy = xy[0] - pixels[a, m, 0], xy[1] - pixels[a, m, 1]
                            s = dx * dx + dy * dy
                            if s < nearest:
                                nearest = s
                                pick[n, a] = m
                        if pick[n, a] >= 0:
                            score[n] += 1.0 - 0.5 * nearest / (threshold[a] * threshold[a])
                    if pick[n, c] == i and pick[n, d] == j:
                        n += 1
    best = 0.0
    first, second = -1, -1
    for g in range(n):
        for h in range(g + 1, n):
            total = score[g] + score[h]
            if total <= best:
                continue
            dx, dy, dz = X[g, 0] - X[h, 0], X[g, 1] - X[h, 1], X[g, 2] - X[h, 2]
            if abs(np.sqrt(dx * dx + dy * dy + dz * dz) - length) > length_tolerance:
                continue
            shared = 0
            for a in range(C):
                if pick[g, a] >= 0 and pick[g, a] == pick[h, a]:
                    shared += 1
            total -= 2.0 * shared
            if total > best:
                best = total
                first, second = g, h
    for a in range(C):
        chosen[a, 0] = chosen[a, 1] = -1
        if first >= 0:
            chosen[a, 0], chosen[a, 1] = pick[first, a], pick[second, a]
            if chosen[a, 0] == chosen[a, 1]:
                chosen[a, 0] = chosen[a, 1] = -1
    return best


def identify(
    observations: TargetObservations,
    interior: np.ndarray,
    poses: np.ndarray,
    length: float,
    threshold: np.ndarray,
    length_tolerance: float = 0.1,
    view_of: np.ndarray | None = None,
) -> np.ndarray:
    """Find the bar in all frames.

    Parameters
    ----------
    observations : TargetObservations
    interior : (C, 13) float
    poses : (V, 3, 4) float
        Of the views.
    length : float
        Metres.
    threshold : (C,) float
        Largest distance of a candidate from its end's image, pixels.
    length_tolerance : float
        By how much two points may miss the bar's length, as a fraction of it.
    view_of : (C, T) int, optional
        View of each camera in each frame; one view a camera if not given.

    Returns
    -------
    chosen : (C, T, 2) int
        Candidate that is each end in each image, -1 where there is none.
    """
    ideal = ideal_coordinates(observations.pixels, interior, observations.sizes)
    C, T = observations.pixels.shape[:2]
    chosen = np.full((C, T, 2), -1, dtype=np.int64)
    if view_of is None:
        view_of = np.tile(np.arange(C)[:, None], (1, T))
    single = np.empty((C, 2), dtype=np.int64)
    for f in range(T):
        identify_frame(
            np.ascontiguousarray(observations.pixels[:, f]),
            np.ascontiguousarray(ideal[:, f]),
            interior,
            np.ascontiguousarray(poses[view_of[:, f], :, :3]),
            np.ascontiguousarray(poses[view_of[:, f], :, 3]),
            length,
            length_tolerance * length,
            threshold,
            single,
        )
        chosen[:, f] = single
    return chosen


def observed(observations: TargetObservations, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (C, T, 2, 2) and standard deviations (C, T, 2) of the chosen candidates, NaN where none."""
    index = np.maximum(chosen, 0)
    pixels = np.take_along_axis(observations.pixels, index[..., None], axis=2)
    sigmas = np.take_along_axis(observations.sigmas, index, axis=2)
    none = chosen < 0
    return np.where(none[..., None], np.nan, pixels), np.where(none, np.nan, sigmas)
