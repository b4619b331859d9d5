"""Ellipsoidal shells fitted to points by moments, and the error of the fit.

Kernels work in *grid units*: coordinates relative to the frame's centroid, divided by the point spacing. That keeps
the sums well conditioned and makes every threshold independent of the subject's size and of the resolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from geomocap.errors import GeometryError

SHELL = 3.0
"""A shell of points has semi-axis² = 3 λ, with λ the variance along the axis (exact for a sphere)."""

FLAT = 1.0 / 12.0
"""Least variance along an axis, spacing²: points on one layer of a grid are as thick as a cell, not flat."""
_MEASURED = ("centers", "radii", "rotations", "counts", "errors")


@dataclass(frozen=True)
class Ellipsoids:
    """K ellipsoidal shells of one frame; `Ellipsoids` of a sequence carry a leading axis T.

    Attributes
    ----------
    centers : (K, 3) float, metres, world
    radii : (K, 3) float, metres
        Semi-axes in descending order.
    rotations : (K, 3, 3) float
        Proper rotations, world from ellipsoid: the columns are the directions of the semi-axes.
    counts : (K,) int32
        Points that each was fitted to.
    errors : (K,) float, metres
        Fitting error as an equivalent length, see `fit_ellipsoids`.
    body : (K,) int, optional
        Body of each ellipsoid, -1: none.
    """

    centers: np.ndarray
    radii: np.ndarray
    rotations: np.ndarray
    counts: np.ndarray
    errors: np.ndarray
    body: np.ndarray | None = None

    def __post_init__(self) -> None:
        lead = self.counts.shape
        shapes = (self.centers.shape, self.radii.shape, self.rotations.shape, self.errors.shape)
        if shapes != ((*lead, 3), (*lead, 3), (*lead, 3, 3), lead):
            raise GeometryError(f"ellipsoids: arrays of shapes {shapes} don't belong together (counts {lead})")
        if self.body is not None and self.body.shape != lead[-1:]:
            raise GeometryError(f"ellipsoids: bodies of shape {self.body.shape}, expected {lead[-1:]}")

    def __len__(self) -> int:
        return self.counts.shape[-1]

    @property
    def frame_count(self) -> int:
        """Number of frames T of a sequence."""
        return len(self.counts)

    @property
    def bodies(self) -> np.ndarray:
        """Body of each ellipsoid, (K,) int; -1: none."""
        return np.full(len(self), -1) if self.body is None else self.body

    @property
    def body_count(self) -> int:
        """Number of bodies that they belong to."""
        return int(self.bodies.max(initial=-1)) + 1

    @property
    def seen_centers(self) -> np.ndarray:
        """Centres (…, K, 3), metres, world; NaN where no points belong to an ellipsoid."""
        return np.where(self.counts[..., None] > 0, self.centers, np.nan)

    @classmethod
    def stack(cls, frames: list[Ellipsoids], body: np.ndarray | None = None) -> Ellipsoids:
        """Join the ellipsoids of T frames, all of the same number K, into arrays (T, K, …)."""
        return cls(**{name: np.stack([getattr(f, name) for f in frames]) for name in _MEASURED}, body=body)

    @classmethod
    def joined(cls, parts: list[Ellipsoids]) -> Ellipsoids:
        """Put the ellipsoids of several parts beside each other, (T, ΣK, …), without their bodies."""
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts], axis=1) for name in _MEASURED})

    def select(self, chosen: np.ndarray) -> Ellipsoids:
        """Some ellipsoids of a sequence, (T, K', …)."""
        body = None if self.body is None else self.body[chosen]
        return Ellipsoids(**{name: getattr(self, name)[:, chosen] for name in _MEASURED}, body=body)


def check_points(points: np.ndarray, frame: int, least: int) -> np.ndarray:
    """Return the points of a frame as contiguous (N, 3) float64.

    Raises
    ------
    GeometryError
        If the array has another shape, holds NaN or infinity, or has fewer than `least` points.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise GeometryError(f"frame {frame}: points of shape {points.shape}, expected (N, 3)")
    if len(points) < least:
        found = "no points" if len(points) == 0 else f"only {len(points)} points"
        raise GeometryError(
            f"frame {frame}: {found}, at least {least} are needed; check this frame's geometry, or leave it out"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise GeometryError(
            f"frame {frame}: {len(bad)} points are not finite (first: number {bad[0]}); remove them from the geometry"
        )
    return points


@njit(cache=True, nogil=True, error_model="numpy")
def eigen_axes(moments: np.ndarray, variances: np.ndarray, axes: np.ndarray) -> None:
    """Eigenvalues (descending, at least `FLAT`) and axes of the covariance of one set of moments.

    Parameters
    ----------
    moments : (10,) float
        n, Σx, Σy, Σz, Σxx, Σxy, Σxz, Σyy, Σyz, Σzz, grid units.
    variances : (3,) float, written
    axes : (3, 3) float, written
        Columns are the axes; proper rotation, the largest component of the first two columns is positive.
    """
    n = moments[0]
    cx, cy, cz = moments[1] / n, moments[2] / n, moments[3] / n
    a = np.empty((3, 3))
    a[0, 0] = moments[4] / n - cx * cx
    a[0, 1] = a[1, 0] = moments[5] / n - cx * cy
    a[0, 2] = a[2, 0] = moments[6] / n - cx * cz
    a[1, 1] = moments[7] / n - cy * cy
    a[1, 2] = a[2, 1] = moments[8] / n - cy * cz
    a[2, 2] = moments[9] / n - cz * cz
    v = np.zeros((3, 3))
    v[0, 0] = v[1, 1] = v[2, 2] = 1.0
    size = a[0, 0] + a[1, 1] + a[2, 2] + 1e-300
    for _ in range(16):  # cyclic Jacobi rotations
        if a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2 < 1e-28 * size * size:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if abs(a[p, q]) < 1e-300:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * x - s * y, s * x + c * y
    i, j, k = 0, 1, 2
    if a[i, i] < a[j, j]:
        i, j = j, i
    if a[j, j] < a[k, k]:
        j, k = k, j
    if a[i, i] < a[j, j]:
        i, j = j, i
    for column, source in enumerate((i, j)):
        big = 0
        for r in range(1, 3):
            if abs(v[r, source]) > abs(v[big, source]):
                big = r
        sign = 1.0 if v[big, source] >= 0.0 else -1.0
        for r in range(3):
            axes[r, column] = sign * v[r, source]
    axes[0, 2] = axes[1, 0] * axes[2, 1] - axes[2, 0] * axes[1, 1]
    axes[1, 2] = axes[2, 0] * axes[0, 1] - axes[0, 0] * axes[2, 1]
    axes[2, 2] = axes[0, 0] * axes[1, 1] - axes[1, 0] * axes[0, 1]
    variances[0] = max(a[i, i], FLAT)
    variances[1] = max(a[j, j], FLAT)
    variances[2] = max(a[k, k], FLAT)


@njit(cache=True, nogil=True, error_model="numpy")
def error_terms(
    points: np.ndarray, start: int, end: int, moments: np.ndarray, variances: np.ndarray, axes: np.ndarray
) -> float:
    """Sum of eq. 2's terms over points[start:end] against an ellipsoid with these axes, without the factor 1/N."""
    cx, cy, cz = moments[1] / moments[0], moments[2] / moments[0], moments[3] / moments[0]
    s0 = 1.0 / (SHELL * variances[0])
    s1 = 1.0 / (SHELL * variances[1])
    s2 = 1.0 / (SHELL * variances[2])
    a00, a10, a20 = axes[0, 0], axes[1, 0], axes[2, 0]
    a01, a11, a21 = axes[0, 1], axes[1, 1], axes[2, 1]
    a02, a12, a22 = axes[0, 2], axes[1, 2], axes[2, 2]
    total = 0.0
    for i in range(start, end):
        x, y, z = points[i, 0] - cx, points[i, 1] - cy, points[i, 2] - cz
        u = a00 * x + a10 * y + a20 * z
        v = a01 * x + a11 * y + a21 * z
        w = a02 * x + a12 * y + a22 * z
        # radial distance |OP| |1 - F^(-1/2)| times (F^(1/2) - 1)²; the point at the centre is as far as the least axis
        f = np.sqrt(u * u * s0 + v * v * s1 + w * w * s2)
        if f > 1e-9:
            miss = abs(f - 1.0)
            total += np.sqrt(x * x + y * y + z * z) * miss * miss * miss / f
        else:
            total += np.sqrt(SHELL * variances[2])
    return total * (SHELL**1.5 * np.sqrt(variances[0] * variances[1] * variances[2])) ** 0.5


@njit(cache=True, nogil=True, error_model="numpy")
def equivalent_length(mean: float) -> float:
    """Length to which the error D of eq. 2 (a length to the power 5/2) is equivalent: D^(2/5)."""
    return mean**0.4


@njit(cache=True, nogil=True, error_model="numpy")
def range_moments(points: np.ndarray, start: int, end: int, m: np.ndarray) -> None:
    """Write the moments of points[start:end] to `m` (10,)."""
    m[:] = 0.0
    m[0] = end - start
    for i in range(start, end):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        m[1] += x
        m[2] += y
        m[3] += z
        m[4] += x * x
        m[5] += x * y
        m[6] += x * z
        m[7] += y * y
        m[8] += y * z
        m[9] += z * z


@njit(cache=True, nogil=True, error_model="numpy")
def all_axes(moments: np.ndarray, variances: np.ndarray, axes: np.ndarray) -> None:
    """Write `eigen_axes` of every set with points."""
    for k in range(moments.shape[0]):
        if moments[k, 0] > 0.0:
            eigen_axes(moments[k], variances[k], axes[k])


@njit(cache=True, nogil=True, error_model="numpy")
def union_errors(
    points: np.ndarray, begin: np.ndarray, end: np.ndarray, union: np.ndarray, moments: np.ndarray
) -> np.ndarray:
    """Equivalent error lengths of unions of ranges of points, grid units; 0 of those without points.

    Range k is points[begin[k]:end[k]] and part of union[k]; `moments` are those of the unions.
    """
    count = moments.shape[0]
    variances = np.ones((count, 3))
    axes = np.zeros((count, 3, 3))
    all_axes(moments, variances, axes)
    errors = np.zeros(count)
    for k in range(union.shape[0]):
        u = union[k]
        if end[k] > begin[k]:
            errors[u] += error_terms(points, begin[k], end[k], moments[u], variances[u], axes[u])
    for u in range(count):
        if moments[u, 0] > 0.0:
            errors[u] = equivalent_length(errors[u] / moments[u, 0])
    return errors


def from_moments(moments: np.ndarray, errors: np.ndarray, origin: np.ndarray, spacing: float) -> Ellipsoids:
    """Ellipsoids of sets of moments in grid units.

    Parameters
    ----------
    moments : (K, 10) float, grid units
    errors : (K,) float, grid units
        Equivalent lengths.
    origin : (3,) float, metres, world
    spacing : float, metres
    """
    variances = np.ones((len(moments), 3))
    axes = np.tile(np.eye(3), (len(moments), 1, 1))
    all_axes(moments, variances, axes)
    return Ellipsoids(
        origin + spacing * moments[:, 1:4] / np.maximum(moments[:, :1], 1.0),
        spacing * np.sqrt(SHELL * variances),
        axes,
        moments[:, 0].astype(np.int32),
        spacing * errors,
    )


def fit_ellipsoids(points: np.ndarray, labels: np.ndarray, count: int, spacing: float) -> Ellipsoids:
    """Fit one ellipsoidal shell to each labelled set of points (paper, section 5.1).

    The centre is the centroid; the axes are the eigenvectors of the covariance; the semi-axes are √(3 λ), so that the
    shell lies on the points. The fitting error is eq. 2,

        D = √(a₁ a₂ a₃) / N · Σ ‖OP‖_radial (F^½ − 1)²,   ‖OP‖_radial = ‖P − O‖ · |1 − F^−½|,

    with F = (x/a₁)² + (y/a₂)² + (z/a₃)². The factor √(a₁a₂a₃) is that of Solina & Bajcsy (1990), who prefer small
    shapes by it; the radial distance is Gross & Boult's. The exponent ½ makes F linear in the distance, as the ε₁/2 of
    superquadrics does at ε₁ = 1; with F itself D would be four times as large for small misfits, a change of threshold.
    D is a length to the power 5/2: `errors` holds D^(2/5), a length that orders fits exactly as D does.

    Parameters
    ----------
    points : (N, 3) float, metres, world
    labels : (N,) int
        Set of each point, 0 … count − 1; negative: none.
    count : int
        Number of sets K.
    spacing : float, metres

    Returns
    -------
    Ellipsoids
    """
    points = check_points(points, 0, 1)
    origin = points.mean(axis=0)
    grid = (points - origin) / spacing
    # set by set
    order = np.argsort(labels, kind="stable")
    grid, ends = grid[order], np.searchsorted(labels[order], np.arange(count + 1))
    moments = np.zeros((count, 10))
    for k in range(count):
        range_moments(grid, ends[k], ends[k + 1], moments[k])
    errors = union_errors(grid, ends[:-1], ends[1:], np.arange(count, dtype=np.int32), moments)
    return from_moments(moments, errors, origin, spacing)
