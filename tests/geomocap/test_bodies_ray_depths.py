"""Depths of what single cameras see, from the motions of the bodies."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from geomocap.bodies import ray_depths as ray_depths
from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.motion_bodies import MotionBodies, find_motion_bodies
from geomocap.bodies.ray_depths import find_bodies_and_depths, place_samples, settle_depths
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.outlines import Outlines
from geomocap.model.small_systems import solve_symmetric
from tests.geomocap.moving_chains import chain, same_partition, seen_by_single_cameras

DEPTH_FRACTION = 0.05
NOTHING = np.zeros((1, 1, 1, 1), np.uint8)


def test_small_systems_are_solved_as_numpy_does():
    rng = np.random.default_rng(3)
    for _ in range(50):
        rays = rng.normal(size=(4, 3))
        N, b = rays.T @ rays + 0.01 * np.eye(3), rng.normal(size=3)
        expected = np.linalg.solve(N, b)
        solve_symmetric(N, b, b)  # in place
        assert_allclose(b, expected, rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def three():
    return chain(3)


@pytest.fixture(scope="module")
def alone(three):
    """The chain as single cameras see it, its hull 30 mm off by turns; and a part of it 100 mm before the surface."""
    positions, ray = seen_by_single_cameras(three, 0.03)
    ghost = (three.body == 1) & (ray[:, 0, 1] > 0)
    positions[ghost] -= 0.1 * ray[ghost]
    positions[4, 7:11] = np.nan
    ray[4, 7:11] = 0.0
    return MotionPaths(positions, sigma=np.full(len(positions), 0.02), ray=ray)


@pytest.fixture(scope="module")
def bodies(alone):
    """Rough bodies: depths 30 mm off hide one of them, so their number is given."""
    return find_motion_bodies(alone, MotionBodiesSettings(bodies=3))


def test_kernel_is_exact_against_numpy(three, alone):
    rng = np.random.default_rng(1)
    seen = alone.seen & (rng.random(alone.seen.shape) < 0.9)
    positions = np.nan_to_num(alone.positions)
    fraction = rng.random((len(positions), 3))
    fraction /= fraction.sum(axis=1, keepdims=True)
    turns = np.einsum("nb,tbij->ntij", fraction, three.rotations)
    shifts = np.einsum("nb,tbi->nti", fraction, three.translations)
    ray = np.where((rng.random(len(positions)) < 0.8)[:, None, None], alone.ray, 0.0)
    for rotations, translations in ((turns, shifts), (turns[:1], shifts[:1])):
        rest, miss, depth = place_samples(positions, seen, ray, rotations, translations, DEPTH_FRACTION, 0.05)
        sure = np.eye(3) - (1 - DEPTH_FRACTION**2) * ray[..., :, None] * ray[..., None, :]
        carry = np.broadcast_to(rotations, turns.shape)
        away = positions - translations
        normal = np.einsum("nt,ntji,ntjk,ntkl->nil", seen, carry, sure, carry) + 1e-9 * np.eye(3)
        expected = np.linalg.solve(normal, np.einsum("nt,ntji,ntjk,ntk->ni", seen, carry, sure, away)[..., None])[
            ..., 0
        ]
        assert_allclose(rest, expected, rtol=1e-9, atol=1e-12)
        left = np.einsum("ntij,nj->nti", carry, expected) - away
        along = (left * ray).sum(axis=2)
        across = np.minimum(((left - along[..., None] * ray) ** 2).sum(axis=2), 0.05**2)
        assert_allclose(depth, np.where(seen, along, 0.0), atol=1e-10)
        assert_allclose(miss, np.sqrt((across * seen).sum(axis=1) / seen.sum(axis=1)), atol=1e-10)


def test_depths_are_those_with_which_bodies_are_rigid(three, alone, bodies):
    settled = settle_depths(alone, bodies)
    seen = alone.seen
    before, after = (np.linalg.norm(p.positions - three.positions, axis=2)[seen] for p in (alone, settled))
    assert np.median(before) > 0.02 and np.quantile(before, 0.95) > 0.08
    assert np.median(after) < 0.25 * np.median(before)
    assert np.quantile(after, 0.95) < 0.5 * np.quantile(before, 0.95)


def test_positions_move_along_their_rays_only(alone, bodies):
    settled = settle_depths(alone, bodies)
    moved = (settled.positions - alone.positions)[alone.seen]
    ray = alone.ray[alone.seen]
    assert_allclose(moved, (moved * ray).sum(axis=1, keepdims=True) * ray, atol=1e-12)
    assert_array_equal(settled.seen, alone.seen)
    assert settled.ray is alone.ray


def test_what_several_cameras_see_stays(three, bodies, alone):
    positions, ray = seen_by_single_cameras(three, 0.03)
    ray[::2] = 0.0
    positions[::2] = three.positions[::2]
    settled = settle_depths(MotionPaths(positions, ray=ray), bodies)
    assert_array_equal(settled.positions[::2], positions[::2])
    known = MotionPaths(three.positions)
    assert settle_depths(known, bodies) is known


def test_a_piece_before_the_surface_comes_to_the_body_behind_it(three, alone, bodies):
    piece = (three.body == 1) & (alone.ray[:, 0, 1] > 0)
    torn = MotionBodies(**{**bodies.__dict__, **_with_a_body_of(piece, bodies)})
    settled = settle_depths(alone, torn)
    error = np.linalg.norm(settled.positions - three.positions, axis=2)[piece]
    assert (
        np.nanmedian(error)
        < 0.02
        < 0.08
        < np.nanmedian(np.linalg.norm(alone.positions - three.positions, axis=2)[piece])
    )


def _with_a_body_of(piece: np.ndarray, bodies: MotionBodies) -> dict[str, np.ndarray]:
    """Fields of bodies of which a piece has come off and stands still."""
    frames = len(bodies.rotations)
    label = np.where(piece, bodies.body_count, bodies.label)
    weights = np.pad(bodies.weights, ((0, 0), (0, 1)))
    weights[piece] = np.eye(bodies.body_count + 1)[-1]
    still = np.tile(np.eye(3), (frames, 1, 1, 1))
    return {
        "label": label.astype(np.int32),
        "weights": weights,
        "rotations": np.concatenate([bodies.rotations, still], axis=1),
        "translations": np.pad(bodies.translations, ((0, 0), (0, 1), (0, 0))),
    }


def test_bodies_come_out_better_by_their_own_depths(three, alone, bodies):
    found, paths = find_bodies_and_depths(alone)
    assert same_partition(found.label, three.body) >= same_partition(bodies.label, three.body)
    assert found.body_count == 3
    assert_array_equal(found.positions[paths.seen], paths.positions[paths.seen])
    at_once, same = find_bodies_and_depths(alone, MotionBodiesSettings(depth_rounds=0))
    assert same is alone
    assert_array_equal(at_once.label, find_motion_bodies(alone).label)


def test_bodies_of_the_last_round_are_taken(monkeypatch, alone, bodies):
    noises = iter([5e-3, 2e-3, 3e-3, 4e-3])  # which say nothing
    found, settled, reported = [], [], []

    def find(paths, settings):
        found.append((replace(bodies, noise=next(noises)), paths))
        return found[-1][0]

    def settle(paths, of, outlines):
        settled.append((of, replace(paths)))
        return settled[-1][1]

    monkeypatch.setattr(ray_depths, "find_motion_bodies", find)
    monkeypatch.setattr(ray_depths, "settle_depths", settle)
    settings = MotionBodiesSettings(depth_rounds=3)
    last, paths = find_bodies_and_depths(alone, settings, lambda *step: reported.append(step))
    assert last is found[3][0] and paths is found[3][1] is settled[2][1]
    assert all(of is before for (of, _), (before, _) in zip(settled, found, strict=False))
    assert reported == [("bodies", k, 4) for k in range(5)]


def test_where_silhouettes_say_nothing_depths_are_those_of_the_motion(three, alone, bodies):
    anywhere = Outlines(np.arange(2), np.zeros((1, 3, 4)), np.zeros((2, 1, 4, 4), np.uint8))
    settled = settle_depths(alone, bodies, anywhere).positions
    assert_allclose(settled, settle_depths(alone, bodies).positions, atol=0.005)


@pytest.fixture(scope="module")
def seen_from_above(three) -> Outlines:
    """A camera from above whose image is empty but where the first body's samples are in the frames."""
    P = np.array([[[100.0, 0, 0, 500], [0, 100.0, 0, 500], [0, 0, 0, 1.0]]])  # parallel rays along z
    empty = np.ones((three.positions.shape[1], 1, 1000, 1000), np.uint8)
    for t in range(len(empty)):
        for x, y in np.rint(100.0 * three.positions[three.body == 0, t, :2] + 500).astype(int):
            empty[t, 0, y - 3 : y + 4, x - 3 : x + 4] = 0
    return Outlines(np.arange(len(empty)), P, empty)


def test_a_body_that_leaves_the_silhouettes_is_not_chosen(three, alone, bodies, seen_from_above):
    first = int(bodies.label[three.body == 0][0])
    motions = bodies.rotations.swapaxes(0, 1), bodies.translations.swapaxes(0, 1)
    outside = [
        ray_depths._place(alone, r[None], t[None], seen_from_above)[1].outside for r, t in zip(*motions, strict=True)
    ]
    own = three.body == 0
    missed = [float(np.median(o[own])) for o in outside]
    assert missed[first] < 0.05 < max(missed), missed
    assert np.argmin(missed) == first


def test_samples_near_a_body_are_placed_as_all_are_and_those_far_from_it_are_left_out(
    three, alone, bodies, seen_from_above
):
    last = int(bodies.label[three.body == 2][0])
    motion = bodies.rotations[None, :, last], bodies.translations[None, :, last]
    places = cKDTree(bodies.rest[bodies.label == last])
    asked = np.arange(alone.count) % 2 == 0
    some, near = ray_depths._place(alone, *motion, seen_from_above, asked, places)
    _, every = ray_depths._place(alone, *motion, seen_from_above)
    assert asked[some].all() and 0 < len(some) < asked.sum()
    for part in ("rest", "miss", "depth", "outside"):
        assert_array_equal(getattr(near, part), getattr(every, part)[some])
    left_out = np.setdiff1d(np.flatnonzero(asked), some)
    assert (places.query(every.rest[left_out])[0] > ray_depths._LOCAL * alone.diagonal).all()


def test_lines_of_sight_that_come_near_a_body_at_some_depth_are_kept_and_far_ones_are_not():
    rng = np.random.default_rng(0)
    body, rest, inward = (rng.normal(size=(n, 3)) for n in (30, 400, 400))
    body, inward = 0.1 * body, inward / np.linalg.norm(inward, axis=1, keepdims=True)
    depths = np.linspace(-ray_depths._REACH, ray_depths._REACH, 301)
    nearest = cKDTree(body).query(rest[:, None] + depths[:, None] * inward[:, None])[0].min(axis=1)
    kept = ray_depths._comes_near(rest, inward, cKDTree(body), 1.0)
    assert kept[nearest < ray_depths._LOCAL].all()
    assert not kept[nearest > 2.5 * ray_depths._LOCAL].any()
    assert 0 < kept.sum() < len(kept)


def test_depths_repeat_bit_for_bit(alone, bodies):
    assert_array_equal(settle_depths(alone, bodies).positions, settle_depths(alone, bodies).positions)
