from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.model.ellipsoids import check_points, fit_ellipsoids
from geomocap.segmentation.contacts import count_contacts


def shell(rng: np.random.Generator, radii: np.ndarray, count: int) -> np.ndarray:
    """Points on an ellipsoid, uniform on the sphere that it is scaled from."""
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * radii


def eq2_reference(points: np.ndarray, center: np.ndarray, radii: np.ndarray, rotation: np.ndarray) -> float:
    """D^(2/5) of eq. 2, written as it stands."""
    local = (points - center) @ rotation
    big_f = ((local / radii) ** 2).sum(axis=1)
    on_surface = local / np.sqrt(big_f)[:, None]
    radial = np.linalg.norm(local - on_surface, axis=1)
    return (np.sqrt(radii.prod()) / len(points) * (radial * (np.sqrt(big_f) - 1) ** 2).sum()) ** 0.4


def test_known_ellipsoid_is_recovered():
    rng = np.random.default_rng(1)
    radii = np.array([0.5, 0.3, 0.12])
    rotation = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    center = np.array([1.0, -2.0, 3.0])
    points = shell(rng, radii, 20000) @ rotation.T + center
    fit = fit_ellipsoids(points, np.zeros(len(points), int), 1, 0.01)
    # 20,000 samples: the standard deviation of a mean square is below 1 %
    np.testing.assert_allclose(fit.radii[0], radii, rtol=0.02)
    np.testing.assert_allclose(fit.centers[0], center, atol=0.01)
    assert np.linalg.det(fit.rotations[0]) == pytest.approx(1.0)
    cosines = np.abs((fit.rotations[0] * rotation).sum(axis=0))
    assert (cosines > 0.999).all()
    assert fit.counts.tolist() == [20000]


def test_errors_are_eq2():
    rng = np.random.default_rng(2)
    points = np.concatenate([shell(rng, np.array([0.5, 0.3, 0.2]), 700), rng.normal(size=(900, 3)) + 4.0])
    labels = np.repeat([0, 1], [700, 900])
    fit = fit_ellipsoids(points, labels, 2, 0.02)
    for k in range(2):
        expected = eq2_reference(points[labels == k], fit.centers[k], fit.radii[k], fit.rotations[k])
        assert fit.errors[k] == pytest.approx(expected, rel=1e-9)


def test_axes_agree_with_numpy():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(400, 3)) * [3, 2, 1] @ rng.normal(size=(3, 3))
    fit = fit_ellipsoids(points, np.zeros(400, int), 1, 0.001)
    variances, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    np.testing.assert_allclose(fit.radii[0], np.sqrt(3 * variances[::-1]), rtol=1e-9)
    np.testing.assert_allclose(np.abs((fit.rotations[0] * axes[:, ::-1]).sum(axis=0)), 1.0, rtol=1e-9)


@settings(max_examples=25, deadline=None)
@given(turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-50, 50)] * 3), scale=st.floats(0.01, 100))
def test_fit_follows_rigid_motion_and_scale(turn, shift, scale):
    rng = np.random.default_rng(4)
    points = shell(rng, np.array([0.5, 0.3, 0.2]), 300) + rng.normal(size=(300, 3)) * 0.02
    rotation = Rotation.from_rotvec(turn).as_matrix()
    labels = np.zeros(300, int)
    a = fit_ellipsoids(points, labels, 1, 0.01)
    b = fit_ellipsoids(scale * points @ rotation.T + np.array(shift), labels, 1, 0.01 * scale)
    np.testing.assert_allclose(b.radii, scale * a.radii, rtol=1e-6)
    np.testing.assert_allclose(b.errors, scale * a.errors, rtol=1e-6)
    np.testing.assert_allclose(b.centers, scale * a.centers @ rotation.T + np.array(shift), atol=1e-9 * 100)


def test_flat_points_are_as_thick_as_a_cell():
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0]), -1).reshape(-1, 3) * 0.1
    fit = fit_ellipsoids(grid, np.zeros(400, int), 1, 0.1)
    assert fit.radii[0, 2] == pytest.approx(0.05)
    assert np.isfinite(fit.errors).all()


def contacts_reference(points: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    cells = np.floor(points - points.min(axis=0) + 0.5)
    near = (np.abs(cells[:, None] - cells[None]) <= 1).all(axis=-1)
    result = np.zeros((count, count), int)
    for a in range(count):
        for b in range(count):
            if a != b:
                result[a, b] = near[np.ix_(labels == a, labels == b)].sum()
    return result


@pytest.mark.parametrize("spread", [3.0, 12.0])
def test_contacts_agree_with_all_pairs(spread):
    rng = np.random.default_rng(5)
    points = rng.uniform(-spread, spread, size=(400, 3))
    labels = rng.integers(-1, 5, 400)
    np.testing.assert_array_equal(count_contacts(points, labels, 5), contacts_reference(points, labels, 5))


def test_contacts_do_not_wrap_around_the_grid():
    points = np.array([[0.0, 0, 0], [0, 0, 9], [0, 1, 0], [1, 0, 9]])
    contacts = count_contacts(points, np.arange(4), 4)
    assert not count_contacts(points, np.full(4, -1), 4).any()
    assert contacts.sum() == 4  # 0 with 2 (next in y) and 1 with 3 (next in x), both ways
    assert contacts[0, 2] == contacts[1, 3] == 1


@pytest.mark.parametrize(
    ("points", "text"),
    [
        (np.empty((0, 3)), "frame 7: no points"),
        (np.zeros((3, 3)), "frame 7: only 3 points"),
        (np.full((20, 3), np.nan), "frame 7: 20 points are not finite"),
        (np.zeros((20, 2)), "frame 7: points of shape"),
    ],
)
def test_bad_points_name_their_frame(points, text):
    with pytest.raises(GeometryError, match=text):
        check_points(points, 7, 16)


def test_a_set_without_points_has_no_error_and_spoils_no_other():
    points = np.random.default_rng(2).normal(size=(60, 3))
    found = fit_ellipsoids(points, np.repeat([0, 2], 30), 3, 0.1)
    assert found.counts.tolist() == [30, 0, 30] and found.errors[1] == 0 and (found.errors[[0, 2]] > 0).all()
