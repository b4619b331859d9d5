"""Epipolar geometry of two cameras from bars whose ends look alike.

The two ends of a bar can't be told apart in an image, so each frame has two possible pairings. Random samples of four
frames (eight points) are tried with all 2⁴ pairings; a wrong pairing practically never lies near both epipolar lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numba import njit


@dataclass(frozen=True)
class Pairing:
    """How the candidates of two cameras belong together.

    Attributes
    ----------
    frames : (n,) int
        Indices of the frames that agree with one epipolar geometry.
    swapped : (n,) bool
        Whether the first candidate of the one camera is the second of the other.
    F : (3, 3) float
        Fundamental matrix in normalised coordinates (image centre 0, longer side 1): x2ᵀ F x1 = 0.
    used : int
        Number of frames in which both cameras have two candidates.
    """

    frames: np.ndarray
    swapped: np.ndarray
    F: np.ndarray
    used: int


@njit(cache=True, nogil=True, error_model="numpy")
def score_pairings(Fs, a, b, threshold, best, swapped):
    """Truncated squared Sampson distances of hypotheses, each frame with its better pairing.

    Parameters
    ----------
    Fs : (H, 3, 3) float
    a, b : (n, 2, 2) float
        The two candidates of each frame in either camera.
    threshold : float
    best : (H, n) float
        Set to the larger of the two points' squared distances, in units of the threshold squared, at most 1.
    swapped : (H, n) bool
        Set to the better pairing.
    """
    t2 = threshold * threshold
    for h in range(len(Fs)):
        F = Fs[h]
        for k in range(len(a)):
            best[h, k] = 1.0
            for swap in range(2):
                worst = 0.0
                for e in range(2):
                    x, y = a[k, e, 0], a[k, e, 1]
                    f = e if swap == 0 else 1 - e
                    u, v = b[k, f, 0], b[k, f, 1]
                    l0 = F[0, 0] * x + F[0, 1] * y + F[0, 2]
                    l1 = F[1, 0] * x + F[1, 1] * y + F[1, 2]
                    l2 = F[2, 0] * x + F[2, 1] * y + F[2, 2]
                    m0 = F[0, 0] * u + F[1, 0] * v + F[2, 0]
                    m1 = F[0, 1] * u + F[1, 1] * v + F[2, 1]
                    d = u * l0 + v * l1 + l2
                    s = d * d / max(l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1, 1e-30) / t2
                    worst = max(worst, s)
                    if worst >= best[h, k]:
                        break
                if worst < best[h, k]:
                    best[h, k] = worst
                    swapped[h, k] = swap == 1


def eight_point(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Fundamental matrices by the linear eight-point method, normalised (Hartley 1997).

    Parameters
    ----------
    a, b : (H, n, 2) float
        Corresponding points, n ≥ 8.

    Returns
    -------
    F : (H, 3, 3) float, of rank two, x_bᵀ F x_a = 0
    """

    def normalise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        mean = x.mean(axis=1, keepdims=True)
        scale = np.sqrt(2.0) / np.maximum(np.linalg.norm(x - mean, axis=2).mean(axis=1), 1e-9)
        return (x - mean) * scale[:, None, None], mean[:, 0], scale

    xa, ma, sa = normalise(a)
    xb, mb, sb = normalise(b)
    ha = np.concatenate([xa, np.ones_like(xa[..., :1])], axis=2)
    hb = np.concatenate([xb, np.ones_like(xb[..., :1])], axis=2)
    A = (hb[..., :, None] * ha[..., None, :]).reshape(len(a), -1, 9)
    _, vectors = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)
    U, s, Vt = np.linalg.svd(vectors[:, :, 0].reshape(-1, 3, 3))
    s[:, 2] = 0
    F = (U * s[:, None]) @ Vt

    def transform(mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
        T = np.zeros((len(mean), 3, 3))
        T[:, 0, 0] = T[:, 1, 1] = scale
        T[:, :2, 2] = -mean * scale[:, None]
        T[:, 2, 2] = 1
        return T

    F = np.swapaxes(transform(mb, sb), 1, 2) @ F @ transform(ma, sa)
    return F / np.linalg.norm(F, axis=(1, 2), keepdims=True)


def pair_ends(a: np.ndarray, b: np.ndarray, threshold: float, samples: int, rng: np.random.Generator) -> Pairing | None:
    """Find which candidates of two cameras belong together.

    Parameters
    ----------
    a, b : (T, 2, 2) float
        The two candidates of each frame in either camera, normalised coordinates; NaN where a camera has not just two.
    threshold : float
        Largest Sampson distance of a right pairing, normalised.
    samples : int
        Number of random samples of four frames.
    rng : numpy Generator

    Returns
    -------
    pairing : Pairing or None
        None if fewer than eight frames are common, or fewer than eight agree.
    """
    usable = np.flatnonzero(np.isfinite(a).all(axis=(1, 2)) & np.isfinite(b).all(axis=(1, 2)))
    if len(usable) < 8:
        return None
    a, b = np.ascontiguousarray(a[usable]), np.ascontiguousarray(b[usable])
    n = len(usable)
    chosen = np.array([rng.choice(n, 4, replace=False) for _ in range(samples)])
    swaps = np.array(list(product((0, 1), repeat=4)))
    # (samples, 16 pairings, 4 frames, 2 ends)
    pa = np.broadcast_to(a[chosen][:, None], (samples, 16, 4, 2, 2))
    straight, crossed = b[chosen][:, None], b[chosen][:, None, :, ::-1]
    pb = np.where(swaps[None, :, :, None, None] == 0, straight, crossed)
    Fs = eight_point(pa.reshape(-1, 8, 2), pb.reshape(-1, 8, 2))
    best = np.empty((len(Fs), n))
    swapped = np.zeros((len(Fs), n), dtype=np.bool_)
    score_pairings(Fs, a, b, threshold, best, swapped)
    order = np.argsort(best.sum(axis=1), kind="stable")[:8]
    result: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
    for h in order:
        F, agree, swap = Fs[h], best[h] < 1, swapped[h]
        cost = best[h].sum()
        for _ in range(6):
            if agree.sum() < 6:
                break
            xb = np.where(swap[agree][:, None, None], b[agree][:, ::-1], b[agree])
            F = eight_point(a[agree].reshape(1, -1, 2), xb.reshape(1, -1, 2))
            d, s = np.empty((1, n)), np.zeros((1, n), dtype=np.bool_)
            score_pairings(F, a, b, threshold, d, s)
            F = F[0]
            if d.sum() >= cost:
                break
            cost, agree, swap = d.sum(), d[0] < 1, s[0]
        if result is None or cost < result[0]:
            result = (float(cost), agree, swap, F)
    if result is None or result[1].sum() < 8:
        return None
    _, agree, swap, F = result
    return Pairing(usable[agree], swap[agree], F, n)
