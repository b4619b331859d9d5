"""What is no body: soft skin around a joint and folds of cloth; and what is one, though it touches and turns alike."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.model.motion_paths import MotionPaths
from tests.geomocap.moving_chains import box_surface, chain, same_partition


@pytest.fixture(scope="module")
def three():
    return chain(3)


def test_soft_skin_is_no_body_of_its_own():
    two = chain(2, samples=250, turn_deg=45.0)
    weight = np.clip((two.positions[:, 0, 0] - 0.25) / 0.3, 0.0, 1.0)  # 0.3 m of skin between the two
    rest = two.positions[:, 0]
    first = np.einsum("tij,nj->nti", two.rotations[:, 0], rest) + two.translations[:, 0]
    second = np.einsum("tij,nj->nti", two.rotations[:, 1], rest) + two.translations[:, 1]
    paths = MotionPaths((1 - weight)[:, None, None] * first + weight[:, None, None] * second)
    bodies = find_motion_bodies(paths)
    assert bodies.body_count == 2
    rigid = (weight == 0) | (weight == 1)
    assert same_partition(bodies.label[rigid], (weight[rigid] > 0.5).astype(int)) == 1.0
    of_second = bodies.weights[:, bodies.label[np.argmax(rest[:, 0])]]
    assert np.abs(of_second - weight)[~rigid].mean() < 0.12  # even blends are penalised
    alone = find_motion_bodies(paths, MotionBodiesSettings(blends=False))
    assert np.isin(alone.weights, [0.0, 1.0]).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_deep_soft_skin_between_three_bodies_is_no_fourth(seed):
    three = chain(3, samples=200, turn_deg=70.0, seed=seed)
    rest = three.positions[:, 0]
    up, down = (np.clip((rest[:, 0] - joint + 0.25) / 0.5, 0.0, 1.0) for joint in (0.4, 0.8))
    up, down = (fraction**2 * (3.0 - 2.0 * fraction) for fraction in (up, down))
    weights = np.stack([1 - up, up * (1 - down), up * down], axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    carried = np.einsum("tbij,nj->nbti", three.rotations, rest) + three.translations.swapaxes(0, 1)[None]
    paths = MotionPaths(np.einsum("nb,nbti->nti", weights, carried))
    assert find_motion_bodies(paths, MotionBodiesSettings(soft_fraction=0.0)).body_count > 3
    pieces = np.digitize(rest[:, 0], np.linspace(0.0, 1.2, 10)[1:-1])  # rigid parts are no skin
    assert find_motion_bodies(replace(paths, parts=pieces)).body_count > 3
    bodies = find_motion_bodies(paths)
    assert bodies.body_count == 3
    core = weights.max(axis=1) > 0.8
    assert same_partition(bodies.label[core], weights[core].argmax(axis=1)) > 0.97


def test_bodies_that_touch_and_turn_alike_are_two_if_nothing_joins_them():
    rng, frames = np.random.default_rng(0), 30

    def block(samples: int, low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
        return rng.uniform(low, high, (samples, 3))

    base = block(400, (-0.4, 0.0, -0.06), (0.4, 0.3, 0.0))
    turns = np.deg2rad(35.0) * np.sin(np.linspace(0.0, 2 * np.pi, frames))
    swings = Rotation.from_rotvec(np.outer(turns, [0.0, 1.0, 0.0])).as_matrix()
    parts = [np.repeat(base[:, None], frames, axis=1)]
    for hinge in (-0.04, 0.04):  # two flaps side by side, each with a hinge of its own
        flap = block(250, (-0.03, 0.0, 0.0), (0.03, 0.3, 0.35))
        parts.append(np.einsum("tij,nj->nti", swings, flap) + np.array([hinge, 0.0, 0.0]))
    bodies = find_motion_bodies(MotionPaths(np.concatenate(parts)))
    assert bodies.body_count == 3
    assert same_partition(bodies.label, np.repeat([0, 1, 2], [400, 250, 250])) > 0.98


@pytest.mark.parametrize(
    ("turn_deg", "length", "width", "soft"),
    [(20, 0.25, 0.06, 0.06), (25, 0.25, 0.06, 0.08), (30, 0.25, 0.06, 0.06)],
)
def test_a_thigh_is_no_soft_skin_of_trunk_and_shank(turn_deg, length, width, soft):
    rng, frames = np.random.default_rng(0), 30

    def block(samples: int, start: float, end: float, half: float) -> np.ndarray:
        return rng.uniform((start, -half, -half), (end, half, half), (samples, 3))

    thigh, shank = int(600 * length), 200
    parts = [(400, -0.5, 0.0, 0.15), (thigh, 0.0, length, width / 2), (shank, length, length + 0.35, width / 2)]
    rest = np.concatenate([block(*part) for part in parts])
    angles = np.deg2rad(turn_deg) * np.sin(np.linspace(0, 2 * np.pi, frames))
    swings = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
    by_thigh = np.einsum("tij,nj->nti", swings, rest)
    knee = np.array([length, 0.0, 0.0])
    by_shank = rest[:, None] + (swings @ knee - knee)  # it stays upright, as the trunk does
    hip, down = (np.clip((rest[:, 0] - at + soft) / (2 * soft), 0.0, 1.0)[:, None, None] for at in (0.0, length))
    positions = (1 - hip) * rest[:, None] + hip * ((1 - down) * by_thigh + down * by_shank)
    bodies = find_motion_bodies(MotionPaths(positions))
    assert bodies.body_count == 3
    stiff = (np.abs(rest[:, 0]) > soft) & (np.abs(rest[:, 0] - length) > soft)  # skin may follow either body
    assert same_partition(bodies.label[stiff], np.repeat([0, 1, 2], [400, thigh, shank])[stiff]) > 0.97


@pytest.mark.parametrize(("turn_deg", "noise"), [(25, 0.005), (25, 0.01), (40, 0.01)])
def test_a_thin_limb_between_two_bodies_is_one_for_it_joins_them(turn_deg, noise):
    rng, frames = np.random.default_rng(0), 30
    parts = [(400, -0.5, 0.0, 0.15), (100, 0.0, 0.3, 0.015), (120, 0.3, 0.65, 0.04)]
    rest = np.concatenate([rng.uniform((start, -h, -h), (end, h, h), (n, 3)) for n, start, end, h in parts])
    body = np.repeat([0, 1, 2], [part[0] for part in parts])
    angles = np.deg2rad(turn_deg) * np.sin(np.linspace(0, 2 * np.pi, frames))
    swings = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
    knee = np.array([0.3, 0.0, 0.0])
    carried = [np.repeat(rest[:, None], frames, axis=1), np.einsum("tij,nj->nti", swings, rest)]
    carried.append(rest[:, None] + (swings @ knee - knee))  # it stays upright, as the first does
    positions = np.stack(carried)[body, np.arange(len(body))]
    # blends of what it joins, which turn alike, explain an axis between them wholly
    bodies = find_motion_bodies(MotionPaths(positions + noise * rng.normal(size=positions.shape)))
    assert bodies.body_count == 3
    assert same_partition(bodies.label, body) > 0.9


@pytest.mark.parametrize("wave", [(60.0, 40.0, 0.5), (40.0, 60.0, 0.5), (30.0, 30.0, 0.5), (50.0, -40.0, 0.4)])
def test_folds_of_cloth_are_no_bodies(three, wave):
    rest = three.positions[:, 0]
    phase = wave[0] * rest[:, 0, None] + wave[1] * rest[:, 1, None] + wave[2] * np.arange(24)
    counts = []
    for height in (0.006, 0.008, 0.009, 0.010, 0.011):  # metres; they turn the cloth by up to 45 degrees to and fro
        folds = height * np.sin(phase)[..., None] * np.array([0.2, 0.6, 0.8])  # waves that run over the middle box
        bodies = find_motion_bodies(MotionPaths(three.positions + (three.body == 1)[:, None, None] * folds))
        counts.append(bodies.body_count)
        if bodies.body_count == 3:
            assert same_partition(bodies.label, three.body) > 0.9
    # which groups come first is luck: one height or another leaves a fold
    assert np.median(counts) == 3
    assert max(counts) <= 4


@pytest.mark.parametrize("seed", range(3))
def test_paths_that_go_astray_are_no_body(seed):
    """A third of a limb's paths wander about by 3 cm: bodies of them would miss them by less than the limb does."""
    three, rng = chain(3, samples=150), np.random.default_rng(seed)
    positions = three.positions + rng.normal(scale=1e-3, size=three.positions.shape)
    astray = np.flatnonzero(positions[:, 0, 0] > 1.06)
    wandering = gaussian_filter1d(rng.normal(size=(len(astray) + 1, 24, 3)), 4.0, axis=1)
    positions[astray] += 0.03 * (wandering[1:] + wandering[:1]) / (np.sqrt(2.0) * wandering.std())
    assert find_motion_bodies(MotionPaths(positions)).body_count == 3


def test_a_small_body_that_slides_along_a_large_one_is_one():
    """A slide on a beam: it turns by less than a body must, and the beam is all that it hangs on."""
    rng, phase = np.random.default_rng(0), 2.0 * np.pi * np.arange(30) / 30
    beam = box_surface(rng, 300, [0.0, -0.06, -0.05], [1.2, 0.06, 0.05])
    rider = box_surface(rng, 100, [0.5, -0.04, 0.05], [0.62, 0.04, 0.13])
    turns = Rotation.from_euler("z", 12.0 * np.sin(phase)[:, None], degrees=True).as_matrix()
    middle = rider.mean(axis=0)
    moved = np.einsum("tij,nj->nti", turns, rider - middle) + middle
    moved[..., 0] += 0.1 * np.sin(phase)
    positions = np.concatenate([np.repeat(beam[:, None], 30, axis=1), moved])
    bodies = find_motion_bodies(MotionPaths(positions + rng.normal(scale=1e-3, size=positions.shape)))
    assert bodies.body_count == 2
    assert same_partition(bodies.label, np.repeat([0, 1], [len(beam), len(rider)])) > 0.97
