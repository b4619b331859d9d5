"""Forward ray intersection: object points from their image positions in all cameras that saw them, with covariance.

For each point the reprojection errors, weighted with the inverse covariances of the image positions, are minimised by
Gauss–Newton from the point nearest to all rays; A = Σ JᵀWJ is the normal matrix and A⁻¹ the covariance of the point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.rig import Rig


@dataclass(frozen=True)
class Triangulation:
    """Intersected points.

    Attributes
    ----------
    points : (N, 3) float
        Metres, world; NaN where fewer than two cameras saw the point, or it lies behind one, or the rays are parallel.
    covariance : (N, 3, 3) float, m²
        From the given image covariances, NaN as the points.
    residual : (N,) float
        Root mean square of the reprojection errors, pixels.
    sigma0 : (N,) float
        Standard deviation of unit weight a posteriori: about 1 if the image covariances are right.
    views : (N,) int
        Number of cameras that saw the point.
    """

    points: np.ndarray
    covariance: np.ndarray
    residual: np.ndarray
    sigma0: np.ndarray
    views: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of the position, (N,) float, metres: root of the sum of the three variances."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2))


def triangulate(
    rig: Rig,
    pixels: np.ndarray,
    covariances: np.ndarray | None = None,
    seen: np.ndarray | None = None,
    iterations: int = 3,
) -> Triangulation:
    """Intersect rays.

    Parameters
    ----------
    rig : Rig
        V cameras, with or without distortion.
    pixels : (V, N, 2) float
        COLMAP pixels; what is NaN was not seen.
    covariances : (V, N, 2, 2) float, optional
        Of the pixels, px²; the identity if not given. (The derivative of lens distortion is taken as 1.)
    seen : (V, N) bool, optional
        Which camera saw which point.
    iterations : int
        Gauss–Newton steps.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    views, count = pixels.shape[:2]
    use = np.isfinite(pixels).all(axis=2)
    if seen is not None:
        use &= seen
    # Normalized image coordinates, their weights, and rays
    focal = np.array([(c.focal_length_x, c.focal_length_y) for c in rig.cameras])
    x = np.zeros((views, count, 2))
    for v, camera in enumerate(rig.cameras):
        if use[v].any():
            x[v, use[v]] = camera.cam_from_img(np.ascontiguousarray(pixels[v, use[v]]))
    use &= np.isfinite(x).all(axis=2)
    x[~use] = 0
    W = np.zeros((views, count, 2, 2))
    if covariances is None:
        W[:] = np.eye(2)
    else:
        W[use] = np.linalg.inv(covariances[use])
    W *= focal[:, None, :, None] * focal[:, None, None, :] * use[:, :, None, None]
    number = use.sum(axis=0)

    R, t = rig.cam_from_world[:, :, :3], rig.cam_from_world[:, :, 3]
    directions = np.concatenate([x, np.ones((views, count, 1))], axis=2) @ R
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    points = np.nan_to_num(nearest_to_rays(rig.centers[:, None], directions, use))
    for _ in range(iterations):
        normal, right, _ = _normal_equations(R, t, x, W, points)
        step, _ = _solve(normal, right)
        points = points + step
    normal, _, residuals = _normal_equations(R, t, x, W, points)
    inverse, regular = _solve(normal, np.broadcast_to(np.eye(3), normal.shape))

    depth = np.einsum("vj,nj->vn", R[:, 2], points) + t[:, 2, None]
    bad = (number < 2) | ~regular | (use & ~(depth > 0)).any(axis=0)
    squares = np.einsum("vni,vnij,vnj->n", residuals, W, residuals)
    in_pixels = residuals * focal[:, None] * use[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt((in_pixels**2).sum(axis=(0, 2)) / np.maximum(number, 1))
        sigma0 = np.sqrt(squares / np.maximum(2 * number - 3, 1))
    points[bad], inverse[bad], rms[bad], sigma0[bad] = np.nan, np.nan, np.nan, np.nan
    return Triangulation(points, inverse, rms, sigma0, number)


def nearest_to_rays(origins: np.ndarray, directions: np.ndarray, use: np.ndarray | None = None) -> np.ndarray:
    """Points with the least sum of squared distances from their rays, (N, 3); NaN with fewer than two or parallel ones.

    Parameters
    ----------
    origins, directions : (V, N, 3) float
        V rays of each of N points, directions of unit length; origins may be (V, 1, 3).
    use : (V, N) bool, optional
        Which of them count; those that are finite if not given.
    """
    if use is None:
        use = np.isfinite(directions).all(axis=2)
    d = np.where(use[..., None], directions, 0.0)
    across = (np.eye(3) - d[..., :, None] * d[..., None, :]) * use[..., None, None]
    A = across.sum(axis=0)
    b = (across @ np.broadcast_to(origins, d.shape)[..., None])[..., 0].sum(axis=0)
    points, regular = _solve(A, b)
    points[~regular] = np.nan
    return points


def _normal_equations(
    R: np.ndarray, t: np.ndarray, x: np.ndarray, W: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal matrices (N, 3, 3), right sides (N, 3), and residuals (V, N, 2) in normalized coordinates."""
    normal = np.zeros((len(points), 3, 3))
    right = np.zeros((len(points), 3))
    residuals = np.zeros_like(x)
    for v in range(len(R)):
        X = points @ R[v].T + t[v]
        z = np.where(np.abs(X[:, 2]) > 1e-9, X[:, 2], 1e-9)
        p = X[:, :2] / z[:, None]
        J = (R[v][None, :2] - p[:, :, None] * R[v][None, 2:3]) / z[:, None, None]
        residuals[v] = x[v] - p
        JW = np.swapaxes(J, 1, 2) @ W[v]
        normal += JW @ J
        right += np.squeeze(JW @ residuals[v][:, :, None], axis=2)
    residuals *= (W[..., 0, 0] > 0)[..., None]
    return normal, right, residuals


def _solve(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve many 3×3 systems by their adjugates: solutions, 0 where A is singular, and which were regular."""
    c = np.stack([np.cross(A[:, 1], A[:, 2]), np.cross(A[:, 2], A[:, 0]), np.cross(A[:, 0], A[:, 1])], axis=2)
    det = np.einsum("ni,ni->n", A[:, 0], c[:, :, 0])
    size = np.trace(A, axis1=1, axis2=2) / 3
    regular = det > 1e-12 * size**3
    inverse = np.where(regular[:, None, None], c / np.where(regular, det, 1.0)[:, None, None], 0.0)
    solution = inverse @ b[..., None] if b.ndim == 2 else inverse @ b
    return (solution[..., 0] if b.ndim == 2 else solution), regular
