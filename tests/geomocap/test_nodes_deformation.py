"""Kernels that node tracking stands on, against the sums and energies written out."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.nodes.correspondences import Target, gather_features, gather_pulls, pull
from geomocap.nodes.deformation import block_pattern, normal_equations, solve_blocks, step, turn_by
from tests.geomocap.capsules import small_graph


def energy(g, w, A, goal, x, R):
    """The deformation's energy, written out."""
    total = 0.0
    for e, (i, j) in enumerate(g.edges):
        for a, b in ((i, j), (j, i)):
            total += w[e] * ((x[a] - x[b] - R[a] @ (g.nodes[a] - g.nodes[b])) ** 2).sum()
    y = g.deform(x, R)[0] - goal
    return total + np.einsum("si,sij,sj->", y, A, y)


def test_normal_equations_are_the_energy_s():
    rng = np.random.default_rng(1)
    _, _, g = small_graph()
    p = block_pattern(g)
    N, S = len(g.nodes), len(g.samples)
    x = g.nodes + 0.02 * rng.normal(size=(N, 3))
    R = Rotation.from_rotvec(0.3 * rng.normal(size=(N, 3))).as_matrix()
    w = rng.random(len(g.edges))
    A = rng.normal(size=(S, 3, 3))
    A = A @ A.transpose(0, 2, 1)
    goal = g.samples + 0.05 * rng.normal(size=(S, 3))
    b = np.einsum("sij,sj->si", A, g.deform(x, R)[0] - goal)
    H, right = normal_equations(
        x,
        R,
        g.nodes,
        g.edges,
        w,
        g.binding,
        g.weights,
        g.offsets,
        A,
        b,
        p.diagonal,
        p.of_edges,
        p.of_samples,
        len(p.column),
    )
    dense = np.zeros((6 * N, 6 * N))
    for i in range(N):
        for k in range(p.start[i], p.start[i + 1]):
            j = p.column[k]
            dense[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = H[k]
    np.testing.assert_allclose(dense, dense.T, atol=1e-9)

    # the gradient against differences of the energy
    for _ in range(8):
        z = rng.normal(size=(N, 6))
        h = 1e-6

        def moved(s, z=z):
            return energy(g, w, A, goal, x + s * z[:, 3:], Rotation.from_rotvec(s * z[:, :3]).as_matrix() @ R)

        slope = (moved(h) - moved(-h)) / (2 * h)
        np.testing.assert_allclose(slope, -2 * (right * z).sum(), rtol=1e-5)

    # the Hessian is JᵀJ: from residuals linear in the shifts alone it is exact
    z = np.zeros((N, 6))
    z[:, 3:] = rng.normal(size=(N, 3))
    curve = energy(g, w, A, goal, x + z[:, 3:], R) + energy(g, w, A, goal, x - z[:, 3:], R)
    curve -= 2 * energy(g, w, A, goal, x, R)
    np.testing.assert_allclose(curve, 2 * z.ravel() @ dense @ z.ravel(), rtol=1e-9)

    H[p.diagonal] += 0.01 * np.eye(6)
    solution = solve_blocks(H, right, p.start, p.column, p.diagonal, 3000, 1e-12)
    expected = np.linalg.solve(dense + 0.01 * np.eye(6 * N), right.ravel())
    np.testing.assert_allclose(solution.ravel(), expected, atol=1e-6 * np.abs(expected).max())


def test_step_finds_a_rigid_motion():
    _, _, g = small_graph()
    p = block_pattern(g)
    R0 = Rotation.from_rotvec([0.1, 0.4, -0.3]).as_matrix()
    goal = g.samples @ R0.T + [0.1, 0.0, 0.2]
    x, R = g.nodes, np.tile(np.eye(3), (len(g.nodes), 1, 1))
    A = np.tile(np.eye(3), (len(g.samples), 1, 1))
    for _ in range(6):
        x, R = step(g, p, x, R, np.ones(len(g.edges)), A, g.deform(x, R)[0] - goal, 200)
    np.testing.assert_allclose(x, g.nodes @ R0.T + [0.1, 0.0, 0.2], atol=1e-4)
    np.testing.assert_allclose(R, np.tile(R0, (len(R), 1, 1)), atol=2e-3)


def test_gather_is_the_sum_written_out():
    rng = np.random.default_rng(2)
    S, M = 20, 30
    y, q = rng.normal(size=(S, 3)), rng.normal(size=(M, 3))
    n = rng.normal(size=(M, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    found, taker = rng.integers(0, M, S), rng.integers(0, S, M)
    wf, wb = rng.random(S), rng.random(M)
    A, b, across = gather_pulls(y, q, n, found, wf, taker, wb, 0.1)
    pairs = [(s, found[s], wf[s]) for s in range(S)] + [(taker[k], k, wb[k]) for k in range(M)]
    A2, b2 = np.zeros((S, 3, 3)), np.zeros((S, 3))
    for s, k, w in pairs:
        W = w * (np.outer(n[k], n[k]) + 0.1 * np.eye(3))
        A2[s] += W
        b2[s] += W @ (y[s] - q[k])
    np.testing.assert_allclose(A, A2, atol=1e-12)
    np.testing.assert_allclose(b, b2, atol=1e-12)
    np.testing.assert_allclose(across, ((y - q[found]) * n[found]).sum(axis=1), atol=1e-12)


def test_pulls_of_features_are_those_written_out():
    rng = np.random.default_rng(3)
    S, M, F = 20, 30, 3
    y, q, n = rng.normal(size=(S, 3)), rng.normal(size=(M, 3)), rng.normal(size=(M, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    own, features, gradients = rng.random((S, F)), rng.random((M, F)), rng.normal(size=(M, F, 3))
    found, strength, unit = rng.integers(0, M, S), rng.random(S), np.array([0.1, 0.2, 0.3])
    A, b = np.ones((S, 3, 3)), np.ones((S, 3))
    gather_features(A, b, y, own, q, n, features, gradients, found, strength, unit)
    for s, p in enumerate(found):
        along = (y[s] - q[p]) - ((y[s] - q[p]) @ n[p]) * n[p]
        G = gradients[p] * unit[:, None]
        r = (features[p] - own[s]) * unit + G @ along
        np.testing.assert_allclose(A[s], 1 + strength[s] * G.T @ G, atol=1e-12)
        np.testing.assert_allclose(b[s], 1 + strength[s] * G.T @ r, atol=1e-12)


def test_strain_is_that_written_out():
    _, _, g = small_graph()
    rng = np.random.default_rng(4)
    x, R = g.nodes + 0.1 * rng.normal(size=g.nodes.shape), Rotation.random(len(g.nodes), rng=rng).as_matrix()
    i, j = g.edges.T
    rest, edge = g.nodes[i] - g.nodes[j], x[i] - x[j]
    misses = [np.linalg.norm(edge - np.einsum("eij,ej->ei", R[k], rest), axis=1) for k in (i, j)]
    np.testing.assert_allclose(g.strain(x, R), np.hypot(*misses) / np.sqrt(2) / g.lengths, rtol=1e-12)


def test_turns_of_a_step_are_rotation_vectors_no_longer_than_the_most():
    rng = np.random.default_rng(5)
    turns = rng.normal(size=(40, 3)) * np.logspace(-6, 1, 40)[:, None]
    turns[0] = 0
    R, turned = Rotation.random(40, rng=rng).as_matrix(), np.empty((40, 3, 3))
    turn_by(turns, R, 0.5, turned)
    much = np.maximum(np.linalg.norm(turns, axis=1, keepdims=True) / 0.5, 1)
    np.testing.assert_allclose(turned, Rotation.from_rotvec(turns / much).as_matrix() @ R, atol=1e-14)


def test_grids_of_a_frame_are_kept():
    target = Target(small_graph()[0], np.zeros(0))
    assert target.grid(0.1) is target.grid(0.1)
    np.testing.assert_array_equal(target.grid(0.2).data, target.coordinates(0.2))


def test_pull_vanishes_where_the_surface_fits():
    surface, _, g = small_graph()
    target = Target(surface, np.zeros(0))
    found = pull(target, g.samples, g.normals, g.features, 0.1, 0.05, 1.0)
    # every sample is one of the points; points that are no sample lie off its plane only by the curvature
    np.testing.assert_allclose(found.support, 1.0)
    assert np.abs(found.b).max() < 0.05
    assert found.energy < 0.1
