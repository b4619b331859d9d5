"""Normals and gradients of a frame's points: the kernels against NumPy."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geomocap.model.surface import plane_normals
from geomocap.nodes.surface_points import feature_gradients


@pytest.fixture(scope="module")
def cloud():
    """Points of a bumpy sheet, their neighbours, and what else is known of them."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-1, 1, (2, 400))
    points = np.column_stack([x, y, 0.2 * np.sin(3 * x) * y]) + 5.0
    return points, cKDTree(points).query(points, 12)[1], rng.normal(size=(400, 3))


def test_normals_are_those_of_numpy(cloud):
    points, near, _ = cloud
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    expected = np.linalg.eigh(np.einsum("mki,mkj->mij", local, local))[1][:, :, 0]
    found = plane_normals(points, near)
    assert np.abs((found * expected).sum(axis=1)).min() > 1 - 1e-12
    some = plane_normals(points, near[::7])
    np.testing.assert_array_equal(some, found[::7])


def test_gradients_are_those_of_numpy(cloud):
    points, near, features = cloud
    normals = plane_normals(points, near)
    offset = points[near] - points[:, None]
    offset -= np.einsum("mki,mi->mk", offset, normals)[..., None] * normals[:, None]
    A = np.einsum("mki,mkj->mij", offset, offset)
    held = np.einsum("mi,mj->mij", normals, normals) + 1e-3 * np.eye(3)
    A += np.trace(A, axis1=1, axis2=2)[:, None, None] * held
    right = np.einsum("mki,mkf->mif", offset, features[near] - features[:, None])
    expected = np.linalg.solve(A, right).transpose(0, 2, 1)
    found = feature_gradients(points, normals, near, features)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    assert feature_gradients(points, normals, near, features[:, :0]).shape == (400, 0, 3)
