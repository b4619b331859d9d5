"""Pairing and labelling kernels against slow references."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.optimize import least_squares

from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.disc import blurred_disc, fit_disc
from geomocap.calibration.eccentricity import shifts
from geomocap.calibration.labelling import identify_frame
from geomocap.calibration.orientation import ideal_coordinates, relative_orientation
from geomocap.calibration.pairs import eight_point, score_pairings
from geomocap.calibration.projection import interior_of
from geomocap.calibration.stability import resect
from geomocap.model.triangulation import nearest_to_rays
from tests.geomocap.bar_scenes import eight_cameras, seen, three_cameras, true_network

SCENE = three_cameras(9, 24)
INTERIOR = np.array([interior_of(c) for c in SCENE.rig.cameras])


def sampson(F: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    a, b = np.r_[x, 1], np.r_[y, 1]
    p, q = F @ a, F.T @ b
    return float((b @ F @ a) ** 2 / (p[0] ** 2 + p[1] ** 2 + q[0] ** 2 + q[1] ** 2))


def test_scores_of_pairings_are_sampson_distances() -> None:
    rng = np.random.default_rng(0)
    Fs, a, b = rng.normal(size=(4, 3, 3)), rng.normal(size=(5, 2, 2)), rng.normal(size=(5, 2, 2))
    best, swapped = np.empty((4, 5)), np.zeros((4, 5), dtype=np.bool_)
    score_pairings(Fs, a, b, 0.7, best, swapped)
    for h, k in product(range(4), range(5)):
        costs = [max(sampson(Fs[h], a[k, e], b[k, e if not swap else 1 - e]) for e in (0, 1)) / 0.49 for swap in (0, 1)]
        np.testing.assert_allclose(best[h, k], min(1.0, *costs))
        if min(costs) < 1:
            assert swapped[h, k] == (costs[1] < costs[0])


def test_eight_points_and_relative_orientation() -> None:
    points = SCENE.bars.reshape(-1, 3)
    cameras = SCENE.rig.to_camera(points)
    ideal = cameras[..., :2] / cameras[..., 2:]
    (F,) = eight_point(ideal[:1], ideal[1:2])
    relative = relative_orientation(ideal[0].reshape(-1, 2, 2), ideal[1].reshape(-1, 2, 2), F, SCENE.length)
    assert relative is not None
    R, t = SCENE.rig.cam_from_world[:, :, :3], SCENE.rig.cam_from_world[:, :, 3]
    np.testing.assert_allclose(relative.pose[:, :3], R[1] @ R[0].T, atol=1e-8)
    np.testing.assert_allclose(relative.pose[:, 3], t[1] - R[1] @ R[0].T @ t[0], atol=1e-8)


def test_triangulation_needs_two_rays() -> None:
    origins = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]])
    directions = np.array([[0.6, 0, 0.8], [-0.28, 0, 0.96], [0, 0, 1.0]])
    use = np.array([[True, False], [True, False], [False, True]])  # two rays of the first point, one of the second
    points = nearest_to_rays(origins[:, None], np.repeat(directions[:, None], 2, axis=1), use)
    s = np.linalg.lstsq(np.stack([directions[0], -directions[1]], axis=1), origins[1] - origins[0], rcond=None)[0]
    np.testing.assert_allclose(points[0], s[0] * directions[0], atol=1e-12)
    assert np.isnan(points[1:]).all()


def labels_by_brute_force(pixels: np.ndarray, limit: float) -> np.ndarray:
    """The assignment of candidates to two ends with the most candidates near the images of a bar of the right length.

    Every choice of one candidate or none for each end and camera is tried.
    """
    C, K = pixels.shape[:2]
    ideal = ideal_coordinates(pixels, INTERIOR, SCENE.rig.sizes)
    R = SCENE.rig.cam_from_world[:, :, :3]
    ends = []
    for choice in product(range(-1, K), repeat=C):
        used = [c for c in range(C) if choice[c] >= 0]
        if len(used) < 2 or any(np.isnan(pixels[c, choice[c], 0]) for c in used):
            continue
        rays = np.array([np.r_[ideal[c, choice[c]], 1] @ R[c] for c in used])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        X = nearest_to_rays(SCENE.rig.centers[used][:, None], rays[:, None])
        image = SCENE.rig.project(X)[:, 0]
        if all(np.linalg.norm(image[c] - pixels[c, choice[c]]) < limit for c in used):
            ends.append((len(used), choice, X[0]))
    best = (0, None)
    for (n, a, x), (m, b, y) in product(ends, ends):
        apart = all(i != j or i < 0 for i, j in zip(a, b, strict=True))
        if a < b and apart and abs(np.linalg.norm(x - y) - SCENE.length) < 0.05 * SCENE.length and n + m > best[0]:
            best = (n + m, np.array([a, b]).T)
    return best[1]


def test_labels_are_those_of_brute_force() -> None:
    rng = np.random.default_rng(2)
    observations = seen(SCENE, rng, 0.3, 0.8, np.array([0.0, 0.3, 0.1]))
    pose = SCENE.rig.cam_from_world
    compared = 0
    for t in range(12):
        pixels = np.ascontiguousarray(observations.pixels[:, t])
        ideal = ideal_coordinates(pixels, INTERIOR, SCENE.rig.sizes)
        chosen = np.empty((3, 2), dtype=np.int64)
        R, shift = np.ascontiguousarray(pose[:, :, :3]), np.ascontiguousarray(pose[:, :, 3])
        limit = np.full(3, 3.0)
        identify_frame(pixels, ideal, INTERIOR, R, shift, SCENE.length, 0.05 * SCENE.length, limit, chosen)
        expected = labels_by_brute_force(pixels, 3.0)
        if expected is None:
            assert (chosen < 0).all()
            continue
        compared += 1
        assert sorted(map(tuple, chosen.T)) == sorted(map(tuple, expected.T))
    assert compared >= 8


def test_resection_without_knowing_the_ends() -> None:
    scene = eight_cameras(2, 30)
    network = true_network(scene, 0.1, 0)
    observations = seen(scene, np.random.default_rng(3), 0.1)
    pose = resect(network, observations, 4, np.arange(30), 2.0, np.random.default_rng(0))
    assert pose is not None
    np.testing.assert_allclose(pose, scene.rig.cam_from_world[4], atol=0.02)
    elsewhere = observations.pixels.copy()
    elsewhere[4] = np.random.default_rng(5).uniform(0, 200, elsewhere[4].shape)
    assert (
        resect(
            network,
            type(observations)(*{**vars(observations), "pixels": elsewhere}.values()),
            4,
            np.arange(30),
            2.0,
            np.random.default_rng(0),
        )
        is None
    )


def test_disc_fit_is_the_least_squares_one() -> None:
    rng = np.random.default_rng(0)
    columns, rows = np.meshgrid(np.arange(25.0), np.arange(25.0))

    def model(u: np.ndarray) -> np.ndarray:
        dx, dy = columns - u[0], rows - u[1]
        r = np.hypot((1 + u[5]) * dx + u[6] * dy, u[6] * dx + (1 - u[5]) * dy)
        D = np.array([blurred_disc(v, u[3], u[4])[0] for v in r.ravel()]).reshape(r.shape)
        return (1 - D) * (u[7] + u[8] * dx + u[9] * dy) + D * u[2]

    truth = np.array([12.23, 11.81, 200, 3.0, 0.7, 0.03, -0.02, 30, 0.4, -0.2])
    image = (model(truth) + rng.normal(0, 1.5, columns.shape)).astype(np.float32)
    result = np.zeros(16)
    assert fit_disc(image, 12.5, 12.5, 3.0, 0.8, 20.0, 254.0, result)
    used = int(result[13])
    reference = least_squares(lambda u: (model(u) - image).ravel(), truth, x_scale=np.maximum(np.abs(truth), 0.1))
    scatter = np.linalg.inv(reference.jac.T @ reference.jac) * 2 * reference.cost / (image.size - 10)
    if used == image.size:  # nothing was left out beside the target
        np.testing.assert_allclose(result[:2] - 0.5, reference.x[:2], atol=2e-4)
    np.testing.assert_allclose(result[:2] - 0.5, reference.x[:2], atol=2e-3)
    np.testing.assert_allclose(result[11:13], np.sqrt(np.diag(scatter)[:2]), rtol=0.05)


def test_eccentricity_is_that_of_a_sphere() -> None:
    network = true_network(SCENE, 0.01, 0)
    shift = shifts(network, 0.05)
    # Without distortion the centre of the outline lies at x Z / (Z² − r²) (Heikkilä & Silvén 1997)
    plain = network.interior.copy()
    plain[:, 4:] = 0
    undistorted = network.with_state(plain, network.rotation, network.translation, network.bars)
    X = np.einsum("mij,mj->mi", network.rotation[network.view], network.bars[network.bar, network.end])
    X += network.translation[network.view]
    ideal = X[:, :2] / X[:, 2:]
    exact = ideal * (X[:, 2:] ** 2 / (X[:, 2:] ** 2 - 0.05**2) - 1) * plain[network.view, :2]
    # The rim is a polygon of 32 points
    np.testing.assert_allclose(shifts(undistorted, 0.05), exact, rtol=0.01)
    assert np.abs(shift - exact).max() < 0.1
    assert BarSettings().targets.shape == "sphere"
