"""Self-calibrating bundle adjustment with known distances (Levenberg–Marquardt, free network).

Unknowns are the interior orientation of every camera, the pose of every view and both ends of every bar. Observations
are the image coordinates and, at every position, the bar's length with its own standard deviation; weak a-priori
knowledge of interior orientations enters as observations too (D'Apuzzo, section 2; Triggs et al., Bundle adjustment
– a modern synthesis, 2000).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from geomocap.calibration.network import Network, rotated
from geomocap.calibration.normal_equations import back_substitute, linearize, reduce_bars, residuals
from geomocap.calibration.projection import INTERIOR_NAMES, N_INTERIOR
from geomocap.errors import CalibrationError

POSE = tuple(range(N_INTERIOR, N_INTERIOR + 6))


def interior_indices(names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the positions of these interior parameters."""
    return tuple(INTERIOR_NAMES.index(n) for n in names)


OPENCV = interior_indices(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"))


@dataclass(frozen=True)
class Prior:
    """A-priori knowledge of interior orientations.

    Attributes
    ----------
    mean : (C, 13) float
    sigma : (C, 13) float
        Standard deviations; infinite for what is not known.
    aspect_sigma : (C,) float
        Standard deviation of fx − fy around 0, pixels; infinite if not known.
    """

    mean: np.ndarray
    sigma: np.ndarray
    aspect_sigma: np.ndarray

    @classmethod
    def none(cls, n_cameras: int) -> Prior:
        """Nothing is known."""
        return cls(
            np.zeros((n_cameras, N_INTERIOR)),
            np.full((n_cameras, N_INTERIOR), np.inf),
            np.full(n_cameras, np.inf),
        )

    def cost(self, interior: np.ndarray) -> float:
        """Sum of squared normalised deviations of interior parameters (C, 13)."""
        d = (interior - self.mean) / self.sigma
        return float((d * d).sum() + (((interior[:, 0] - interior[:, 1]) / self.aspect_sigma) ** 2).sum())

    def normal(self, interior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrices (C, 13, 13) and right-hand sides (C, 13)."""
        weight = 1.0 / self.sigma**2
        N = np.einsum("ci,ij->cij", weight, np.eye(N_INTERIOR))
        g = weight * (interior - self.mean)
        a = 1.0 / self.aspect_sigma**2
        N[:, 0, 0] += a
        N[:, 1, 1] += a
        N[:, 0, 1] -= a
        N[:, 1, 0] -= a
        d = a * (interior[:, 0] - interior[:, 1])
        g[:, 0] += d
        g[:, 1] -= d
        return N, g


@dataclass(frozen=True)
class Columns:
    """Where the unknowns stand in the camera part of the normal equations.

    Interior parameters camera by camera, then six pose parameters view by view.
    """

    free_interior: tuple[int, ...]
    view_camera: np.ndarray
    n_cameras: int

    @property
    def free(self) -> np.ndarray:
        """Free parameters of a view among its 19, (F,) int."""
        return np.array([*self.free_interior, *POSE], dtype=np.int64)

    @property
    def n(self) -> int:
        """Number of camera unknowns."""
        return self.n_cameras * len(self.free_interior) + 6 * len(self.view_camera)

    @property
    def of_view(self) -> np.ndarray:
        """Column of each free parameter of each view, (V, F) int."""
        k = len(self.free_interior)
        interior = self.view_camera[:, None] * k + np.arange(k)
        pose = self.n_cameras * k + 6 * np.arange(len(self.view_camera))[:, None] + np.arange(6)
        return np.concatenate([interior, pose], axis=1).astype(np.int64)

    def interior(self, camera: int) -> np.ndarray:
        """Columns of the free interior parameters of a camera."""
        k = len(self.free_interior)
        return np.arange(camera * k, (camera + 1) * k)

    def pose(self, view: int) -> np.ndarray:
        """Columns of the pose of a view."""
        return self.n_cameras * len(self.free_interior) + 6 * view + np.arange(6)


@dataclass(frozen=True)
class Groups:
    """The (bar, view) pairs among the observations, in order."""

    of_observation: np.ndarray
    view: np.ndarray
    of_bar: np.ndarray

    @classmethod
    def of(cls, network: Network) -> Groups:
        """Number the pairs of a network."""
        key = network.bar * network.n_views + network.view
        first = np.r_[True, np.diff(key) > 0] if len(key) else np.zeros(0, dtype=bool)
        start = np.flatnonzero(first)
        bars = np.searchsorted(network.bar[start], np.arange(len(network.bars) + 1))
        return cls(np.cumsum(first) - 1, network.view[start], bars)


@dataclass(frozen=True)
class Normal:
    """Undamped normal equations at a point: blocks from `linearize`, with priors, in camera columns."""

    cost: float
    U: np.ndarray
    gc: np.ndarray
    V: np.ndarray
    gp: np.ndarray
    W: np.ndarray


@dataclass(frozen=True)
class AdjustedNetwork:
    """Result of one adjustment.

    Attributes
    ----------
    network : Network
        At the solution.
    columns : Columns
    prior : Prior
    cost : float
        Sum of squared normalised residuals of image coordinates, lengths and priors.
    iterations : int
    converged : bool
    loss : float
        Scale of the pseudo-Huber loss that was used; 0 for least squares.
    """

    network: Network
    columns: Columns
    prior: Prior
    cost: float
    iterations: int
    converged: bool
    loss: float = 0.0

    @property
    def residuals(self) -> np.ndarray:
        """Image residuals, (M, 2) float, computed minus observed, pixels."""
        return image_residuals(self.network)

    @property
    def redundancy(self) -> int:
        """Observations minus unknowns (a datum of six parameters is free; the bars give the scale).

        Weak a-priori knowledge of lenses is not counted as observed.
        """
        n = self.network
        return 2 * len(n.bar) + len(n.bars) - (self.columns.n + 6 * len(n.bars) - 6)

    @property
    def sigma0(self) -> float:
        """A-posteriori standard deviation of unit weight: 1 if the a-priori standard deviations are right."""
        return float(np.sqrt(self.cost / max(self.redundancy, 1)))


def image_residuals(network: Network) -> np.ndarray:
    """Computed minus observed image coordinates, (M, 2) float, pixels; NaN for points behind a camera."""
    n = network
    return residuals(n.interior, n.view_camera, n.rotation, n.translation, n.bars, n.bar, n.view, n.end, n.pixels)


def datum_directions(network: Network, columns: Columns) -> tuple[np.ndarray, np.ndarray]:
    """How the unknowns change under a small motion (rotation, translation) of the world, which nothing observes.

    Returns
    -------
    cameras : (n, 6) float
    points : (P, 2, 3, 6) float
    """
    cameras = np.zeros((columns.n, 6))
    for v in range(network.n_views):
        rows = columns.pose(v)
        cameras[rows[:3], :3] = -network.rotation[v]
        cameras[rows[3:], 3:] = -network.rotation[v]
    points = np.zeros((*network.bars.shape, 6))
    x, y, z = np.moveaxis(network.bars, -1, 0)
    points[..., 0, 1], points[..., 0, 2] = z, -y
    points[..., 1, 0], points[..., 1, 2] = -z, x
    points[..., 2, 0], points[..., 2, 1] = y, -x
    points[..., np.arange(3), 3 + np.arange(3)] = 1.0
    return cameras, points


def normal_equations(network: Network, columns: Columns, groups: Groups, prior: Prior, loss: float = 0.0) -> Normal:
    """Linearize the adjustment at the network's state."""
    n = network
    free = columns.free
    cost, U, gc, V, gp, W = linearize(
        n.interior,
        n.view_camera,
        n.rotation,
        n.translation,
        n.bars,
        n.bar,
        n.view,
        n.end,
        n.pixels,
        n.sigmas,
        groups.of_observation,
        len(groups.view),
        free,
        n.length,
        n.length_sigma,
        loss,
    )
    full = np.zeros((columns.n, columns.n))
    right = np.zeros(columns.n)
    for v, c in enumerate(columns.of_view):
        full[np.ix_(c, c)] += U[v]
        right[c] += gc[v]
    if columns.free_interior:
        N, g = prior.normal(n.interior)
        index = list(columns.free_interior)
        for camera in range(columns.n_cameras):
            c = columns.interior(camera)
            full[np.ix_(c, c)] += N[camera][np.ix_(index, index)]
            right[c] += g[camera][index]
    return Normal(cost + prior.cost(n.interior), full, right, V, gp, W)


def reduced_system(
    normal: Normal, columns: Columns, groups: Groups, n_views: int, damping: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the reduced camera matrix (n, n), its right-hand side (n,) and the bars' inverse blocks (P, 6, 6)."""
    S, b, inverse = reduce_bars(normal.V, normal.gp, normal.W, groups.view, groups.of_bar, n_views, damping)
    reduced = normal.U.copy()
    reduced[np.diag_indices(columns.n)] *= 1.0 + damping
    right = normal.gc.copy()
    of_view = columns.of_view
    for v in range(n_views):
        right[of_view[v]] -= b[v]
        for w in range(v, n_views):
            rows, cols = np.ix_(of_view[v], of_view[w])
            if v == w:
                block = np.triu(S[v, v]) + np.triu(S[v, v], 1).T
                reduced[rows, cols] -= block
            else:
                reduced[rows, cols] -= S[v, w]
                reduced[cols.T, rows.T] -= S[v, w].T
    return reduced, right, inverse


def adjust(
    network: Network,
    free_interior: tuple[int, ...] = OPENCV,
    prior: Prior | None = None,
    loss: float = 0.0,
    max_iterations: int = 60,
    tolerance: float = 1e-10,
) -> AdjustedNetwork:
    """Adjust the network by Levenberg–Marquardt with the bars eliminated.

    Parameters
    ----------
    network : Network
        With approximate values.
    free_interior : tuple of int
        Interior parameters to estimate.
    prior : Prior, optional
    loss : float
        Scale of the pseudo-Huber loss on image points, in standard deviations; 0 for least squares.
    max_iterations : int
    tolerance : float
        Relative decrease of the cost at which it ends.

    Raises
    ------
    CalibrationError
        If there is nothing to adjust, or points lie behind the cameras that see them.
    """
    if not len(network.bars):
        raise CalibrationError("no bar position is seen at both ends by two cameras; nothing to adjust")
    prior = prior or Prior.none(len(network.names))
    columns = Columns(tuple(free_interior), network.view_camera, len(network.names))
    groups = Groups.of(network)
    of_view, n_views = columns.of_view, network.n_views
    normal = normal_equations(network, columns, groups, prior, loss)
    if not np.isfinite(normal.cost):
        raise CalibrationError("approximate values put points behind cameras that see them")
    damping, converged, iteration = 1e-3, False, 0
    while iteration < max_iterations and not converged:
        iteration += 1
        # Hold the datum by the cameras, which takes nothing from the solution
        datum, _ = datum_directions(network, columns)
        improved = False
        while damping < 1e10:
            reduced, right, inverse = reduced_system(normal, columns, groups, n_views, damping)
            scale = 1.0 / np.sqrt(np.maximum(np.diag(normal.U), 1e-30))
            matrix = reduced * scale[:, None] * scale
            held = datum / scale[:, None]
            held /= np.linalg.norm(held, axis=0)
            matrix += held @ held.T
            try:
                factor = scipy.linalg.cho_factor(matrix, lower=True, check_finite=False)
            except scipy.linalg.LinAlgError:
                damping *= 10
                continue
            step = -scale * scipy.linalg.cho_solve(factor, scale * right, check_finite=False)
            bar_step = back_substitute(inverse, normal.gp, normal.W, groups.view, groups.of_bar, step[of_view])
            candidate = _stepped(network, columns, step, bar_step)
            trial = normal_equations(candidate, columns, groups, prior, loss)
            if trial.cost <= normal.cost:
                improved = True
                break
            damping *= 10
        if not improved:
            converged = True
            break
        converged = normal.cost - trial.cost <= tolerance * normal.cost
        network, normal = candidate, trial
        damping = max(damping / 10, 1e-9)
    return AdjustedNetwork(network, columns, prior, normal.cost, iteration, converged, loss)


def _stepped(network: Network, columns: Columns, step: np.ndarray, bar_step: np.ndarray) -> Network:
    interior = network.interior.copy()
    for c in range(columns.n_cameras):
        interior[c, list(columns.free_interior)] += step[columns.interior(c)]
    poses = step[columns.n_cameras * len(columns.free_interior) :].reshape(-1, 6)
    return network.with_state(
        interior,
        rotated(network.rotation, poses[:, :3]),
        network.translation + poses[:, 3:],
        network.bars + bar_step.reshape(-1, 2, 3),
    )
