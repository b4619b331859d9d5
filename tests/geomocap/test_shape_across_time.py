"""Where the surface of bodies can be, if the silhouettes of all frames are those of one shape that moves."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from geomocap.bodies.shape_across_time import MAY_MISS, hull_fronts
from geomocap.errors import GeometryError
from geomocap.model.outlines import Outlines

RADIUS, SIZE, FRAMES = 0.3, 160, 12
STEP, REACH = 0.01, 0.5


def cameras():
    """Four cameras round the origin, 4 m away."""
    result = []
    for angle in np.deg2rad([0, 70, 140, 250]):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.cross(forward, [0, 0, 1.0])
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[300.0, 0, SIZE / 2], [0, 300.0, SIZE / 2], [0, 0, 1]])
        result.append(K @ np.concatenate([R, (-4.0 * R @ -forward)[:, None]], axis=1))
    return np.array(result)


def project(P, points):
    w = points @ P[:, :, :3].swapaxes(1, 2) + P[:, None, :, 3]
    return w[..., :2] / w[..., 2:]


@pytest.fixture(scope="module")
def scene():
    """A ball that a rod passes now and then, where every camera sees both as one silhouette, and its motion."""
    P = cameras()
    turns = Rotation.from_rotvec(np.linspace(0, 1.5, FRAMES)[:, None] * [0.2, 0.1, 1.0]).as_matrix()
    shifts = np.linspace(0, 0.1, FRAMES)[:, None] * [1.0, 0.5, 0.2]
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(20_000, 3))
    ball *= RADIUS * rng.random((len(ball), 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    empty = np.ones((FRAMES, len(P), SIZE, SIZE), np.uint8)
    for t in range(FRAMES):
        points = ball @ turns[t].T + shifts[t]
        if t % 3 == 0:  # the rod
            points = np.concatenate([points, rng.uniform([0.2, -0.1, -0.1], [0.7, 0.1, 0.1], (20_000, 3))])
        for c, pixels in enumerate(np.rint(project(P, points)).astype(int)):
            empty[t, c, pixels[:, 1], pixels[:, 0]] = 0
    return Outlines(np.arange(FRAMES), P, empty), turns, shifts


def on_the_ball(count=40):
    """Places of the ball on the side of the rod, and the directions inward."""
    rng = np.random.default_rng(1)
    outward = rng.normal(size=(count, 3)) * 0.3 + [1.0, 0, 0]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return RADIUS * outward, -outward


def reference(rest, inward, turns, shifts, outlines, step, reach):
    steps = int(np.ceil(reach / step))
    s = np.arange(-steps, steps + 1)
    allowed = int(MAY_MISS * outlines.empty.shape[0] * outlines.empty.shape[1])
    result, missed = np.zeros(len(rest)), np.zeros(len(rest))

    def misses(line):
        counts = np.zeros(len(line), int)
        for k, t in enumerate(outlines.frames):
            pixels = np.rint(project(outlines.projections, line @ turns[t].T + shifts[t])).astype(int)
            for c in range(len(pixels)):
                x, y = pixels[c].T
                inside = (x >= 0) & (y >= 0) & (x < SIZE) & (y < SIZE)
                counts[inside] += outlines.empty[k, c, y[inside], x[inside]]
        return counts

    for i in range(len(rest)):
        counts = misses(rest[i] + step * s[:, None] * inward[i])
        missed[i] = counts.min() / outlines.empty[:, :, 0, 0].size
        good = counts <= counts.min() + allowed
        later, before = np.flatnonzero(good[steps:]), np.flatnonzero(~good[:steps])
        if not good[steps] and len(later):
            inside = step * later[0]
        elif good[steps] and len(before):
            inside = step * (before[-1] + 1 - steps)
        else:
            continue
        outside = inside - step
        for _ in range(3):
            middle = 0.5 * (inside + outside)
            if misses((rest[i] + middle * inward[i])[None])[0] <= counts.min() + allowed:
                inside = middle
            else:
                outside = middle
        result[i] = inside
    return result, missed


def test_kernel_is_exact_against_numpy(scene):
    outlines, turns, shifts = scene
    rest, inward = on_the_ball()
    for moved in (-0.2, 0.0, 0.15):
        args = rest + moved * inward, inward
        found = hull_fronts(*args, turns[None], shifts[None], outlines, STEP, REACH)
        for mine, theirs in zip(found, reference(*args, turns, shifts, outlines, STEP, REACH), strict=True):
            assert_allclose(mine, theirs, atol=1e-12)


def test_fronts_of_all_frames_are_the_surface_though_a_rod_is_before_it(scene):
    outlines, turns, shifts = scene
    rest, inward = on_the_ball()
    for moved in (-0.3, -0.1, 0.1):  # before the surface, where the rod is, and within
        shift = hull_fronts(rest + moved * inward, inward, turns[None], shifts[None], outlines, STEP, REACH)[0]
        assert np.median(np.abs(moved + shift)) < 0.025  # two pixels
    still = Outlines(outlines.frames[:1], outlines.projections, outlines.empty[:1])
    alone = hull_fronts(rest, inward, turns[None], shifts[None], still, STEP, REACH)[0]
    assert np.median(-alone) > 0.1  # the hull of one frame has the rod's depth


def test_silhouettes_that_miss_the_subject_altogether_are_at_fault_themselves(scene):
    outlines, turns, shifts = scene
    rest, inward = on_the_ball()
    empty = outlines.empty.copy()
    empty[[1, 7, 9]] = 1
    broken = Outlines(outlines.frames, outlines.projections, empty)
    shift, missed = hull_fronts(rest - 0.1 * inward, inward, turns[None], shifts[None], broken, STEP, REACH)
    assert np.median(np.abs(shift - 0.1)) < 0.04  # three pixels, as fewer views are left
    assert missed.min() >= 0.25  # three of twelve frames


def test_each_place_may_move_on_its_own(scene):
    outlines, turns, shifts = scene
    rest, inward = on_the_ball(8)
    together = hull_fronts(rest, inward, turns[None], shifts[None], outlines, STEP, REACH)
    every = np.repeat(turns[None], 8, axis=0), np.repeat(shifts[None], 8, axis=0)
    for mine, theirs in zip(hull_fronts(rest, inward, *every, outlines, STEP, REACH), together, strict=True):
        assert_allclose(mine, theirs, atol=0)


def test_outlines_of_other_shapes_are_refused():
    with pytest.raises(GeometryError, match="outlines: 2 frames"):
        Outlines(np.arange(2), np.zeros((3, 3, 4)), np.zeros((2, 4, 5, 5), np.uint8))


def test_a_motion_that_is_not_its_own_carries_a_place_out_of_the_silhouettes(scene):
    outlines, turns, shifts = scene
    rest, inward = on_the_ball()
    own = hull_fronts(rest, inward, turns[None], shifts[None], outlines, STEP, REACH)[1]
    away = shifts + np.linspace(0, 1.5, FRAMES)[:, None] * [0, 0, 1.0]
    other = hull_fronts(rest, inward, turns[None], away[None], outlines, STEP, REACH)[1]
    assert own.max() <= MAY_MISS < 0.3 < other.min()


def test_frames_that_the_paths_do_not_have_are_refused(scene):
    outlines = scene[0]
    outlines.check_frames(FRAMES)
    with pytest.raises(GeometryError, match="frames 0 to 11, but the paths have 11; number them"):
        outlines.check_frames(FRAMES - 1)
