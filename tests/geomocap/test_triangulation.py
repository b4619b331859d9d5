"""Forward intersection: exact points, covariances against a Monte Carlo experiment, and what can't be intersected."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.model.rig import Rig
from geomocap.model.triangulation import triangulate
from tests.geomocap.ball import ring


@pytest.mark.parametrize("distortion", [0.0, -0.1])
def test_exact_pixels_give_exact_points(distortion: float) -> None:
    rig = ring(4, 120, distortion=distortion)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    found = triangulate(rig, rig.project(points))
    np.testing.assert_allclose(found.points, points, atol=1e-6)
    assert (found.views == 4).all()
    assert found.residual.max() < 1e-3


def test_covariance_is_that_of_an_experiment() -> None:
    rig = ring(3, 40)
    point = np.array([[0.1, -0.2, 0.05]])
    rng = np.random.default_rng(1)
    C = np.array([[[0.04, 0.01], [0.01, 0.02]], [[0.01, 0.0], [0.0, 0.09]], [[0.02, -0.01], [-0.01, 0.03]]])
    n = 4000
    true = rig.project(point)
    pixels = np.stack([rng.multivariate_normal(true[v, 0], C[v], n) for v in range(3)])
    found = triangulate(rig, pixels, np.broadcast_to(C[:, None], (3, n, 2, 2)))
    actual = np.cov(found.points.T)
    np.testing.assert_allclose(actual, found.covariance.mean(axis=0), atol=0.06 * actual.max())
    assert found.sigma.mean() == pytest.approx(np.sqrt(np.trace(actual)), rel=0.05)
    # Mean of chi with three degrees of freedom over √3
    assert np.mean(found.sigma0**2) == pytest.approx(1, abs=0.05)


def test_a_point_needs_two_cameras() -> None:
    rig = ring(3, 60)
    points = np.random.default_rng(2).uniform(-0.2, 0.2, (4, 3))
    pixels = rig.project(points)
    seen = np.ones((3, 4), bool)
    seen[1:, 0] = False
    pixels[0, 1] = np.nan
    found = triangulate(rig, pixels, None, seen)
    assert found.views.tolist() == [1, 2, 3, 3]
    assert np.isnan(found.points[0]).all() and np.isnan(found.sigma[0])
    np.testing.assert_allclose(found.points[1:], points[1:], atol=1e-6)


def test_parallel_rays_and_points_behind_are_refused() -> None:
    one = ring(2, 30).select(["cam0"])
    twice = Rig(("a", "b"), one.cameras * 2, np.repeat(one.cam_from_world, 2, axis=0))
    assert np.isnan(triangulate(twice, np.full((2, 1, 2), 90.0)).points).all()
    # A camera beside the first, looking the same way: rays that part meet behind them
    poses = np.array(twice.cam_from_world)
    poses[1, 0, 3] -= 0.3
    beside = Rig(("a", "b"), one.cameras * 2, poses)
    meeting = np.array([[[150.0, 80.0]], [[130.0, 80.0]]])
    assert np.isfinite(triangulate(beside, meeting).points).all()
    assert np.isnan(triangulate(beside, meeting[::-1]).points).all()
    assert len(triangulate(beside, np.zeros((2, 0, 2))).points) == 0
