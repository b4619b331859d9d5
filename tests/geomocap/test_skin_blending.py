"""Samples that follow one body or a blend of two, against least squares and searches."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from geomocap.bodies.skin_blending import blend_spans, explain, places_at_rest
from geomocap.model.motion_paths import DEPTH_FRACTION, sure_part
from tests.geomocap.moving_chains import loose_body


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
        across = np.eye(3) - (1 - DEPTH_FRACTION**2) * direction[:, :, None] * direction[:, None, :]
        normal = np.einsum("t,tki,tkl,tlj->ij", w, R, across, R)
        expected = np.linalg.solve(normal, np.einsum("t,tki,tkl,tl->i", w, R, across, positions[i] - t))
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
