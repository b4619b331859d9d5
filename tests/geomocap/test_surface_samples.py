import numpy as np
import pytest
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.optimize import least_squares
from scipy.spatial.distance import squareform
from scipy.spatial.transform import Rotation

from geomocap.bodies.connected_linkage import connected_linkage
from geomocap.bodies.local_rotations import local_rotations, turn_distances
from geomocap.bodies.rigid_motions import _in_blocks, _step_equations, fit_rigid_motion
from geomocap.bodies.surface_graph import bridges, lasting_distances, surface_graph
from geomocap.bodies.surface_noise import correlation_sums
from geomocap.model.motion_paths import DEPTH_FRACTION, sure_part
from geomocap.model.rotations import nearest_rotation, rigid_motion, turn_angles
from tests.geomocap.moving_chains import loose_body


def test_lasting_distances_are_the_third_largest():
    positions = np.random.default_rng(0).random((7, 20, 3))
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=3)
    np.testing.assert_allclose(lasting_distances(positions), np.sort(apart, axis=2)[:, :, -3], rtol=1e-6)


def test_samples_that_touch_for_a_while_are_no_neighbours():
    line = np.stack([np.linspace(0, 1, 30), np.zeros(30), np.zeros(30)], axis=1)
    frames = 20
    fixed = np.tile(line[:, None], (1, frames, 1))
    other = fixed + np.array([0.0, 0.01, 0.0])
    other[:, 8:] += np.array([0.0, 0.5, 0.0])
    positions = np.concatenate([fixed, other])
    linked = surface_graph(positions, positions[:, 0], 4, 2.0).neighbours
    assert not linked[:30, 30:].any()
    assert linked[np.arange(29), np.arange(1, 30)].all()


def test_local_rotations_and_their_distances_are_the_reference_ones():
    rng = np.random.default_rng(3)
    positions, weights = rng.random((12, 5, 3)), rng.random((12, 5))
    geodesics = np.linalg.norm(positions[:, None, 0] - positions[None, :, 0], axis=2)
    radius = 0.6
    fitted = local_rotations(positions, positions[:, 0], weights, geodesics, radius)
    for i in (0, 7):
        near = geodesics[i] <= radius
        for t in (1, 4):
            w = np.exp(-((geodesics[i, near] / (0.6 * radius)) ** 2)) * weights[near, t]
            start, moved = positions[near, 0], positions[near, t]
            expected = Rotation.align_vectors(
                moved - np.average(moved, axis=0, weights=w), start - np.average(start, axis=0, weights=w), weights=w
            )[0].as_matrix()
            np.testing.assert_allclose(fitted[i, t], expected, atol=1e-5)
    angles = turn_angles(np.einsum("atij,btik->abtjk", fitted, fitted))
    np.testing.assert_allclose(turn_distances(fitted, fraction=0.3), np.sort(angles, axis=2)[:, :, -2], atol=2e-3)


def test_linkage_of_samples_that_are_all_neighbours_is_average_linkage():
    rng = np.random.default_rng(4)
    points = rng.random((40, 2))
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    tree = connected_linkage(distances, ~np.eye(40, dtype=bool))
    expected = linkage(squareform(distances, checks=False), "average")
    np.testing.assert_allclose(tree.heights, expected[:, 2])
    cut = tree.cut(0.3)
    reference = fcluster(expected, 0.3, "distance")
    assert len(np.unique(np.stack([cut, reference]), axis=1).T) == len(np.unique(cut)) == len(np.unique(reference))
    assert tree.cut_count(7).max() == 6


def test_linkage_never_joins_what_is_not_connected():
    linked = np.zeros((6, 6), bool)
    for a, b in ((0, 1), (1, 2), (3, 4), (4, 5)):
        linked[a, b] = linked[b, a] = True
    tree = connected_linkage(np.zeros((6, 6)), linked)
    np.testing.assert_array_equal(tree.cut(1.0), [0, 0, 0, 1, 1, 1])


def test_rigid_motion_is_steady_against_samples_that_do_not_follow():
    rng = np.random.default_rng(6)
    rest = rng.random((40, 3))
    true = Rotation.from_rotvec(rng.normal(scale=0.5, size=(6, 3))).as_matrix()
    positions = np.einsum("tij,nj->nti", true, rest) + 1.0
    positions[:8] += rng.normal(scale=0.3, size=(8, 6, 3))
    rotations, translations, residuals = fit_rigid_motion(positions, rest, np.ones((40, 6)), 1e-4)
    assert np.rad2deg(turn_angles(rotations.swapaxes(1, 2) @ true)).max() < 0.05
    assert np.abs(translations - 1.0).max() < 1e-3
    assert residuals[:8].min() > residuals[8:].max()


def test_nearest_turns_are_those_by_singular_values():
    rng = np.random.default_rng(16)
    matrices = rng.normal(size=(60, 3, 3))
    matrices[::3, :, 2] = 0.0  # flat
    matrices[1::3] *= 1e-8
    u, _, vt = np.linalg.svd(matrices)
    u[..., 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    np.testing.assert_allclose(nearest_rotation(matrices), u @ vt, atol=1e-11)
    np.testing.assert_array_equal(nearest_rotation(matrices[:, None])[:, 0], nearest_rotation(matrices))
    for M in (np.zeros((3, 3)), np.diag([0.0, 2.0, 0.0])):
        np.testing.assert_array_equal(nearest_rotation(M), np.eye(3))


def fitted_with_numpy(positions, rest, weights, least_scale, rounds=5, ray=None):
    """What `fit_rigid_motion` returns, written with whole arrays."""
    given, start = np.maximum(weights, 1e-9), 0 if ray is None else 3
    robust = given
    for k in range(start + rounds):
        if ray is None or k < start:
            R, t = rigid_motion(rest, positions.swapaxes(0, 1), robust.T, prior=1e-12 * np.eye(3))
        else:
            turned = np.einsum("tij,nj->nti", R, rest)
            middle = (robust[..., None] * turned).sum(axis=0) / robust.sum(axis=0)[:, None]
            x, y, z = np.moveaxis(turned - middle, 2, 0)
            o = np.zeros_like(x)
            arms = np.stack([np.stack(row, -1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))], -2)
            J = np.concatenate([-arms, np.broadcast_to(np.eye(3), arms.shape)], axis=-1)
            across = robust[..., None, None] * (
                np.eye(3) - (1 - DEPTH_FRACTION**2) * ray[..., :, None] * ray[..., None, :]
            )
            normal = np.einsum("ntki,ntkl,ntlj->tij", J, across, J)
            right = np.einsum("ntki,ntkl,ntl->ti", J, across, positions - turned - t)
            normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
            step = np.linalg.solve(normal, right[..., None])[..., 0]
            turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
            R, t = turn @ R, t + step[:, 3:] + middle - np.einsum("tij,tj->ti", turn, middle)
        miss = np.linalg.norm(sure_part(np.einsum("tij,nj->nti", R, rest) + t - positions, ray), axis=2)
        residuals = np.sqrt((given * miss**2).sum(axis=1) / given.sum(axis=1))
        scale = 2 * max(np.median(residuals), least_scale)
        robust = given / (1 + (residuals / scale) ** 4)[:, None] / (1 + (miss / (2 * scale)) ** 4)
    return R, t, residuals


@pytest.mark.parametrize("rays", [False, True])
def test_a_rigid_motion_is_that_of_whole_arrays(rays):
    positions, rest, weights, ray = loose_body(40, 12)
    ray = ray if rays else None
    found = fit_rigid_motion(positions, rest, weights, 1e-4, ray=ray)
    for one, other in zip(found, fitted_with_numpy(positions, rest, weights, 1e-4, ray=ray), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("count", [1, 2])
def test_a_motion_that_few_samples_leave_open_is_the_one_without_turn(count):
    rest = np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 0.4]])[:count]
    positions = np.repeat(rest[:, None], 3, axis=1) + np.arange(3.0)[:, None]
    rotations, translations, residuals = fit_rigid_motion(positions, rest, np.ones((count, 3)), 0.0)
    np.testing.assert_allclose(rotations, np.tile(np.eye(3), (3, 1, 1)), atol=1e-3)
    np.testing.assert_allclose(rest @ rotations.swapaxes(1, 2) + translations[:, None], positions.swapaxes(0, 1))
    assert residuals.max() < 1e-12


def seen_by_single_cameras(noise_along: float) -> tuple[np.ndarray, ...]:
    """A turning body whose samples three cameras see, each one alone: true motion, positions, rays."""
    rng = np.random.default_rng(8)
    rest = rng.normal(scale=0.1, size=(60, 3))
    true = Rotation.from_rotvec(rng.normal(scale=0.4, size=(6, 3))).as_matrix()
    positions = np.einsum("tij,nj->nti", true, rest) + 0.5
    ray = np.repeat(np.eye(3)[np.arange(60) % 3][:, None], 6, axis=1)
    off = rng.normal(scale=noise_along, size=(60, 6, 1)) * ray + rng.normal(scale=1e-3, size=(60, 6, 3))
    return rest, true, positions + off, ray


def test_what_is_unsure_along_the_ray_does_not_turn_a_body():
    rest, true, positions, ray = seen_by_single_cameras(0.02)
    weights = np.ones((60, 6))
    errors = []
    for known in (None, ray):
        rotations = fit_rigid_motion(positions, rest, weights, 1e-4, ray=known)[0]
        errors.append(np.rad2deg(turn_angles(rotations.swapaxes(1, 2) @ true)).mean())
    assert errors[1] < 0.35 * errors[0]


def test_a_motion_with_rays_is_the_least_squares_one():
    rest, _, positions, ray = seen_by_single_cameras(0.02)
    weights = np.random.default_rng(9).random((60, 6)) + 0.5
    least = 1e3  # residuals of this scale are all the same: no robust weights
    rotations, translations, _ = fit_rigid_motion(positions, rest, weights, least, ray=ray)

    def misses(motion: np.ndarray) -> np.ndarray:
        carried = Rotation.from_rotvec(motion[:3]).apply(rest) + motion[3:]
        return (np.sqrt(weights[:, 2, None]) * sure_part(carried - positions[:, 2], ray[:, 2])).ravel()

    found = np.concatenate([Rotation.from_matrix(rotations[2]).as_rotvec(), translations[2]])
    np.testing.assert_allclose(found, least_squares(misses, np.zeros(6), xtol=1e-12).x, atol=1e-6)


def test_equations_of_a_motion_with_rays_are_those_of_their_jacobian():
    rng = np.random.default_rng(12)
    n, T = 7, 19  # frames of two blocks
    rotations = Rotation.from_rotvec(rng.normal(size=(T, 3))).as_matrix()
    translations, positions = rng.normal(size=(T, 3)), rng.normal(size=(n, T, 3))
    rest, weights, ray = rng.normal(size=(n, 3)), rng.random((n, T)), rng.normal(size=(n, T, 3))
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    known, weight, motion = _in_blocks(positions, weights, ray)
    motion = np.zeros((12, 16 * len(motion)))
    motion[:, :T] = np.concatenate([rotations.reshape(T, 9), translations], axis=1).T
    found = [
        _step_equations(known[b], rest, weight[b], np.ascontiguousarray(motion[:, 16 * b : 16 * b + 16]))
        for b in range(len(known))
    ]
    sums = np.concatenate(found, axis=1)[:, :T].T
    normal, right, middle = np.zeros((T, 6, 6)), sums[:, :6].copy(), sums[:, 27:30]
    rows, columns = np.tril_indices(6)
    normal[:, rows, columns] = normal[:, columns, rows] = sums[:, 6:27]
    for t in range(T):
        turned = rest @ rotations[t].T
        expected = np.average(turned, axis=0, weights=weights[:, t])
        np.testing.assert_allclose(middle[t], expected, rtol=1e-12)
        for k in range(n):
            # a turn by w moves an arm a by w x a = -[a]x w
            x, y, z = turned[k] - expected
            J = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
            across = np.eye(3) - (1 - DEPTH_FRACTION**2) * np.outer(ray[k, t], ray[k, t])
            normal[t] -= weights[k, t] * J.T @ across @ J
            right[t] -= weights[k, t] * J.T @ across @ (positions[k, t] - turned[k] - translations[t])
    np.testing.assert_allclose(normal, 0, atol=1e-12)
    np.testing.assert_allclose(right, 0, atol=1e-12)


def test_correlations_are_sums_over_pairs_by_distance():
    rng = np.random.default_rng(19)
    misses, places = rng.normal(size=(30, 7)), rng.normal(size=(30, 3))
    length = np.linalg.norm(misses, axis=1)
    total, number = np.zeros(8), np.zeros(8, np.int64)
    correlation_sums(misses @ misses.T, length, places, 0.4, total, number)
    pairs = np.triu_indices(30, 1)
    bins = np.minimum((np.linalg.norm(places[:, None] - places, axis=2)[pairs] / 0.4).astype(int), 7)
    cosines = (misses @ misses.T / np.outer(length, length))[pairs]
    np.testing.assert_array_equal(number, np.bincount(bins, minlength=8))
    np.testing.assert_array_equal(total, np.bincount(bins, cosines, 8))


def test_bridges_are_the_relative_neighbours():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(40, 3))
    apart = np.linalg.norm(points[:, None] - points, axis=2).astype(np.float32)
    np.fill_diagonal(apart, 9.0)
    limit = np.full(40, 1.2)
    expected = np.zeros((40, 40), bool)
    for i, j in np.argwhere(apart <= 1.2):
        expected[i, j] = not (np.maximum(apart[i], apart[j]) < apart[i, j]).any()
    assert 30 < expected.sum() < 200
    np.testing.assert_array_equal(bridges(apart, limit), expected)


def test_a_gap_in_the_surface_is_bridged():
    rng = np.random.default_rng(5)
    dense = rng.uniform([0.0, 0.0, 0.0], [1.0, 1.0, 0.01], (600, 3))
    dense = dense[np.abs(dense[:, 0] - 0.5) > 0.05]
    positions = np.repeat(dense[:, None], 4, axis=1)
    graph = surface_graph(positions, positions[:, 0], 8, 2.0)
    left = dense[:, 0] < 0.5
    assert np.isfinite(graph.geodesics(10.0)[np.ix_(left, ~left)]).all()
