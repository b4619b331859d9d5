"""Velocities and accelerations of trajectories with known noise: a local polynomial in time, weighted by precision.

At each frame t a polynomial of degree `degree` in time is fitted by weighted least squares to the positions within
`half_width` frames (Savitzky, Golay 1964, with gaps, unequal weights and the ends of a trajectory handled alike): its
derivatives at t are velocity and acceleration. A fit is linear in the positions, v = Σ c_i x_i, so that its noise
gain √(Σ c_i²) and its standard deviation √(Σ c_i² σ_i²) are known exactly. Raw differences at 30 fps have a gain of
30/√2 = 21 a second for velocity and 2205 a second² for acceleration; a cubic over three frames on each side has 15
and 196, a parabola 5.7 and 196, but the parabola flattens quick motion: on patches of a walking man, noisy by tenths of
a millimetre, its velocities were wrong by 0.045 m/s RMS, the cubic's by 0.026 (a kicking horse: 0.32 and 0.13).
"""

from __future__ import annotations

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.trajectories import PathDerivatives
from geomocap.scheduling import map_here
from geomocap.trajectories.trajectory_settings import SmoothingSettings

_REGULAR = 1e-9
_AT_ONCE = 2048  # paths, so that what is needed on the way takes little memory


def smooth_motion(
    positions: np.ndarray, fps: float, sigma: np.ndarray | None = None, settings: SmoothingSettings | None = None
) -> PathDerivatives:
    """Estimate velocities and accelerations wherever there is a position, in single precision.

    Parameters
    ----------
    positions : (N, T, 3) float, metres
        NaN where not measured.
    fps : float
    sigma : (N, T) float, optional
        Standard deviation of a coordinate, metres; weights the frames and gives the standard deviations. Without it all
        frames count alike and the standard deviations come from the residuals of all fits.
    settings : SmoothingSettings, optional

    Raises
    ------
    GeometryError
        If the frame rate isn't above 0 or the shapes don't fit.
    """
    settings = settings or SmoothingSettings()
    if not fps > 0:
        raise GeometryError(f"a frame rate above 0 is needed for velocities, got {fps}")
    if positions.ndim != 3 or (sigma is not None and sigma.shape != positions.shape[:2]):
        given = "none" if sigma is None else sigma.shape
        raise GeometryError(f"positions {positions.shape} and sigma {given}: expected (N, T, 3) and (N, T)")
    N, T = positions.shape[:2]
    out, std = np.full((2, N, T, 3), np.nan, np.float32), np.full((2, N, T), np.nan, np.float32)

    def smooth(rows: slice) -> tuple[float, int]:
        given = None if sigma is None else sigma[rows]
        return _smooth_some(positions[rows], given, fps, settings, out[:, rows], std[:, rows])

    left = map_here(smooth, [slice(begin, begin + _AT_ONCE) for begin in range(0, N, _AT_ONCE)])
    if sigma is None:
        square, freedom = sum(square for square, _ in left), sum(count for _, count in left)
        std *= np.sqrt(square / freedom) if freedom > 0 else np.nan
    return PathDerivatives(*out, *std)


def _smooth_some(
    positions: np.ndarray,
    sigma: np.ndarray | None,
    fps: float,
    settings: SmoothingSettings,
    out: np.ndarray,
    std: np.ndarray,
) -> tuple[float, int]:
    """Fill in derivatives (2, n, T, 3) of some paths and their standard deviations (2, n, T).

    Without `sigma` these are of observations of standard deviation 1, and the sum of squares of the residuals and
    their degrees of freedom are returned; else 0.
    """
    n, T = positions.shape[:2]
    h, terms = settings.half_width, settings.degree + 1
    measured = np.isfinite(positions).all(axis=2)
    sd = np.ones((n, T))
    if sigma is not None:
        sd = np.where(np.isfinite(sigma) & (sigma > 0), np.asarray(sigma, np.float64), np.nan)
    known = measured & np.isfinite(sd)
    weight = np.where(known, 1 / np.where(known, sd, 1.0) ** 2, 0.0)
    value = np.where(known[:, :, None], positions, 0.0)
    square, freedom = 0.0, 0
    for t in range(T):
        low, high = max(t - h, 0), min(t + h + 1, T)
        w = weight[:, low:high]
        rows = np.flatnonzero(measured[:, t] & ((w > 0).sum(axis=1) >= terms))
        if not len(rows):
            continue
        # time in units of the half width keeps the normal matrix well conditioned
        powers = ((np.arange(low, high) - t) / h)[:, None] ** np.arange(terms)
        normal = np.einsum("nk,ki,kj->nij", w[rows], powers, powers)
        scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
        rule = np.linalg.solve(normal + _REGULAR * scale * np.eye(terms), np.einsum("nk,ki->nik", w[rows], powers))
        fit = rule @ value[rows, low:high]
        spread = np.sqrt(np.einsum("nik,nk->ni", rule**2, np.where(w[rows] > 0, 1 / np.maximum(w[rows], 1e-300), 0.0)))
        if sigma is None:
            miss = (value[rows, low:high] - powers @ fit) * (w[rows] > 0)[:, :, None]
            square += float((miss**2).sum())
            freedom += 3 * int((w[rows] > 0).sum() - terms * len(rows))
        for order, unit in enumerate((fps / h, 2 * (fps / h) ** 2)[: settings.degree]):
            out[order, rows, t] = unit * fit[:, 1 + order]
            std[order, rows, t] = unit * spread[:, 1 + order]
    return square, freedom
