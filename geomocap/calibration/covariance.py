"""Exact covariances of an adjustment in the datum of inner constraints over all object points.

In that datum the points as a whole neither turn nor shift: their mean variance is the smallest of all datums
(Granshaw, Bundle adjustment methods in engineering photogrammetry, 1980).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.calibration.bundle_adjustment import (
    AdjustedNetwork,
    Groups,
    datum_directions,
    normal_equations,
    reduced_system,
)
from geomocap.errors import CalibrationError


@dataclass(frozen=True)
class Covariance:
    """Covariances for a-posteriori sigma0 = `sigma0`.

    Attributes
    ----------
    cameras : (n, n) float
        Of the camera unknowns, in the adjustment's columns (pixels, radians, metres).
    points : (P, 2, 3, 3) float
        Of each bar end, square metres.
    sigma0 : float
    """

    cameras: np.ndarray
    points: np.ndarray
    sigma0: float

    @property
    def point_sigma(self) -> float:
        """Root mean square standard deviation of an object coordinate, metres."""
        return float(np.sqrt(np.einsum("peii->", self.points) / (3 * self.points.shape[0] * 2)))


def covariance(adjusted: AdjustedNetwork) -> Covariance:
    """Invert the normal equations of a converged adjustment.

    The points' part follows from the cameras' by back-substitution, C_pp = V⁻¹ + V⁻¹ Wᵀ C_cc W V⁻¹, and the change of
    datum is the S-transformation T = I − G (Bᵀ G)⁻¹ Bᵀ with the points' part of G in B (Baarda 1973).

    Raises
    ------
    CalibrationError
        If the observations don't determine the unknowns.
    """
    network, columns = adjusted.network, adjusted.columns
    groups = Groups.of(network)
    normal = normal_equations(network, columns, groups, adjusted.prior, adjusted.loss)
    reduced, _, inverse = reduced_system(normal, columns, groups, network.n_views, 0.0)
    cameras, points = datum_directions(network, columns)
    scale = 1.0 / np.sqrt(np.diag(normal.U))
    matrix = reduced * scale[:, None] * scale
    held = cameras / scale[:, None]
    held /= np.linalg.norm(held, axis=0)
    try:
        C = np.linalg.inv(matrix + held @ held.T) * scale[:, None] * scale
    except np.linalg.LinAlgError:
        raise CalibrationError("the recording does not determine all unknowns; move the bar more") from None
    if not (np.isfinite(C).all() and (np.diag(C) > 0).all()):
        raise CalibrationError("the recording does not determine all unknowns; move the bar more")

    # H[p] = -V⁻¹ Wᵀ: how a bar follows the cameras
    n_bars = len(network.bars)
    of_view = columns.of_view
    H = np.zeros((n_bars, 6, columns.n))
    for p in range(n_bars):
        for g in range(groups.of_bar[p], groups.of_bar[p + 1]):
            H[p][:, of_view[groups.view[g]]] -= inverse[p] @ normal.W[g].T
    B = points.reshape(n_bars, 6, 6)
    Cpp = inverse + np.einsum("pik,kl,pjl->pij", H, C, H, optimize=True)
    Z = np.einsum("pik,pil->kl", H, B)  # Hᵀ B over all bars
    Qc = C @ Z
    Qp = np.einsum("pij,pjl->pil", inverse, B) + H @ Qc
    K = np.linalg.inv(np.einsum("pik,pil->kl", B, B))
    BQ = np.einsum("pik,pil->kl", B, Qp)

    def transform(block: np.ndarray, G: np.ndarray, Q: np.ndarray) -> np.ndarray:
        GK = G @ K
        cross = GK @ np.swapaxes(Q, -1, -2)
        return block - cross - np.swapaxes(cross, -1, -2) + GK @ BQ @ np.swapaxes(GK, -1, -2)

    Ccc = transform(C, cameras, Qc)
    Cpp = transform(Cpp, B, Qp)
    variance = adjusted.sigma0**2
    ends = np.stack([Cpp[:, :3, :3], Cpp[:, 3:, 3:]], axis=1)
    return Covariance(variance * Ccc, variance * ends, float(adjusted.sigma0))
