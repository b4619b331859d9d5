"""How good a calibration is, measured on what it was not adjusted to, and how well the recording covers the images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.calibration.bundle_adjustment import AdjustedNetwork, adjust
from geomocap.calibration.network import Network
from geomocap.calibration.orientation import ideal_coordinates
from geomocap.calibration.projection import INTERIOR_NAMES
from geomocap.errors import CalibrationError


@dataclass(frozen=True)
class HeldOut:
    """Lengths of bars measured with cameras that were calibrated without them.

    Attributes
    ----------
    frames : (n,) int
    errors : (n,) float
        Measured minus true length, metres.
    diagonal : float
        Diagonal of the box around all bar ends, metres.
    """

    frames: np.ndarray
    errors: np.ndarray
    diagonal: float

    @property
    def rms(self) -> float:
        """Root mean square error, metres."""
        return float(np.sqrt(np.mean(self.errors**2))) if len(self.errors) else float("nan")

    @property
    def relative(self) -> float:
        """Root mean square error as a fraction of the diagonal."""
        return self.rms / self.diagonal


def forward_intersection(network: Network) -> np.ndarray:
    """Intersect the rays to every bar end, each weighted by its precision at the point: (P, 2, 3) float, metres.

    The bars' known length has no part in it.
    """
    n = network
    ideal = np.empty((len(n.bar), 2))
    for c in range(len(n.names)):
        rows = n.view_camera[n.view] == c
        single = np.full((len(n.names), int(rows.sum()), 2), np.nan)
        single[c] = n.pixels[rows]
        ideal[rows] = ideal_coordinates(single, n.interior, n.sizes)[c]
    rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    directions = np.einsum("mji,mj->mi", n.rotation[n.view], rays)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = -np.einsum("mji,mj->mi", n.rotation[n.view], n.translation[n.view])
    point = 2 * n.bar + n.end
    ends = n.bars.reshape(-1, 3)
    focal = n.interior[n.view_camera[n.view], 0]
    for _ in range(2):
        distance = np.linalg.norm(ends[point] - origins, axis=1)
        weight = (focal / (distance * n.sigmas)) ** 2
        P = (np.eye(3) - directions[:, :, None] * directions[:, None, :]) * weight[:, None, None]
        A = np.zeros((len(ends), 3, 3))
        b = np.zeros((len(ends), 3))
        np.add.at(A, point, P)
        np.add.at(b, point, np.einsum("mij,mj->mi", P, origins))
        ends = np.linalg.solve(A, b[:, :, None])[:, :, 0]
    return ends.reshape(-1, 2, 3)


def diagonal_of(network: Network) -> float:
    """Diagonal of the box around all bar ends, metres."""
    ends = network.bars.reshape(-1, 3)
    return float(np.linalg.norm(ends.max(axis=0) - ends.min(axis=0)))


def held_out(adjusted: AdjustedNetwork, folds: int) -> HeldOut:
    """Adjust without a part of the bars, measure these, and so on for all parts.

    Parameters
    ----------
    adjusted : AdjustedNetwork
        Of all bars.
    folds : int
    """
    network = adjusted.network
    frames, errors = [], []
    part = np.arange(len(network.bars)) % folds
    for k in range(folds):
        test = part == k
        if not test.any() or test.all():
            continue
        try:
            fit = adjust(
                network.with_bars(~test), adjusted.columns.free_interior, adjusted.prior, adjusted.loss, tolerance=1e-8
            )
        except CalibrationError:
            continue
        unseen = network.with_bars(test)
        unseen = unseen.with_state(fit.network.interior, fit.network.rotation, fit.network.translation, unseen.bars)
        bars = forward_intersection(unseen)
        errors.append(np.linalg.norm(bars[:, 0] - bars[:, 1], axis=1) - network.length)
        frames.append(unseen.frames)
    if not errors:
        return HeldOut(np.zeros(0, dtype=np.int64), np.zeros(0), diagonal_of(network))
    order = np.argsort(np.concatenate(frames), kind="stable")
    return HeldOut(np.concatenate(frames)[order], np.concatenate(errors)[order], diagonal_of(network))


@dataclass(frozen=True)
class ImageCoverage:
    """Where in a camera's image the bar was seen.

    Attributes
    ----------
    camera : str
    grid : (4, 6) int
        Number of observed bar ends in each of 4 × 6 fields.
    """

    camera: str
    grid: np.ndarray

    @property
    def fraction(self) -> float:
        """Fraction of the fields with an observation."""
        return float((self.grid > 0).mean())

    @property
    def empty_side(self) -> str | None:
        """Which side of the image nearly nothing was seen on, if any."""
        sides = {
            "left third": self.grid[:, :2],
            "right third": self.grid[:, 4:],
            "upper quarter": self.grid[:1],
            "lower quarter": self.grid[3:],
        }
        empty = [name for name, part in sides.items() if (part > 0).mean() <= 0.25]
        return " and ".join(empty) if empty else None


def coverage(network: Network) -> tuple[ImageCoverage, ...]:
    """Count observed bar ends over each camera's image."""
    out = []
    camera = network.view_camera[network.view]
    for c, name in enumerate(network.names):
        w, h = network.sizes[c]
        own = network.pixels[camera == c]
        grid, _, _ = np.histogram2d(own[:, 1], own[:, 0], bins=(4, 6), range=((0, h), (0, w)))
        out.append(ImageCoverage(name, grid.astype(np.int64)))
    return tuple(out)


@dataclass(frozen=True)
class CameraMotion:
    """How the bar was moved.

    Attributes
    ----------
    directions : (3,) float
        Fractions of the bars' directions along their principal axes, largest first, sum 1; (1, 0, 0): parallel bars.
    spread : (3,) float
        Standard deviations of the bar ends' positions along their principal axes, metres, largest first.
    """

    directions: np.ndarray
    spread: np.ndarray

    @property
    def faults(self) -> tuple[str, ...]:
        """What is degenerate about it, in words."""
        out = []
        if self.directions[1] + self.directions[2] < 0.03:
            out.append("all bars are nearly parallel: turn the bar in all directions")
        elif self.directions[2] < 0.01:
            out.append("the bars' directions all lie in one plane: turn the bar out of it as well")
        if self.spread[2] < 0.04 * self.spread[0]:
            out.append("all bar positions lie nearly in one plane: move the bar through the depth of the volume")
        return tuple(out)


def motion(network: Network) -> CameraMotion:
    """Describe how the bar was moved."""
    d = network.bars[:, 1] - network.bars[:, 0]
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    directions = np.linalg.eigvalsh(d.T @ d / len(d))[::-1]
    ends = network.bars.reshape(-1, 3)
    s = np.linalg.svd(ends - ends.mean(axis=0), compute_uv=False) / np.sqrt(len(ends))
    return CameraMotion(directions, s)


def image_motion_faults(pixels: np.ndarray, sizes: np.ndarray, names: tuple[str, ...]) -> tuple[str, ...]:
    """Name what is degenerate about a recording from the images alone, when no calibration came of it.

    Parameters
    ----------
    pixels : (C, T, 2, 2) float
        The two ends in the images in which both were seen, NaN elsewhere.
    sizes : (C, 2) int
    names : tuple of C str
    """
    out = []
    parallel = []
    for c, name in enumerate(names):
        good = np.isfinite(pixels[c]).all(axis=(1, 2))
        if good.sum() < 3:
            out.append(f"camera {name} sees both ends in {int(good.sum())} frames only")
            continue
        ends = pixels[c, good]
        box = (ends.reshape(-1, 2).max(axis=0) - ends.reshape(-1, 2).min(axis=0)) / sizes[c]
        if box.prod() < 0.08:
            out.append(f"in camera {name} the bar stays in a corner of {100 * box.prod():.0f} % of the image")
        d = ends[:, 1] - ends[:, 0]
        angle = np.arctan2(d[:, 1], d[:, 0])
        parallel.append(abs(np.exp(2j * angle).mean()) > 0.97)
    if parallel and all(parallel):
        out.append("all bars are nearly parallel in every image: turn the bar in all directions")
    return tuple(out)


@dataclass(frozen=True)
class CameraPrecision:
    """Interior and exterior orientation of a camera with standard deviations.

    Attributes
    ----------
    camera : str
    parameters : dict of str to (value, standard deviation)
        Estimated interior parameters.
    center_sigma : float
        Root mean square standard deviation of the projection centre's coordinates, metres.
    angle_sigma_deg : float
        Root mean square standard deviation of the rotation about the camera's axes.
    rays : int
        Observed bar ends.
    rms_px : float
        Root mean square residual of an image coordinate.
    """

    camera: str
    parameters: dict[str, tuple[float, float]]
    center_sigma: float
    angle_sigma_deg: float
    rays: int
    rms_px: float


def camera_precision(adjusted: AdjustedNetwork, camera_covariance: np.ndarray) -> tuple[CameraPrecision, ...]:
    """Return what the adjustment says about every camera's precision (of its last view, if it has two)."""
    n, columns = adjusted.network, adjusted.columns
    residuals = adjusted.residuals
    out = []
    for c, name in enumerate(n.names):
        view = int(np.flatnonzero(n.view_camera == c)[-1])
        sigma = np.sqrt(np.diag(camera_covariance))
        parameters = {
            INTERIOR_NAMES[p]: (float(n.interior[c, p]), float(sigma[columns.interior(c)[k]]))
            for k, p in enumerate(columns.free_interior)
        }
        pose = columns.pose(view)
        block = camera_covariance[np.ix_(pose, pose)]
        t = n.translation[view]
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        A = -n.rotation[view].T @ np.concatenate([cross, np.eye(3)], axis=1)
        center = A @ block @ A.T
        own = n.view_camera[n.view] == c
        out.append(
            CameraPrecision(
                name,
                parameters,
                float(np.sqrt(np.trace(center) / 3)),
                float(np.degrees(np.sqrt(np.trace(block[:3, :3]) / 3))),
                int(own.sum()),
                float(np.sqrt(np.mean(residuals[own] ** 2))) if own.any() else float("nan"),
            )
        )
    return tuple(out)
