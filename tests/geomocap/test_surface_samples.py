import numpy as np
import pytest
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.optimize import least_squares
from scipy.spatial.distance import squareform
from scipy.spatial.transform import Rotation

from geomocap.bodies.connected_linkage import connected_linkage
from geomocap.bodies.local_rotations import local_rotations, turn_distances
from geomocap.bodies.rigid_motions import _in_blocks, _step_equations, fit_rigid_motion
from geomocap.bodies.skin_blending import blend_spans, explain, places_at_rest
from geomocap.bodies.surface_graph import bridges, lasting_distances, surface_graph
from geomocap.bodies.surface_noise import correlation_sums
from geomocap.model.motion_paths import DEPTH_FRACTION, sure_part, within_ray
from geomocap.model.rotations import nearest_rotation, rigid_motion, turn_angles


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


def loose_body(count: int, frames: int) -> tuple[np.ndarray, ...]:
    """A moving body of which some samples go astray, some are not seen, and most have rays."""
    rng = np.random.default_rng(13)
    rest = rng.normal(scale=0.1, size=(count, 3)) + 1.0
    true = Rotation.from_rotvec(rng.normal(scale=0.5, size=(frames, 3))).as_matrix()
    positions = np.einsum("tij,nj->nti", true, rest) + rng.normal(scale=2e-3, size=(count, frames, 3))
    positions[: count // 6] += rng.normal(scale=0.05, size=(count // 6, frames, 3))
    weights = rng.random((count, frames)) * (rng.random((count, frames)) > 0.1)
    ray = rng.normal(size=(count, frames, 3)) * (rng.random((count, frames, 1)) > 0.3)
    return positions, rest, weights, ray / np.maximum(np.linalg.norm(ray, axis=2, keepdims=True), 1e-12)


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


@pytest.mark.parametrize("rays", [False, True])
def test_places_at_rest_are_the_least_squares_ones(rays):
    positions, _, weights, ray = loose_body(12, 8)
    weights[3] = 0.0
    rng = np.random.default_rng(14)
    rotations = Rotation.from_rotvec(rng.normal(size=(16, 3))).as_matrix().reshape(2, 8, 3, 3)
    translations, label, samples = rng.normal(size=(2, 8, 3)), np.arange(12) % 2, np.array([1, 3, 4, 9])
    ray = ray if rays else None
    found = places_at_rest(samples, label, positions, weights, ray, rotations, translations)
    for place, i in zip(found, samples, strict=True):
        R, t, w = rotations[label[i]], translations[label[i]], weights[i]
        if not w.any():
            np.testing.assert_array_equal(place, 0.0)
            continue
        direction = np.zeros((8, 3)) if ray is None else ray[i]
        seen = within_ray(positions[i], t, direction)
        across = np.eye(3) - (1 - DEPTH_FRACTION**2) * direction[:, :, None] * direction[:, None, :]
        normal = np.einsum("t,tki,tkl,tlj->ij", w, R, across, R)
        expected = np.linalg.solve(normal, np.einsum("t,tki,tk->i", w, R, seen - t))
        np.testing.assert_allclose(place, expected, rtol=1e-9)


def test_spans_of_blends_are_variances_of_what_is_between_the_bodies():
    rng = np.random.default_rng(15)
    rotations = Rotation.from_rotvec(rng.normal(size=(18, 3))).as_matrix().reshape(3, 6, 3, 3)
    translations, rest, weights = rng.normal(size=(3, 6, 3)), rng.normal(size=(4, 3)), rng.random((4, 6))
    main, partner = np.array([0, 1, 2, 1]), np.array([1, -1, 0, 2])
    carried = np.einsum("btij,nj->bnti", rotations, rest) + translations[:, None]
    found = blend_spans(main, partner, weights, rest, rotations, translations)
    for n in range(4):
        apart = carried[main[n], n] - carried[partner[n], n]
        middle = np.average(apart, axis=0, weights=weights[n])
        expected = np.average(((apart - middle) ** 2).sum(axis=1), weights=weights[n]) if partner[n] >= 0 else 0.0
        np.testing.assert_allclose(found[n], expected, rtol=1e-9)


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


def test_blends_with_rays_are_those_of_a_search():
    rng = np.random.default_rng(10)
    rotations = Rotation.from_rotvec(rng.normal(scale=0.4, size=(10, 3))).as_matrix().reshape(2, 5, 3, 3)
    translations = rng.normal(scale=0.1, size=(2, 5, 3))
    rest, weights = rng.random((3, 3)), rng.random((3, 5)) + 0.2
    carried = np.einsum("btij,nj->nbti", rotations, rest) + translations[None]
    ray = rng.normal(size=(3, 5, 3))
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    positions = 0.7 * carried[:, 0] + 0.3 * carried[:, 1] + rng.normal(scale=0.02, size=(3, 5, 1)) * ray
    everything = np.ones((3, 2), bool), np.ones((2, 2), bool)
    of = (positions, weights, ray, rest)
    blends = explain(np.arange(3), *of, np.ones(3, bool), rotations, translations, *everything, 0.01, 10.0)
    for i in range(3):
        fractions = np.linspace(0.5, 1.0, 2001)[:, None, None]
        miss = sure_part(fractions * carried[i, 0] + (1 - fractions) * carried[i, 1] - positions[i], ray[i])
        w = fractions[:, 0, 0]
        costs = np.average((miss**2).sum(axis=2), weights=weights[i], axis=1) + 4 * w * (1 - w) * 1e-4
        assert blends.costs[i, 0] == pytest.approx(costs.min(), rel=1e-3)
        assert blends.fraction[i, 0] == pytest.approx(w[costs.argmin()], abs=2e-3)
    # a sample whose place at rest is open gets the one that fits best
    alone = explain(
        np.arange(3),
        *of,
        np.zeros(3, bool),
        rotations,
        translations,
        *everything[:1],
        np.zeros((2, 2), bool),
        0.0,
        10.0,
    )

    def misses(place: np.ndarray) -> np.ndarray:
        there = rotations[1] @ place + translations[1]
        return (np.sqrt(weights[0] / weights[0].sum())[:, None] * sure_part(there - positions[0], ray[0])).ravel()

    assert alone.costs[0, 1] == pytest.approx(2.0 * least_squares(misses, rest[0], xtol=1e-12).cost, rel=1e-6)


def test_blends_are_those_of_a_search_over_weights():
    rng = np.random.default_rng(7)
    rotations = Rotation.from_rotvec(rng.normal(scale=0.4, size=(15, 3))).as_matrix().reshape(3, 5, 3, 3)
    translations = rng.normal(scale=0.1, size=(3, 5, 3))
    rest = rng.random((4, 3))
    carried = np.einsum("btij,nj->nbti", rotations, rest) + translations[None]
    weights = rng.random((4, 5)) + 0.2
    mix = np.array([[0.7, 0.3, 0.0], [0.0, 0.2, 0.8], [1.0, 0.0, 0.0], [0.45, 0.0, 0.55]])
    positions = np.einsum("nb,nbti->nti", mix, carried) + rng.normal(scale=0.003, size=(4, 5, 3))
    penalty = 0.02
    everything = np.ones((4, 3), bool), np.ones((3, 3), bool)
    blends = explain(
        np.arange(4),
        positions,
        weights,
        None,
        rest,
        np.ones(4, bool),
        rotations,
        translations,
        *everything,
        penalty,
        10.0,
    )
    for i in range(4):
        best = {}
        for a in range(3):
            for b in range(3):
                if a == b:
                    continue
                for w in np.linspace(0.5, 1.0, 2001):
                    miss = ((w * carried[i, a] + (1 - w) * carried[i, b] - positions[i]) ** 2).sum(axis=1)
                    cost = np.average(miss, weights=weights[i]) + 4 * w * (1 - w) * penalty**2
                    best[a] = min(best.get(a, (np.inf, 0.0)), (cost, w))
        main = int(np.argmin(blends.costs[i]))
        assert main == min(best, key=lambda a: best[a])
        assert blends.costs[i, main] == pytest.approx(best[main][0], rel=1e-3, abs=1e-9)
        assert blends.fraction[i, main] == pytest.approx(best[main][1], abs=2e-3)


@pytest.mark.parametrize("rays", [False, True])
def test_samples_are_explained_as_with_whole_arrays(rays):
    positions, rest, weights, ray = loose_body(40, 45)
    ray, rng = ray if rays else np.zeros_like(positions), np.random.default_rng(18)
    rotations = Rotation.from_rotvec(rng.normal(scale=0.1, size=(180, 3))).as_matrix().reshape(4, 45, 3, 3)
    translations, certain = rng.normal(scale=0.02, size=(4, 45, 3)), rng.random(40) < 0.5
    positions = np.einsum("nb,bnti->nti", rng.dirichlet(np.ones(4), 40), _carried(rotations, translations, rest))
    samples = rng.permutation(40)[:37]
    allowed, adjacent = rng.random((37, 4)) < 0.8, rng.random((4, 4)) < 0.6
    penalty, cap = 0.005, 0.05
    given = positions, weights, ray if rays else None, rest, certain, rotations, translations
    found = explain(samples, *given, allowed, adjacent, penalty, cap)
    for row, n in enumerate(samples):
        known = positions, weights, ray if rays else None, rotations, translations
        places = np.tile(rest[n], (4, 1))
        if not certain[n]:
            places = np.concatenate([places_at_rest(np.array([n]), np.full(40, b), *known) for b in range(4)])
        carried = np.einsum("btij,bj->bti", rotations, places) + translations
        miss, share = sure_part(positions[n] - carried, ray[n]), weights[n] / weights[n].sum()

        def cost(missed, share=share):
            return share @ np.minimum((missed**2).sum(axis=1), cap**2)

        for a in range(4):
            best, partner, fraction = (cost(miss[a]), -1, 1.0) if allowed[row, a] else (np.inf, -1, 1.0)
            for b in np.flatnonzero(adjacent[a] & allowed[row] & allowed[row, a] & (np.arange(4) != a)):
                apart = miss[b] - miss[a]
                curve = share @ (apart**2).sum(axis=1) - 4 * penalty**2
                w = (share @ (miss[b] * apart).sum(axis=1) - 2 * penalty**2) / curve
                if curve <= 0 or not 0.5 <= w < 1:
                    continue
                blended = cost(w * miss[a] + (1 - w) * miss[b]) + 4 * w * (1 - w) * penalty**2
                if blended < best:
                    best, partner, fraction = blended, b, w
            np.testing.assert_allclose(found.costs[row, a], best, rtol=1e-8)
            assert found.partner[row, a] == partner
            np.testing.assert_allclose(found.fraction[row, a], fraction, rtol=1e-8)


def _carried(rotations: np.ndarray, translations: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Places (n, 3) carried by bodies, (B, n, T, 3)."""
    return np.einsum("btij,nj->bnti", rotations, rest) + translations[:, None]


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
