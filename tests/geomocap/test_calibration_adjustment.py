"""The adjustment against numeric derivatives, dense algebra, repeated sampling and Ceres."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.calibration.bundle_adjustment import (
    OPENCV,
    Columns,
    Groups,
    Prior,
    adjust,
    datum_directions,
    normal_equations,
)
from geomocap.calibration.covariance import covariance
from geomocap.calibration.network import Network, rotated
from geomocap.calibration.projection import camera_of, project_point
from geomocap.errors import CalibrationError
from tests.geomocap.bar_scenes import disturbed_network, object_errors, three_cameras, true_network

SCENE = three_cameras(3, 14)
Q = np.array([700.0, 705, 320, 236, -0.2, 0.05, 1e-3, -2e-3, 0.02, 0.01, -0.01, 0.003, 1.5])


def image_of(q: np.ndarray, R: np.ndarray, t: np.ndarray, X: np.ndarray) -> np.ndarray:
    xy = np.empty(2)
    assert project_point(q, R, t, X, xy, np.empty((2, 22)))
    return xy


def test_projection_is_colmaps() -> None:
    q = Q.copy()
    q[12] = 0
    X = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (20, 3))
    ours = np.array([image_of(q, np.eye(3), np.zeros(3), x) for x in X])
    np.testing.assert_allclose(ours, camera_of(q, (640, 480)).img_from_cam(X), rtol=1e-12)
    assert not project_point(q, np.eye(3), np.zeros(3), np.array([0, 0, -1.0]), np.empty(2), np.empty((2, 22)))


def test_derivatives_are_numeric_ones() -> None:
    rng = np.random.default_rng(1)
    R = rotated(np.eye(3)[None], rng.normal(0, 1, (1, 3)))[0]
    X = np.array([0.3, -0.4, 0.2])
    t = np.array([0.1, 0.2, 2.5]) - R @ X + np.array([0.3, -0.2, 0.0])
    J = np.empty((2, 22))
    project_point(Q, R, t, X, np.empty(2), J)
    numeric = np.empty((2, 22))
    for k in range(22):
        h = 1e-6 * max(1.0, abs(Q[k])) if k < 13 else 1e-6
        ends = []
        for sign in (1, -1):
            q, turn, shift, x = Q.copy(), np.zeros(3), t.copy(), X.copy()
            if k < 13:
                q[k] += sign * h
            elif k < 16:
                turn[k - 13] = sign * h
            elif k < 19:
                shift[k - 16] += sign * h
            else:
                x[k - 19] += sign * h
            ends.append(image_of(q, rotated(R[None], turn[None])[0], shift, x))
        numeric[:, k] = (ends[0] - ends[1]) / (2 * h)
    np.testing.assert_allclose(J, numeric, rtol=1e-5, atol=1e-4)


def dense(network: Network, prior: Prior) -> tuple[np.ndarray, np.ndarray, Columns]:
    """The slow, obvious normal matrix: the full Jacobian, row by row."""
    columns = Columns(OPENCV, network.view_camera, len(network.names))
    n = columns.n + 6 * len(network.bars)
    rows, right = [], []
    J, xy = np.empty((2, 22)), np.empty(2)
    for m in range(len(network.bar)):
        v, p, e = network.view[m], network.bar[m], network.end[m]
        project_point(network.interior[v], network.rotation[v], network.translation[v], network.bars[p, e], xy, J)
        A = np.zeros((2, n))
        A[:, columns.of_view[v]] = J[:, columns.free]
        A[:, columns.n + 6 * p + 3 * e + np.arange(3)] = J[:, 19:]
        rows.extend(A / network.sigmas[m])
        right.extend((xy - network.pixels[m]) / network.sigmas[m])
    for p, (a, b) in enumerate(network.bars):
        length = np.linalg.norm(a - b)
        row = np.zeros(n)
        row[columns.n + 6 * p + np.arange(6)] = np.r_[a - b, b - a] / length / network.length_sigma
        rows.append(row)
        right.append((length - network.length) / network.length_sigma)
    for c in range(len(network.names)):
        for k, parameter in enumerate(OPENCV):
            row = np.zeros(n)
            row[columns.interior(c)[k]] = 1 / prior.sigma[c, parameter]
            rows.append(row)
            right.append((network.interior[c, parameter] - prior.mean[c, parameter]) / prior.sigma[c, parameter])
    A, r = np.array(rows), np.array(right)
    return A.T @ A, A.T @ r, columns


def some_prior(network: Network) -> Prior:
    prior = Prior.none(3)
    sigma = np.where(np.arange(13) < 8, 50.0, np.inf) * np.ones((3, 1))
    return Prior(network.interior + 1.0, sigma, prior.aspect_sigma)


def test_normal_equations_are_the_dense_ones() -> None:
    network = disturbed_network(SCENE, 0.05, 0)
    prior = some_prior(network)
    N, g, columns = dense(network, prior)
    normal = normal_equations(network, columns, Groups.of(network), prior)
    k = columns.n
    np.testing.assert_allclose(normal.U, N[:k, :k], rtol=1e-9, atol=1e-6 * np.abs(N).max() * 1e-6)
    np.testing.assert_allclose(normal.gc, g[:k], rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(normal.gp.ravel(), g[k:], rtol=1e-8, atol=1e-6)
    for p in range(len(network.bars)):
        at = k + 6 * p + np.arange(6)
        np.testing.assert_allclose(normal.V[p], N[np.ix_(at, at)], rtol=1e-9)


def test_covariance_is_the_dense_one_under_inner_constraints() -> None:
    network = adjust(disturbed_network(SCENE, 0.05, 0)).network
    adjusted = adjust(network, prior=some_prior(network))
    N, _, columns = dense(adjusted.network, adjusted.prior)
    cameras, points = datum_directions(adjusted.network, columns)
    G = np.concatenate([cameras, points.reshape(-1, 6)])
    B = np.concatenate([np.zeros_like(cameras), points.reshape(-1, 6)])
    scale = 1 / np.sqrt(np.diag(N))
    bordered = np.block([[N * scale[:, None] * scale, B * scale[:, None]], [(B * scale[:, None]).T, np.zeros((6, 6))]])
    assert np.abs(N @ G).max() < 1e-6 * np.abs(N).max()  # the datum is free
    C = np.linalg.inv(bordered)[: len(N), : len(N)] * scale[:, None] * scale * adjusted.sigma0**2
    ours = covariance(adjusted)
    np.testing.assert_allclose(np.sqrt(np.diag(ours.cameras)), np.sqrt(np.diag(C)[: columns.n]), rtol=1e-4)
    at = columns.n + np.arange(3)
    np.testing.assert_allclose(ours.points[0, 0], C[np.ix_(at, at)], rtol=1e-3, atol=1e-14)


def test_precision_is_what_repetition_shows() -> None:
    scene = three_cameras(5, 30)
    errors, predicted, unit = [], [], []
    for seed in range(12):
        adjusted = adjust(disturbed_network(scene, 0.05, seed))
        assert adjusted.converged
        error, _ = object_errors(scene, adjusted.network.rig(), adjusted.network.bars, adjusted.network.frames)
        errors.append(np.mean(error**2))
        predicted.append(covariance(adjusted).point_sigma ** 2)
        unit.append(adjusted.sigma0)
    assert 0.8 < np.sqrt(np.mean(errors) / np.mean(predicted)) < 1.2
    assert 0.95 < np.mean(unit) < 1.05


def test_exact_observations_give_the_true_cameras() -> None:
    network = disturbed_network(SCENE, 0.05, 0)
    exact = true_network(SCENE, 0.05, 0)
    pixels = SCENE.rig.project(SCENE.bars.reshape(-1, 3)).reshape(3, -1, 2, 2)[exact.view, exact.bar, exact.end]
    adjusted = adjust(Network(**{**vars(network), "pixels": pixels}))
    np.testing.assert_allclose(adjusted.network.interior, exact.interior, rtol=1e-4, atol=1e-4)
    error, reprojection = object_errors(SCENE, adjusted.network.rig(), adjusted.network.bars, adjusted.network.frames)
    assert np.abs(error).max() < 1e-6 and reprojection < 1e-3


def test_loss_bears_outliers() -> None:
    scene = three_cameras(5, 40)
    network = disturbed_network(scene, 0.05, 0)
    network.pixels[::29] += 6.0
    fair, spoilt = (
        object_errors(scene, a.network.rig(), a.network.bars, a.network.frames)[1]
        for a in (adjust(network, loss=2.0), adjust(network))
    )
    assert fair < 0.25 * spoilt


def test_same_bits_twice() -> None:
    network = disturbed_network(SCENE, 0.05, 0)
    one, other = adjust(network), adjust(network)
    np.testing.assert_array_equal(one.network.bars, other.network.bars)
    np.testing.assert_array_equal(one.network.interior, other.network.interior)


def test_ceres_finds_the_same() -> None:
    pytest.importorskip("pyceres", reason="pyceres (extra `solver`) is not installed")
    from tests.geomocap.ceres_adjustment import adjust_with_ceres

    network = disturbed_network(three_cameras(2, 30), 0.05, 1)
    ours, theirs = adjust(network, tolerance=1e-14).network, adjust_with_ceres(network, 1)
    np.testing.assert_allclose(ours.interior[:, :4], theirs.interior[:, :4], atol=2e-3)
    np.testing.assert_allclose(ours.interior[:, 4:8], theirs.interior[:, 4:8], atol=1e-5)
    R = theirs.rotation[0].T @ ours.rotation[0]
    t = theirs.rotation[0].T @ (ours.translation[0] - theirs.translation[0])
    moved = ours.transformed(R, t)
    np.testing.assert_allclose(moved.bars, theirs.bars, atol=2e-6)
    np.testing.assert_allclose(moved.translation, theirs.translation, atol=2e-5)


def test_nothing_to_adjust_is_an_error() -> None:
    network = true_network(SCENE, 0.05, 0)
    with pytest.raises(CalibrationError, match="nothing to adjust"):
        adjust(network.with_observations(network.view == 0))
    behind = network.with_state(network.interior, network.rotation, network.translation - 50, network.bars)
    with pytest.raises(CalibrationError, match="behind"):
        adjust(behind)
