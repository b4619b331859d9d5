"""Self-calibrating bar adjustment beside `scipy.optimize.least_squares` and Ceres on the same problem and start."""

from __future__ import annotations

import time

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.spatial.transform import Rotation

from geomocap.calibration.bundle_adjustment import AdjustedNetwork, adjust, image_residuals
from geomocap.calibration.network import Network
from geomocap.calibration.projection import project_point
from geomocap.errors import CalibrationError
from tests.benchmarks.table import Row, measure
from tests.geomocap.bar_scenes import disturbed_network, eight_cameras, three_cameras
from tests.geomocap.ceres_adjustment import adjust_with_ceres


def by_scipy(network: Network) -> tuple[float, float]:
    """Adjust with scipy's sparse trust region and exact derivatives: seconds and final cost."""
    n = network
    C, P, M = len(n.names), len(n.bars), len(n.bar)
    start = np.concatenate([n.interior[:, :8].ravel(), np.zeros(6 * C), n.bars.ravel()])
    offset = 14 * C

    def state(x: np.ndarray) -> Network:
        interior = n.interior.copy()
        interior[:, :8] = x[: 8 * C].reshape(C, 8)
        pose = x[8 * C : offset].reshape(C, 6)
        R = Rotation.from_rotvec(pose[:, :3]).as_matrix() @ n.rotation
        return n.with_state(interior, R, n.translation + pose[:, 3:], x[offset:].reshape(P, 2, 3))

    def residuals(x: np.ndarray) -> np.ndarray:
        s = state(x)
        lengths = np.linalg.norm(s.bars[:, 0] - s.bars[:, 1], axis=1)
        return np.concatenate([(image_residuals(s) / n.sigmas[:, None]).ravel(), (lengths - n.length) / n.length_sigma])

    row = np.repeat(np.arange(2 * M), 17)
    columns = np.empty((M, 17), dtype=np.int64)
    columns[:, :8] = 8 * n.view[:, None] + np.arange(8)
    columns[:, 8:14] = 8 * C + 6 * n.view[:, None] + np.arange(6)
    columns[:, 14:] = offset + 3 * (2 * n.bar + n.end)[:, None] + np.arange(3)
    column = np.repeat(columns, 2, axis=0).ravel()
    bar_row = 2 * M + np.repeat(np.arange(P), 6)
    bar_column = (offset + 6 * np.arange(P)[:, None] + np.arange(6)).ravel()
    wanted = [*range(8), *range(13, 22)]

    def jacobian(x: np.ndarray):  # type: ignore[no-untyped-def]
        s = state(x)
        values = np.empty((M, 2, 17))
        J, xy = np.empty((2, 22)), np.empty(2)
        left = _left_jacobians(x[8 * C : offset].reshape(C, 6)[:, :3])
        for m in range(M):
            v = n.view[m]
            project_point(s.interior[v], s.rotation[v], s.translation[v], s.bars[n.bar[m], n.end[m]], xy, J)
            J[:, 13:16] = J[:, 13:16] @ left[v]
            values[m] = J[:, wanted] / n.sigmas[m]
        d = s.bars[:, 0] - s.bars[:, 1]
        g = d / np.linalg.norm(d, axis=1, keepdims=True) / n.length_sigma
        data = np.concatenate([values.ravel(), np.concatenate([g, -g], axis=1).ravel()])
        shape = (2 * M + P, len(x))
        return coo_matrix((data, (np.r_[row, bar_row], np.r_[column, bar_column])), shape=shape).tocsr()

    begin = time.perf_counter()
    result = least_squares(
        residuals, start, jac=jacobian, method="trf", x_scale="jac", ftol=1e-10, xtol=1e-12, gtol=1e-12, max_nfev=60
    )
    return time.perf_counter() - begin, 2 * result.cost


def _left_jacobians(vectors: np.ndarray) -> np.ndarray:
    """Derivatives of rotation vectors' rotations as small turns applied on the left, (C, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    K = np.zeros((len(vectors), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    K -= np.swapaxes(K, 1, 2)
    a = np.maximum(angle, 1e-6)
    return np.eye(3) + (1 - np.cos(a)) / a**2 * K + (a - np.sin(a)) / a**3 * (K @ K)


def benchmark() -> list[Row]:
    rows = []
    for what, scene, goal in (
        ("3 cameras × 60 bars", three_cameras(1, 60), "≤ 100 ms"),
        ("8 cameras × 500 bars", eight_cameras(1, 500), "≤ 2 s"),
    ):
        network = disturbed_network(scene, 0.05, seed=2)
        kept: list[AdjustedNetwork] = []
        ours = measure(lambda network=network, kept=kept: kept.append(adjust(network)), repeat=3)  # type: ignore[misc]
        result = kept[-1]
        seconds, cost = by_scipy(network)
        note = f"{result.iterations} iterations, cost {result.cost:.1f} (scipy {cost:.1f})"
        rows.append(Row(f"self-calibration, {what}", ours, "scipy least_squares", seconds, goal, note))
        try:
            ceres = measure(lambda network=network: adjust_with_ceres(network), repeat=2)  # type: ignore[misc]
        except CalibrationError:
            continue
        rows.append(Row(f"self-calibration, {what}", ours, "pycolmap + pyceres", ceres, goal, "with problem set-up"))
    return rows
