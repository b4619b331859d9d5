"""Rigid bodies from the paths of ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.ellipsoids import SHELL, Ellipsoids


@dataclass(frozen=True)
class Grouping:
    """Ellipsoids grouped into rigid bodies, with what the grouping was decided by.

    Attributes
    ----------
    body : (K,) int32
        Body of each ellipsoid; bodies are numbered in the order in which they were found.
    seeds : (B,) int32
        Seed ellipsoid of each body.
    integrals : (K, K) float, metres
        Mean distance over time of each two relative paths.
    threshold : float, metres
        T_sb: ellipsoids with a smaller integral to the seed belong to its body.
    """

    body: np.ndarray
    seeds: np.ndarray
    integrals: np.ndarray
    threshold: float

    @classmethod
    def without_motion(cls, integrals: np.ndarray, threshold: float) -> Grouping:
        """No bodies: a single frame has no motion to tell them by."""
        return cls(np.full(len(integrals), -1, np.int32), np.empty(0, np.int32), integrals, threshold)


def path_integrals(paths: np.ndarray) -> np.ndarray:
    """Integrals of the distance curves between relative paths (section 7, steps 1 to 3).

    A relative path is a path minus its mean over time. The integral is divided by the duration: it is the mean
    distance, so that a threshold means the same for long and short sequences.

    Parameters
    ----------
    paths : (T, K, 3) float, metres

    Returns
    -------
    (K, K) float, metres
    """
    relative = paths - paths.mean(axis=0)
    total = np.zeros((paths.shape[1], paths.shape[1]))
    for positions in relative:
        total += np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    return total / len(paths)


def similarity_threshold(integrals: np.ndarray) -> float:
    """T_sb from the set of integrals of all pairs: where their logarithms fall apart into two classes best.

    The paper leaves the "statistical analysis of the set of integrals" open. Pairs are of two kinds, within one body or
    not, and integrals are positive and spread over ratios: so the threshold is that of N. Otsu, "A threshold selection
    method from gray-level histograms" (IEEE Transactions on Systems, Man, and Cybernetics 9, 1979), of the logarithms.

    Parameters
    ----------
    integrals : (K, K) float, metres

    Returns
    -------
    float, metres
        0 for fewer than two ellipsoids.
    """
    pairs = integrals[np.triu_indices(len(integrals), 1)]
    if len(pairs) == 0 or pairs.max() == 0.0:
        return 0.0
    logs = np.sort(np.log(np.maximum(pairs, 1e-6 * pairs.max())))
    if len(logs) < 2:
        return 0.0
    below = np.arange(1, len(logs))
    sums = np.cumsum(logs)
    apart = sums[:-1] / below - (sums[-1] - sums[:-1]) / (len(logs) - below)
    cut = int(np.argmax(below * (len(logs) - below) * apart**2))
    return float(np.exp(0.5 * (logs[cut] + logs[cut + 1])))


def group_paths(integrals: np.ndarray, centers: np.ndarray, counts: np.ndarray, threshold: float) -> Grouping:
    """Group ellipsoids into rigid bodies, seed by seed (section 7, steps 2 to 5).

    The first seed is nearest to the centre of gravity of the first frame, each next one is the free ellipsoid nearest
    to the centre of the body found last. Free ellipsoids with an integral below the threshold join the seed's body.

    Parameters
    ----------
    integrals : (K, K) float, metres
    centers : (K, 3) float, metres
        In the first frame.
    counts : (K,) float
        Points of each ellipsoid in the first frame.
    threshold : float, metres
    """
    body = np.full(len(integrals), -1, np.int32)
    seeds: list[int] = []
    near = np.average(centers, axis=0, weights=counts)
    while (body < 0).any():
        free = np.flatnonzero(body < 0)
        seed = free[np.argmin(np.linalg.norm(centers[free] - near, axis=1))]
        members = free[(integrals[seed, free] < threshold) | (free == seed)]
        body[members] = len(seeds)
        seeds.append(int(seed))
        near = np.average(centers[members], axis=0, weights=counts[members])
    return Grouping(body, np.array(seeds, np.int32), integrals, threshold)


def unite(ellipsoids: Ellipsoids, body: np.ndarray, count: int) -> Ellipsoids:
    """Fit an ellipsoid to the union of each body's points in every frame (section 7, end).

    The moments of a union are the sums of the moments, which the ellipsoids hold: no points are needed. The fitting
    error would need them and is NaN.

    Parameters
    ----------
    ellipsoids : Ellipsoids (T, K)
    body : (K,) int
        Body of each ellipsoid, 0 … count − 1; negative: none.
    count : int
        Number of bodies B.

    Returns
    -------
    Ellipsoids (T, B)
    """
    member = (body[None] == np.arange(count)[:, None]).astype(float)  # (B, K)
    weights = member[None] * ellipsoids.counts[:, None]  # (T, B, K)
    total = weights.sum(axis=2)
    means = np.einsum("tbk,tkc->tbc", weights, ellipsoids.centers) / total[..., None]
    own = np.einsum("tkij,tkj,tklj->tkil", ellipsoids.rotations, ellipsoids.radii**2 / SHELL, ellipsoids.rotations)
    spread = np.einsum("tbk,tkil->tbil", weights, own)
    offsets = ellipsoids.centers[:, None] - means[:, :, None]  # (T, B, K, 3)
    spread += np.einsum("tbk,tbki,tbkl->tbil", weights, offsets, offsets)
    variances, axes = np.linalg.eigh(spread / total[..., None, None])
    axes = axes[..., ::-1].copy()
    axes[..., 2] *= np.sign(np.linalg.det(axes))[..., None]
    return Ellipsoids(
        means,
        np.sqrt(SHELL * np.maximum(variances[..., ::-1], 0.0)),
        axes,
        np.rint(total).astype(np.int32),
        np.full(total.shape, np.nan),
    )
