"""Node tracking on bodies with known motion: a bending arm, two limbs that touch, and the kernels it stands on."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError
from geomocap.nodes.coarse_motion import NEAR, CoarseTarget, State, mend
from geomocap.nodes.correspondences import Target, gather_features, gather_pulls, pull
from geomocap.nodes.deformation import block_pattern, normal_equations, solve_blocks, step, turn_by
from geomocap.nodes.extremities import extremities, match_ends
from geomocap.nodes.keyframes import most_open, openness
from geomocap.nodes.node_graph import farthest_points, node_graph
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_tracking import NodeModel, track_nodes
from geomocap.nodes.surface_points import PointSet, point_set, surface_graph

SMALL = NodeTrackingSettings(nodes=150, coarse_nodes=60, points=1200, coarse_points=800)


def capsule(count: int, length: float = 1.0, radius: float = 0.08, seed: int = 0) -> np.ndarray:
    """Points on a flattened capsule along x, evenly by area but for the flattening."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    side = rng.random(count) < length / (length + 2 * radius)
    d[side, 0] = 0
    d[side] /= np.linalg.norm(d[side], axis=1, keepdims=True)
    p = radius * d
    p[:, 0] += np.where(side, rng.uniform(0, length, count), np.where(d[:, 0] > 0, length, 0))
    return p * [1, 1, 0.7]


def bend(p: np.ndarray, angle: float) -> np.ndarray:
    """Bend what lies at x > 0.5 about z by an angle, smoothly over 10 cm; lengths along the middle stay."""
    fraction = np.clip((p[:, 0] - 0.45) / 0.1, 0, 1) * angle
    R = Rotation.from_rotvec(np.column_stack([0 * fraction, 0 * fraction, fraction])).as_matrix()
    joint = np.array([0.5, 0, 0])
    return np.einsum("nij,nj->ni", R, p - joint) + joint


def small_graph():
    surface = point_set(capsule(900), 900, 9)
    graph = surface_graph(surface.positions, surface.normals, 8)
    chosen = farthest_points(surface.positions, 50)
    return surface, graph, node_graph(surface, graph, chosen, 300)


def test_normals_point_outwards():
    p = capsule(1500)
    s = point_set(p, 1500, 9)
    axis = np.clip(s.positions[:, :1], 0, 1) * [1.0, 0, 0]
    outwards = s.positions - axis
    assert ((outwards * s.normals).sum(axis=1) > 0).mean() > 0.995


def test_feature_gradients_of_a_linear_field():
    p = capsule(2000)
    field = np.column_stack([2 * p[:, 0], p @ [1.0, -1, 0.5]])
    s = point_set(p, 2000, 12, features=field)
    for f, g in enumerate(([2.0, 0, 0], [1.0, -1, 0.5])):
        along = g - (s.normals @ g)[:, None] * s.normals
        assert np.median(np.linalg.norm(s.gradients[:, f] - along, axis=1)) < 0.1 * np.linalg.norm(g)


def test_too_few_points_say_so():
    with pytest.raises(GeometryError, match="more than 9 are needed"):
        point_set(np.zeros((5, 3)), 100, 9)
    with pytest.raises(GeometryError, match="frame 1: a surface of 5 distinct points"):
        track_nodes(lambda t: capsule(900)[: (900, 5)[t]], 2, SMALL)


def test_samples_ride_rigidly():
    _, _, g = small_graph()
    R = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    t = np.array([0.3, 2.0, -1.0])
    y, n = g.deform(g.nodes @ R.T + t, np.tile(R, (len(g.nodes), 1, 1)))
    np.testing.assert_allclose(y, g.samples @ R.T + t, atol=1e-12)
    np.testing.assert_allclose(n, g.normals @ R.T, atol=1e-12)
    np.testing.assert_allclose(g.strain(g.nodes @ R.T + t, np.tile(R, (len(g.nodes), 1, 1))), 0, atol=1e-12)


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


def test_trees_of_a_frame_are_kept():
    target = Target(small_graph()[0], np.zeros(0))
    assert target.tree(0.1) is target.tree(0.1)
    np.testing.assert_array_equal(target.tree(0.2).data, target.coordinates(0.2))


def test_pull_vanishes_where_the_surface_fits():
    surface, _, g = small_graph()
    target = Target(surface, np.zeros(0))
    found = pull(target, g.samples, g.normals, g.features, 0.1, 0.05, 1.0)
    # every sample is one of the points; points that are no sample lie off its plane only by the curvature
    np.testing.assert_allclose(found.support, 1.0)
    assert np.abs(found.b).max() < 0.05
    assert found.energy < 0.1


def test_ends_of_a_capsule():
    p = capsule(1500)
    s = point_set(p, 1500, 9)
    ends = s.positions[extremities(surface_graph(s.positions, s.normals, 8), 0.2)]
    assert len(ends) == 2
    np.testing.assert_allclose(np.sort(ends[:, 0]), [-0.08, 1.08], atol=0.04)


def test_ends_are_matched_within_reach():
    expected = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    seen = np.array([[0.9, 0, 0], [0.1, 0, 0]])
    i, j = match_ends(expected, seen, 0.5)
    assert dict(zip(i.tolist(), j.tolist(), strict=True)) == {0: 1, 1: 0}
    assert len(match_ends(expected, np.zeros((0, 3)), 1.0)[0]) == 0


@pytest.fixture(scope="module")
def bending():
    """An arm that bends by 80° in 8 frames, sampled afresh in each."""
    angles = np.deg2rad(np.linspace(0, 80, 8))
    tracks = track_nodes(lambda t: bend(capsule(1500, seed=10 + t), angles[t]), 8, SMALL)
    return angles, tracks


def test_bending_arm(bending):
    angles, tracks = bending
    assert tracks.positions.shape == (150, 8, 3)
    # which point of the straight arm each node is: found in the reference frame, where its bend is known
    straight = unbend(tracks.reference, angles[tracks.reference_frame])
    truth = np.stack([bend(straight, a) for a in angles], axis=1)
    error = np.linalg.norm(tracks.positions - truth, axis=-1)
    # nodes are 4 cm apart; limbs slide by less than a quarter of that
    assert np.nanmedian(error) < 0.008
    assert np.nanpercentile(error, 95) < 0.025
    for part, turn in ((straight[:, 0] < 0.3, 0 * angles), (straight[:, 0] > 0.7, angles)):
        since = turn - turn[tracks.reference_frame]
        true = Rotation.from_rotvec(np.column_stack([0 * since, 0 * since, since])).as_matrix()
        difference = np.einsum("tji,ntjk->ntik", true, tracks.rotations[part])
        angle = np.arccos(np.clip((np.trace(difference, axis1=2, axis2=3) - 1) / 2, -1, 1))
        assert np.percentile(np.rad2deg(angle), 90) < 12


def test_openness_prefers_stretched_limbs():
    straight, folded = (point_set(bend(capsule(1200), a), 1200, 9) for a in (0.0, 2.8))
    open_, closed = (openness(surface_graph(s.positions, s.normals, 8)) for s in (straight, folded))
    assert closed < open_
    assert most_open([1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 1.0], list(range(7)), 7) == 4
    # near equals: the one next to the middle
    assert most_open([1.0] * 9, list(range(9)), 9) == 4


def test_normals_on_the_wrong_side_are_turned():
    s = point_set(capsule(1000), 1000, 9)
    wrong = replace(s, normals=-s.normals)
    np.testing.assert_array_equal(wrong.turned_like(s.positions, s.normals, 0.05).normals, s.normals)
    np.testing.assert_array_equal(s.turned_like(s.positions, s.normals, 0.05).normals, s.normals)


def unbend(p: np.ndarray, angle: float) -> np.ndarray:
    """Undo `bend`, by search along the straight arm's coordinates."""
    dense = capsule(60000, seed=99)
    return dense[cKDTree(bend(dense, angle)).query(p)[1]]


def test_skin_of_a_limb_is_free_to_slide_along_it(bending):
    angles = bending[0]
    skin = SMALL.model_copy(update={"part_rounds": 0})  # a rigid part would be held by the limb's end
    tracks = track_nodes(lambda k: bend(capsule(1200, seed=10 + k), angles[k]), len(angles), skin)
    straight = unbend(tracks.reference, angles[tracks.reference_frame])
    middle = (straight[:, 0] > 0.15) & (straight[:, 0] < 0.35)
    covariance = np.nanmean(tracks.covariance[middle], axis=(0, 1))
    # that half of the arm does not move: its axis is x, and across it the surface is held
    assert covariance[0, 0] > 4 * max(covariance[1, 1], covariance[2, 2])


def test_motion_paths_of_nodes(bending):
    _, tracks = bending
    paths = tracks.motion_paths()
    assert paths.count == 150
    assert np.isfinite(tracks.sigma).all()


def test_the_same_again_with_other_threads(bending):
    angles, tracks = bending
    with ThreadPoolExecutor(1) as executor:
        again = track_nodes(
            lambda t: bend(capsule(1500, seed=10 + t), angles[t]), len(angles), SMALL, executor=executor
        )
    np.testing.assert_array_equal(again.positions, tracks.positions)
    np.testing.assert_array_equal(again.rotations, tracks.rotations)


def test_the_same_in_another_unit_and_elsewhere(bending):
    angles, tracks = bending

    def points(frame: int) -> np.ndarray:
        return 1024.0 * bend(capsule(1500, seed=10 + frame), angles[frame])

    there = track_nodes(points, len(angles), SMALL)
    np.testing.assert_array_equal(there.positions, 1024.0 * tracks.positions)
    np.testing.assert_array_equal(there.covariance, 1024.0**2 * tracks.covariance)
    away = track_nodes(lambda t: points(t) + 1024.0 * 4096.0, len(angles), SMALL)
    moved = away.positions / 1024.0 - 4096.0 - tracks.positions
    assert np.abs(moved).max() < 1e-6


@pytest.mark.parametrize("still", [1, 2, 5])
def test_motion_in_a_single_frame_of_a_few_is_seen(still):
    shift = np.array([0.1, 0.05, 0.0])
    tracks = track_nodes(lambda t: capsule(1500) + (t == still) * shift, still + 1, SMALL)
    moved = tracks.positions[:, still] - tracks.positions[:, 0]
    np.testing.assert_allclose(np.nanmedian(moved, axis=0), shift, atol=0.01)


def test_coincident_points_are_one():
    points = capsule(300)
    once, often = (point_set(np.tile(points, (n, 1)), 2000, 9) for n in (1, 12))
    np.testing.assert_array_equal(often.positions, once.positions)
    with pytest.raises(GeometryError, match="frame 0: a surface of 8 distinct points"):
        track_nodes(lambda t: np.tile(points[:8], (20, 1)), 2, SMALL)


def test_no_frames():
    with pytest.raises(GeometryError, match="without frames"):
        track_nodes(lambda t: np.zeros((0, 3)), 0)


def test_each_face_of_a_box_is_turned_by_itself():
    # two faces of a long box with their normals inwards, the others outwards
    rng = np.random.default_rng(3)
    p = rng.uniform(-1, 1, (3000, 3)) * [0.5, 0.1, 0.1]
    axis = rng.integers(1, 3, 3000)
    side = rng.choice([-1.0, 1.0], 3000)
    p[np.arange(3000), axis] = 0.1 * side
    outward = np.zeros((3000, 3))
    outward[np.arange(3000), axis] = side
    given = np.where((side > 0)[:, None], -outward, outward)
    s = PointSet(p, given, np.zeros((3000, 0)), np.zeros((3000, 0, 3)))
    known = p[:300] + 0.02
    turned = s.turned_like(known, outward[:300], 0.08).normals
    assert ((turned * outward).sum(axis=1) > 0).mean() > 0.98


def four_legs(seed: int) -> np.ndarray:
    """Points of a table with thin legs, 4,000."""
    rng = np.random.default_rng(seed)
    top = ellipsoid_of([0.6, 0.3, 0.1], 3000, rng)
    leg = ellipsoid_of([0.04, 0.04, 0.3], 250, rng)
    return np.concatenate([top, *(leg + np.array([x, y, -0.35]) for x in (-0.4, 0.4) for y in (-0.1, 0.1))])


def ellipsoid_of(radii: list[float], count: int, rng: np.random.Generator) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    return radii * d / np.linalg.norm(d, axis=1, keepdims=True)


def test_a_limb_that_was_taken_for_another_is_found_again_from_where_it_jumps():
    settings = NodeTrackingSettings(nodes=300, coarse_nodes=150, points=2500, coarse_points=1500)
    sets = [point_set(four_legs(k), 2500, 9) for k in range(8)]
    model = NodeModel(sets[0], settings).coarse
    frames = [CoarseTarget(Target(s, np.zeros(0), settings.normal_weight), np.zeros((0, 3))) for s in sets]
    right = model.start()
    leg = (model.graph.nodes[:, 2] < -0.15) & (model.graph.nodes[:, 0] > 0.2) & (model.graph.nodes[:, 1] > 0)
    wrong = State(right.x - 0.2 * leg[:, None] * [0.0, 1.0, 0.0], right.R)
    states = [model.fit(f, wrong if 2 <= k < 6 else right, NEAR[-1:], False) for k, f in enumerate(frames)]
    assert all(np.abs(states[k].x[leg] - right.x[leg])[:, 1].mean() > 0.1 for k in range(2, 6))
    # so little of the surface is unexplained that the frames seem to fit
    assert states[3].cost < 1.3 * states[7].cost
    states = mend(model, frames, states, 0)
    for state in states:
        assert np.median(np.linalg.norm(state.x - right.x, axis=1)[leg]) < 0.5 * model.graph.spacing
