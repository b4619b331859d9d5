"""Least squares matching: a template patch and its counterparts in one or several search images.

The template patch f around a (sub-pixel) point is explained by each search image g under an affine warp and a linear
change of grey levels (Gruen 1985, "Adaptive least squares correlation"):

    f(dx, dy) + e = k · g(x + a11 dx + a12 dy, y + a21 dx + a22 dy) + o

with unknowns (x, y, a11, a12, a21, a22, k, o) for each image. Gauss–Newton steps are inverse-compositional (Baker,
Matthews 2004): the increment d warps the *template*, so that the Jacobian J = ∇f ⊗ (1, dx, dy) and the 6×6 normal
matrix

    N = Σ JᵀJ − q₁q₁ᵀ / P − q_f q_fᵀ / Σf²        q₁ = Σ Jᵀ, q_f = Σ Jᵀ f, f centred

(offset and gain eliminated by Schur complement) are formed once a patch and not once an iteration.

Geometric condition. Along the ray of the template point the object point has one unknown, its inverse depth μ, and is
seen at π_i(μ) in image i. That all rays meet is one weighted observation in x and y for each image,

    0 + v = (x_i, y_i) − π_i(μ)        with standard deviation σ_c,

so that the images' normal equations (each weighted with its own grey-level variance s_i²) are tied together by μ alone:
six unknowns for each image are eliminated and a scalar equation for μ is left (Gruen, Baltsavias 1988, "Geometrically
constrained multiphoto matching", with the collinearity equations written along the template ray).

Precision. s² = Σe² / (P − 8) is the noise of *both* images. Two effects make the textbook covariance s² N⁻¹ wrong:
interpolation between pixels smooths white noise (a fraction a(t) of its variance is left), so s² underestimates the
noise at the scale of the texture; and noise in the template's slopes inflates N. With σ² = s² / (a_f + a_g) the noise
variance of one image, in units of f, and B = diag of Σ(noise of the slopes)², the covariance used here is

    C = 2σ² (N − B)⁻¹ (N − B/2) (N − B)⁻¹,

its position block carried into the search image by the affine matrix. It describes the image measurement without the
geometric condition; half of it belongs to either image, which is what `triangulation` counts with.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from geomocap.matching import patch_kernel as kernel
from geomocap.matching.matching_settings import KernelSettings
from geomocap.matching.patch_kernel import match_patch, workspace
from geomocap.matching.spline import ImageStack

REASONS = (
    "matched",
    "outside the template image or its mask",
    "low texture",
    "outside the search image",
    "no convergence",
    "degenerate warp",
    "low correlation",
    "high sigma0",
    "low precision",
    "far from the start",
    "off the epipolar line",
    "no start",
)
"""What became of a point, by the number in `Matches.status`."""

_CHUNK = 32
_PATIENCE = 8
_HOPELESS = 0.5


@dataclass(frozen=True)
class Matches:
    """Matched points; leading shape `…` is (N,) for pairs and (N, K) for K search images.

    Attributes
    ----------
    positions : (…, 2) float
        Counterparts in the search images, COLMAP pixels.
    affine : (…, 2, 2) float
        Search-image offset from template offset.
    covariance : (…, 2, 2) float
        A-posteriori covariance of the position, noise of both images, px².
    sigma0 : (…,) float
        Standard deviation of a grey-level difference, grey levels of the template.
    correlation : (…,) float
        Normalised cross-correlation after the adjustment.
    gain, offset : (…,) float
        Template = gain × search + offset, grey levels.
    shift : (…, 2) float
        Way from the start, pixels.
    epipolar_distance : (…,) float
        Distance from the epipolar line, pixels; 0 where no geometry was given.
    inverse_depth : (…,) float
        Inverse of the depth along the template camera's axis, 1/m; 0 where no geometry was given.
    iterations : (…,) int
    status : (…,) uint8
        0: matched; else the number of a reason in `REASONS`.
    """

    positions: np.ndarray
    affine: np.ndarray
    covariance: np.ndarray
    sigma0: np.ndarray
    correlation: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    shift: np.ndarray
    epipolar_distance: np.ndarray
    inverse_depth: np.ndarray
    iterations: np.ndarray
    status: np.ndarray

    def __len__(self) -> int:
        return len(self.status)

    @property
    def matched(self) -> np.ndarray:
        """Which adjustments converged, (…,) bool."""
        return self.status == kernel.MATCHED


def count_reasons(status: np.ndarray) -> dict[str, int]:
    """Count the outcomes `status` (any shape, numbers of `REASONS`) by their words."""
    counts = Counter(np.asarray(status).ravel().tolist())
    return {REASONS[code]: counts[code] for code in sorted(counts)}


def match_multi(
    images: ImageStack,
    template: int,
    searches: list[int] | np.ndarray,
    points: np.ndarray,
    start: np.ndarray,
    transfers: np.ndarray | None = None,
    settings: KernelSettings | None = None,
) -> Matches:
    """Match patches of one image in several others at once, with the condition that all rays meet.

    Parameters
    ----------
    images : ImageStack
        Images free of distortion where `transfers` are given.
    template : int
        Number of the template image in the stack.
    searches : (K,) int
        Numbers of the search images.
    points : (N, 2) float
        Centres of the template patches, COLMAP pixels.
    start : (N, K, 2) or (N, K, 6) float
        Start positions, COLMAP pixels, and affine matrices (a11, a12, a21, a22), the identity if not given.
    transfers : (K, 12) float, optional
        Epipolar geometry (`epipolar.transfers`); without it each image is matched for itself.
    settings : KernelSettings, optional

    Returns
    -------
    matches : Matches
        Of leading shape (N, K).

    Raises
    ------
    ValueError
        If shapes don't fit together.
    """
    settings = settings or KernelSettings()
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    searches = np.asarray(searches, dtype=np.int64)
    shape = (len(points), len(searches))
    start = np.asarray(start, dtype=np.float64)
    if start.shape[:2] != shape or start.shape[2:] not in ((2,), (6,)):
        raise ValueError(f"start has shape {start.shape}, expected {shape} and 2 or 6 values each")
    if transfers is not None and np.shape(transfers) != (len(searches), 12):
        raise ValueError(f"transfers have shape {np.shape(transfers)}, expected {(len(searches), 12)}")
    position = start[..., :2] - 0.5
    affine = np.ascontiguousarray(start[..., 2:]) if start.shape[2] == 6 else np.tile([1.0, 0, 0, 1], (*shape, 1))
    quality = np.zeros((*shape, kernel.COLUMNS))
    _match_all(
        images.arrays,
        template,
        searches,
        np.zeros((len(searches), 12)) if transfers is None else np.ascontiguousarray(transfers, dtype=np.float64),
        points - 0.5,
        settings.radius,
        (
            0.0 if transfers is None else settings.sigma_condition,
            settings.iterations,
            settings.tolerance,
            settings.minimum_contrast,
            settings.max_shift,
            _PATIENCE,
            _HOPELESS,
        ),
        position,
        affine,
        quality,
    )
    return matches_of(position, affine, quality, start[..., :2])


def matches_of(position: np.ndarray, affine: np.ndarray, quality: np.ndarray, start: np.ndarray) -> Matches:
    """Name the kernel's columns: `position` (…, 2) array indices, `start` (…, 2) COLMAP pixels."""
    q = np.moveaxis(quality, -1, 0)
    covariance = np.stack([q[kernel.CXX], q[kernel.CXY], q[kernel.CXY], q[kernel.CYY]], axis=-1)
    return Matches(
        positions=position + 0.5,
        affine=affine.reshape(*affine.shape[:-1], 2, 2),
        covariance=covariance.reshape(*covariance.shape[:-1], 2, 2),
        sigma0=q[kernel.SIGMA0],
        correlation=q[kernel.CORR],
        gain=q[kernel.GAIN],
        offset=q[kernel.OFFSET],
        shift=position + 0.5 - start,
        epipolar_distance=q[kernel.EPI],
        inverse_depth=q[kernel.INVERSE_DEPTH],
        iterations=q[kernel.ITERATIONS].astype(np.int64),
        status=q[kernel.STATUS].astype(np.uint8),
    )


@njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def _match_all(stack, template, searches, transfers, points, radius, control, position, affine, quality):
    count = len(points)
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        work = workspace(radius, len(searches))
        wanted = np.ones(len(searches), np.uint8)
        for n in range(chunk * _CHUNK, min(count, (chunk + 1) * _CHUNK)):
            x, y = points[n]
            found = position[n], affine[n], quality[n]
            match_patch(stack, template, searches, transfers, x, y, radius, control, wanted, *found, work)
