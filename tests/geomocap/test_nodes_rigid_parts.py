"""Rigid parts: what points know of their motion, how parts are registered, and a hinge of two hard boxes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.nodes.correspondences import Target
from geomocap.nodes.node_graph import NodeGraph
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_tracking import track_nodes
from geomocap.nodes.part_grouping import MotionForms, group_nodes, motion_of, twist_of
from geomocap.nodes.part_motion import carry_samples, part_equations, part_motions
from geomocap.nodes.rigid_parts import PartTracker
from geomocap.nodes.surface_points import PointSet

FRAMES = 9
SMALL = NodeTrackingSettings(nodes=180, coarse_nodes=60, points=1500, coarse_points=800)


def test_twists_there_and_back():
    rng = np.random.default_rng(0)
    w = rng.normal(size=(40, 3)) * np.array([1e-5, 1e-2, 0.5, 1.0])[np.arange(40) % 4, None]
    R, t = Rotation.from_rotvec(w).as_matrix(), rng.normal(size=(40, 3))
    to_R, to_t = Rotation.from_rotvec(rng.normal(size=(40, 3)) * 0.1).as_matrix() @ R, rng.normal(size=(40, 3))
    turn, shift = motion_of(twist_of(R, t, to_R, to_t))
    np.testing.assert_allclose(turn @ R, to_R, atol=1e-9)
    np.testing.assert_allclose((turn @ t[..., None])[..., 0] + shift, to_t, atol=1e-9)


def test_twist_of_a_turn_about_an_axis_elsewhere_is_that_turn():
    w, on_axis = np.array([0.0, 0.0, 1.2]), np.array([3.0, 1.0, 0.0])
    R = Rotation.from_rotvec(w).as_matrix()
    twist = twist_of(np.eye(3), np.zeros(3), R, on_axis - R @ on_axis)
    np.testing.assert_allclose(twist, np.concatenate([w, -np.cross(w, on_axis)]), atol=1e-12)


def forms_of(normals: np.ndarray, places: np.ndarray, R: np.ndarray, t: np.ndarray, body: np.ndarray) -> MotionForms:
    """Forms of N nodes that see points at places (N, S, 3) with normals (N, S, 3), moved by their bodies exactly."""
    N, T = len(places), R.shape[1]
    y = np.einsum("ntij,nsj->ntsi", R[body], places) + t[body][:, :, None]
    n = np.einsum("ntij,nsj->ntsi", R[body], normals)
    J = np.concatenate([np.cross(y, n), n], axis=-1)
    form = np.einsum("ntsi,ntsj->ntij", J, J) + 1e-6 * np.eye(6)
    zero = np.zeros((N, T))
    return MotionForms(R[body], t[body], form, np.zeros((N, T, 6)), zero, zero + places.shape[1])


def turning(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Motions of two bodies (2, T, 3, 3), (2, T, 3): the second turns about z up to an angle."""
    angles = np.outer([0.0, angle], np.linspace(-1, 1, FRAMES))
    R = Rotation.from_rotvec(angles[..., None].reshape(-1, 1) * [0.0, 0.0, 1.0]).as_matrix().reshape(2, FRAMES, 3, 3)
    return R, np.zeros((2, FRAMES, 3))


def test_nodes_are_grouped_by_their_motion():
    rng = np.random.default_rng(1)
    body = np.repeat([0, 1], 6)
    normals = rng.normal(size=(12, 8, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    places = rng.uniform(-1, 1, (12, 8, 3)) + 0.2
    chain = np.column_stack([np.arange(11), np.arange(1, 12)])
    label = group_nodes(forms_of(normals, places, *turning(0.3), body), chain, 0.02, 1)
    np.testing.assert_array_equal(label, body)
    # all one, if so much misfit is borne, or if groups of six are too small
    assert group_nodes(forms_of(normals, places, *turning(0.3), body), chain, 2.0, 1).max() == 0
    assert group_nodes(forms_of(normals, places, *turning(0.3), body), chain, 0.02, 7).max() == 0


def test_what_slides_unseen_is_no_evidence():
    rng = np.random.default_rng(2)
    around = rng.uniform(0, 2 * np.pi, (6, 8))
    normals = np.stack([np.cos(around), np.sin(around), 0 * around], axis=-1)
    places = normals + np.array([0.0, 0.0, 1.0]) * rng.uniform(-1, 1, (6, 8, 1))
    body = np.repeat([0, 1], 3)  # halves of a shaft about z that seem to turn about z differently
    chain = np.column_stack([np.arange(5), np.arange(1, 6)])
    assert group_nodes(forms_of(normals, places, *turning(0.8), body), chain, 0.01, 1).max() == 0


def test_part_equations_are_those_of_the_energy():
    rng = np.random.default_rng(3)
    B, N, S, E = 3, 12, 25, 5
    R = Rotation.from_rotvec(rng.normal(size=(B, 3))).as_matrix()
    t, middle, nodes, samples = (rng.normal(size=(k, 3)) for k in (B, B, N, S))
    label = np.arange(N) % B
    binding = rng.integers(0, N, (S, 4))
    weights = rng.random((S, 4))
    weights /= weights.sum(axis=1, keepdims=True)
    root = rng.normal(size=(S, 3, 3))
    A, goal = root @ root.swapaxes(1, 2), rng.normal(size=(S, 3))
    first = rng.integers(0, N, E)
    hinges, hold = np.column_stack([first, (first + 1) % N]), rng.random(E)

    def residuals(z):
        turn = Rotation.from_rotvec(z.reshape(B, 6)[:, :3]).as_matrix()
        now_R = turn @ R
        now_t = (turn @ (t - middle)[..., None])[..., 0] + middle + z.reshape(B, 6)[:, 3:]
        places = now_R[label[binding]] @ samples[:, None, :, None]
        y = (weights[..., None] * (places[..., 0] + now_t[label[binding]])).sum(axis=1)
        apart = []
        for (i, j), h in zip(hinges, hold, strict=True):
            a, b = label[i], label[j]
            for p in nodes[[i, j]]:
                apart.append(np.sqrt(h) * (now_R[a] @ p + now_t[a] - now_R[b] @ p - now_t[b]))
        seen = np.einsum("sji,sj->si", np.linalg.cholesky(A), y - goal)
        return np.concatenate([seen.ravel(), np.ravel(apart)]), y

    zero, d = np.zeros(6 * B), 1e-6
    r, y = residuals(zero)
    J = np.stack([(residuals(zero + d * e)[0] - residuals(zero - d * e)[0]) / (2 * d) for e in np.eye(6 * B)], axis=1)
    b = np.einsum("sij,sj->si", A, y - goal)
    H, g = part_equations(R, t, middle, label, samples, binding, weights, A, b, nodes, hinges, hold)
    np.testing.assert_allclose(H, J.T @ J, atol=1e-6)
    np.testing.assert_allclose(g, -J.T @ r, atol=1e-6)


def test_samples_are_carried_by_the_parts_of_their_nodes():
    rng = np.random.default_rng(5)
    B, N, S = 3, 12, 25
    R, t = Rotation.from_rotvec(rng.normal(size=(B, 3))).as_matrix(), rng.normal(size=(B, 3))
    label, binding, weights = np.arange(N) % B, rng.integers(0, N, (S, 4)), rng.random((S, 4))
    weights /= weights.sum(axis=1, keepdims=True)
    samples, normals = rng.normal(size=(2, S, 3))
    y, n = carry_samples(R, t, label, samples, normals, binding, weights)
    own = label[binding]
    np.testing.assert_allclose(
        y, np.einsum("sk,skij,sj->si", weights, R[own], samples) + np.einsum("sk,ski->si", weights, t[own])
    )
    turned = np.einsum("sk,skij,sj->si", weights, R[own], normals)
    np.testing.assert_allclose(n, turned / np.linalg.norm(turned, axis=1, keepdims=True))


def test_what_slides_in_its_plane_misses_nothing_and_what_leaves_it_does():
    rng = np.random.default_rng(6)
    u = np.linspace(-1, 1, 15)
    nodes = np.stack([*np.meshgrid(u, u), np.zeros((15, 15))], axis=-1).reshape(-1, 3)
    up, none, N = np.tile([0.0, 0.0, 1.0], (len(nodes), 1)), np.zeros((len(nodes), 0)), len(nodes)
    edges = np.array(sorted(cKDTree(nodes).query_pairs(0.15)))
    own, ones = np.arange(N)[:, None], np.ones((N, 1))
    graph = NodeGraph(nodes, 1 / 7, edges, np.full(len(edges), 1 / 7), nodes, up, none, own, ones)
    seen = np.column_stack([rng.uniform(-1.5, 1.5, (9000, 2)), np.zeros(9000)])
    points = PointSet(seen, np.tile([0.0, 0.0, 1.0], (9000, 1)), np.zeros((9000, 0)), np.zeros((9000, 0, 3)))
    tracker = PartTracker(graph, [Target(points, np.zeros(0))], 0.03, SMALL)

    def missed(shift):
        part, still = np.zeros(N, int), np.eye(3)[None]
        return tracker.misses(0, still, np.array([shift], float), np.arange(N), part)

    assert missed((0, 0, 0)).max() < 1e-3  # points are random: a few gaps are wider than usual
    assert missed((0.3, 0.2, 0)).max() < 1e-3
    assert (missed((0, 0, 0.04)) > 0.5).all()
    assert missed((4, 0, 0)).min() == 1.0


def test_motions_of_parts():
    rng = np.random.default_rng(4)
    R, t = turning(0.7)
    t = t + rng.normal(size=t.shape)
    label, nodes = np.repeat([0, 1], [9, 1]), rng.normal(size=(10, 3))  # a single node knows its turn by its rotation
    x = np.einsum("ntij,nj->nti", R[label], nodes) + t[label]
    parts = part_motions(label, nodes, x, R[label], 0.1)
    np.testing.assert_allclose(parts.R, R, atol=1e-9)
    np.testing.assert_allclose(parts.carry(nodes)[0], x, atol=1e-9)


def boxes(frame: int, count: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Points sampled afresh on two square bars on a hinge at the origin, and the bar of each."""
    rng = np.random.default_rng(frame)
    bar = rng.integers(0, 2, count)
    p = rng.uniform(-1, 1, (count, 3)) * [0.5, 0.09, 0.09]
    side = np.where(rng.random(count) < 0.1, 0, rng.integers(1, 3, count))
    p[np.arange(count), side] = np.where(rng.random(count) < 0.5, -1, 1) * np.array([0.5, 0.09, 0.09])[side]
    p[:, 0] += np.where(bar == 0, -0.51, 0.51)
    return np.where((bar == 1)[:, None], p @ hinge(frame).T, p), bar


def hinge(frame: int) -> np.ndarray:
    return Rotation.from_rotvec([0.0, 0.0, 0.12 * (frame - FRAMES // 2)]).as_matrix()


@pytest.fixture(scope="module")
def hinged():
    return track_nodes(lambda k: boxes(k)[0], FRAMES, SMALL)


def errors(found) -> tuple[np.ndarray, np.ndarray]:
    """Distance of nodes from where their bar carries them and angle by which they turn otherwise, (N, T) both."""
    r = found.reference_frame
    away = np.abs(found.reference[:, 0]) > 0.15
    second = (found.reference[:, 0] > 0) & away
    R = np.stack([hinge(k) @ hinge(r).T for k in range(FRAMES)])
    true = np.where(second[:, None, None, None], R, np.eye(3))
    distance = np.linalg.norm(found.positions - (true @ found.reference[:, None, :, None])[..., 0], axis=2)
    cosine = (np.trace(true.swapaxes(-1, -2) @ found.rotations, axis1=2, axis2=3) - 1) / 2
    return distance[away], np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))[away]


def test_bars_on_a_hinge_move_rigidly(hinged):
    soft = track_nodes(lambda k: boxes(k)[0], FRAMES, SMALL.model_copy(update={"part_rounds": 0}))
    (distance, angle), (of_skin, angle_of_skin) = errors(hinged), errors(soft)
    assert np.nanpercentile(distance, 95) < min(0.01, np.nanpercentile(of_skin, 95))
    assert np.percentile(angle, 95) < min(2.0, 0.75 * np.percentile(angle_of_skin, 95))
    assert len(np.unique(hinged.rotations[:, 0].round(9), axis=0)) <= 4  # two bars and little beside the hinge


def test_standard_deviations_of_nodes_cover_their_errors(hinged):
    assert np.isfinite(hinged.covariance).all()
    away = np.abs(hinged.reference[:, 0]) > 0.15
    assert np.mean(errors(hinged)[0] < 3 * np.sqrt(3) * hinged.sigma[away]) > 0.9


def post(frame: int, count: int = 2000) -> np.ndarray:
    """Points sampled afresh on a round post that stands still, and on a bar that turns upon it about the same axis."""
    rng = np.random.default_rng(frame)
    a, part = rng.uniform(0, 2 * np.pi, count), rng.random(count)
    radius = np.where(part < 0.5, 0.3, 0.3 * np.sqrt(rng.random(count)))
    p = np.stack([radius * np.cos(a), radius * np.sin(a), np.where(part < 0.5, rng.uniform(-0.5, 0, count), 0)], axis=1)
    p[part > 0.6, 2] = -0.5
    bar = part > 0.7
    on_bar = boxes(FRAMES // 2, count)[0] * [0.6, 1, 1] + [0.25, 0, 0.1]
    p[bar] = (on_bar @ hinge(frame).T)[bar]
    return p


def test_what_may_rest_does():
    found = track_nodes(post, FRAMES, SMALL)
    post_nodes, unmoved = found.reference[:, 2] < -0.1, np.broadcast_to(np.eye(3), found.rotations.shape)
    assert (found.rotations == unmoved).all(axis=(1, 2, 3))[post_nodes].mean() > 0.9  # else it turns with the bar
    r, arm = found.reference_frame, found.reference[:, 2] > 0.12
    turn = np.stack([hinge(k) @ hinge(r).T for k in range(FRAMES)])
    missed = np.linalg.norm(found.positions - (turn @ found.reference[:, None, :, None])[..., 0], axis=2)
    assert np.nanpercentile(missed[arm], 90) < 0.03
