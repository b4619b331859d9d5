"""Kernels of the search for lost pieces, against NumPy."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.patches.piece_search import fill_cells, rigid_motions, together


def test_cells_know_the_nearest_place():
    rng = np.random.default_rng(0)
    places, low, edge, reach = rng.uniform(0.2, 0.8, (200, 3)), np.zeros(3), 0.03, 0.07
    cells = np.full((33, 33, 33), -1, np.int32)
    fill_cells(places, low, edge, reach, cells, np.full(cells.shape, np.inf, np.float32))
    middles = (np.stack(np.meshgrid(*[np.arange(33)] * 3, indexing="ij"), axis=-1) + 0.5) * edge
    distance, near = cKDTree(places).query(middles)
    assert_array_equal(cells >= 0, distance < reach)
    assert_array_equal(cells[distance < reach], near[distance < reach])


def test_likeness_of_pieces_is_that_of_numpy():
    rng = np.random.default_rng(1)
    P, m, K, A, edge = 40, 6, 300, 24, 0.1
    frames = Rotation.random(P, rng=rng).as_matrix()
    turns, shifts = Rotation.random(K, rng=rng).as_matrix(), rng.uniform(0.2, 0.8, (K, 3))
    X, Q = rng.normal(0, 0.2, (m, 3)), Rotation.random(m, rng=rng).as_matrix()
    alike, who = rng.uniform(-1, 1, (A, m + 3, P)).astype(np.float32), rng.permutation(m + 3)[:m]
    low, cells = np.zeros(3), rng.integers(-1, P, (10, 10, 10)).astype(np.int32)
    value = np.empty(K, np.float32)
    together(0, len(turns), turns, shifts, X, Q, who, frames, alike, low, edge, cells, value)
    at = np.floor((X @ turns.swapaxes(1, 2) + shifts[:, None] - low) / edge).astype(int)
    inside = ((at >= 0) & (at < 10)).all(axis=2)
    place = np.where(inside, cells[tuple(np.moveaxis(at.clip(0, 9), 2, 0))], -1)
    between = frames[place].swapaxes(2, 3) @ (turns[:, None] @ Q)
    angle = np.arctan2(between[..., 1, 0] - between[..., 0, 1], between[..., 0, 0] + between[..., 1, 1])
    k = np.rint(angle * A / (2 * np.pi)).astype(int) % A
    each = np.where((place >= 0) & (between[..., 2, 2] >= 0.5), np.maximum(alike[k, who, place], 0), 0)
    assert (each > 0).mean() > 0.05
    assert_allclose(value, each.mean(axis=1), rtol=1e-5)


def test_rigid_motions_are_found_in_spite_of_outliers():
    rng = np.random.default_rng(4)
    X, Q = rng.normal(0, 0.1, (20, 3)), Rotation.random(20, rng=rng).as_matrix()
    turns, shifts = Rotation.random(3, rng=rng).as_matrix(), rng.normal(0, 1, (3, 3))
    Y, S = X @ turns.swapaxes(1, 2) + shifts[:, None], turns[:, None] @ Q
    weight = rng.uniform(0.5, 1.0, (3, 20))
    found = rigid_motions(X, Q, Y, S, weight, 0.02)
    assert_allclose(found[0], turns, atol=1e-9)
    assert_allclose(found[1], shifts, atol=1e-9)
    Y[:, :6] += rng.normal(0, 0.1, (3, 6, 3))
    found = rigid_motions(X, Q, Y, S, weight, 0.02)
    assert_allclose(found[0], turns, atol=0.02)
    assert_allclose(found[1], shifts, atol=0.002)
