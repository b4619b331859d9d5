"""Lost patches kept in place by those that were measured beside them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from geomocap.model.rotations import nearest_rotation
from geomocap.patches.companions import Companions, _distances
from geomocap.patches.patch_prediction import carried, orthonormal

RNG = np.random.default_rng(0)
LIMB, TRUNK = 30, 30
N = LIMB + TRUNK
POSITIONS = np.concatenate(
    [RNG.uniform((0.0, 0, 0), (0.3, 0.05, 0.05), (LIMB, 3)), RNG.uniform((0.0, 0.08, 0), (0.3, 0.3, 0.1), (TRUNK, 3))]
)
FRAMES = Rotation.random(N, random_state=1).as_matrix()
IDENTITY = RNG.permutation(1000)[:N]
TURN, SHIFT = Rotation.from_rotvec((0.3, 1.2, -0.5)).as_matrix(), np.array([0.4, -0.2, 0.1])
ON_LIMB = np.arange(N) < LIMB


def moved_limb():
    """Places after the limb alone has moved."""
    positions, frames = POSITIONS.copy(), FRAMES.copy()
    positions[:LIMB], frames[:LIMB] = POSITIONS[:LIMB] @ TURN.T + SHIFT, TURN @ FRAMES[:LIMB]
    return positions, frames


def remembered(who, among=None):
    among = np.arange(N) if among is None else among
    return Companions.none(N).met(who, among, IDENTITY, (POSITIONS, FRAMES), (np.zeros((N, 3)), np.zeros((N, 3))))


def test_a_lost_patch_goes_with_most_of_its_companions():
    truth, turned = moved_limb()
    lost = np.array([3, 11, LIMB + 4])
    known = np.ones(N, bool)
    known[lost] = False
    guess = truth.copy()
    guess[lost] = 9.0
    X, Q, placed = remembered(lost).placed(IDENTITY, known, guess, turned)
    assert placed.all()
    assert_allclose(X, truth, atol=1e-12)
    assert_allclose(Q, turned, atol=1e-12)


def test_three_found_again_bring_back_the_whole_limb():
    truth, turned = moved_limb()
    companions = remembered(np.arange(LIMB), np.arange(LIMB))
    known = ~ON_LIMB
    first = companions.identity[0][:3]  # companions of the same patch
    known |= np.isin(IDENTITY, first)
    guess = np.where(known[:, None], truth, 9.0)
    X, _, placed = companions.placed(IDENTITY, known, guess, turned)
    assert placed.all()
    assert_allclose(X, truth, atol=1e-12)
    two = known & (IDENTITY != first[0])
    assert_array_equal(companions.placed(IDENTITY, two, guess, turned)[2], two)


@pytest.mark.parametrize("sure", [True, False])
def test_what_is_found_must_lie_among_its_companions(sure):
    """Found patches agree with sure ones, or with one another; what is elsewhere agrees with none."""
    truth, turned = moved_limb()
    companions = remembered(np.arange(LIMB), np.arange(LIMB))
    doubtful = ON_LIMB & (np.arange(N) % 3 > 0)
    wrong = np.array([1, 10, 19])
    at = truth.copy()
    at[wrong] += 0.02
    others = ~doubtful if sure else ~ON_LIMB
    agreed = companions.agreed(IDENTITY, others, doubtful, at, turned, np.full(N, 0.005))
    assert not agreed[wrong].any() and not agreed[~doubtful].any()
    right = doubtful.copy()
    right[wrong] = False
    assert agreed[right].mean() > 0.9
    scattered = at + RNG.normal(0, 0.05, at.shape)
    assert not companions.agreed(IDENTITY, ~ON_LIMB, doubtful, scattered, turned, np.full(N, 0.005)).any()


def test_companions_are_those_that_moved_alike():
    """A limb that turns on the trunk it lies against has companions of its own, though others are as near."""
    positions = POSITIONS[RNG.permutation(N)] * (1, 0.2, 1)  # both in one place
    spin = np.where(ON_LIMB[:, None], (0.0, 0.0, 1.5), 0.0)
    on_limb = dict(zip(IDENTITY.tolist(), ON_LIMB.tolist(), strict=True))

    def own_fraction(turn):
        motion = np.cross(turn, positions), turn
        found = Companions.none(N).met(np.arange(N), np.arange(N), IDENTITY, (positions, FRAMES), motion)
        same = [
            [on_limb[j] == on_limb[i] for j in row] for i, row in zip(IDENTITY, found.identity.tolist(), strict=True)
        ]
        return np.mean(same)

    assert own_fraction(spin) > 0.9
    assert own_fraction(np.zeros((N, 3))) < 0.7


def test_companions_stay_with_their_patches():
    truth, turned = moved_limb()
    companions = remembered(np.arange(N))
    half = np.flatnonzero(np.arange(N) % 2 == 0)
    order = np.concatenate([half, np.setdiff1d(np.arange(N), half)])
    joined = companions.select(half).join(companions.select(order[len(half) :]))
    known = np.arange(N) % 5 > 0
    X, _, placed = joined.placed(IDENTITY[order], known[order], truth[order], turned[order])
    assert placed.all()
    assert_allclose(X, companions.placed(IDENTITY, known, truth, turned)[0][order], atol=1e-9)


def test_those_that_left_count_no_more():
    companions = remembered(np.array([0]))
    rest = np.setdiff1d(np.arange(N), np.flatnonzero(np.isin(IDENTITY, companions.identity[0][2:])))
    known = np.ones(len(rest), bool)
    known[0] = False
    left = companions.select(rest).placed(IDENTITY[rest], known, POSITIONS[rest], FRAMES[rest])[2]
    assert not left[0]


@pytest.mark.parametrize("mended", [True, False])
def test_frames_that_carry_each_other_stay_rotations_only_if_rounding_is_taken_out(mended):
    """Two patches, one measured in each frame, the other carried along: their rounding errors feed each other."""
    frames, positions = FRAMES[:2].copy(), POSITIONS[:2]
    steps = Rotation.random(400, random_state=3).as_matrix()
    for k, turn in enumerate(steps):
        measured, lost = np.array([k % 2]), np.array([1 - k % 2])
        new = frames.copy()
        new[measured] = turn @ frames[measured]
        new[lost] = carried(positions, frames, measured[:, None], positions, new, lost)[1][:, 0]
        frames = orthonormal(new) if mended else new
        with np.errstate(all="ignore"):
            off = np.abs(frames @ np.swapaxes(frames, 1, 2) - np.eye(3)).max()
        if not off < 1e-6:
            break
    assert (off < 1e-14) == mended


def test_one_newton_step_is_the_nearest_rotation():
    rng = np.random.default_rng(5)
    frames = Rotation.random(50, random_state=4).as_matrix() + 1e-6 * rng.normal(size=(50, 3, 3))
    assert_allclose(orthonormal(frames), nearest_rotation(frames), atol=1e-11)


def test_distances_of_places_are_those_of_numpy():
    rng = np.random.default_rng(6)
    spots, have = rng.normal(size=(9, 5, 3)), rng.random((9, 5)) < 0.7
    away = np.zeros((9, 5, 5))
    _distances(0, 9, spots, have, away)
    every = np.linalg.norm(spots[:, :, None] - spots[:, None], axis=3)
    assert_array_equal(away, np.where(have[:, None] & have[:, :, None], every, 0.0))
