"""What the other cameras say of a pixel, and what that is worth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import maximum

from geomocap.silhouettes.colors import LEVELS
from geomocap.silhouettes.likelihood import (
    BINS,
    CLASSES,
    SURE,
    Counts,
    Likelihood,
)
from geomocap.silhouettes.other_cameras import NOWHERE, STEPS, OtherCameras, best_on_rays, gather, say
from geomocap.silhouettes.pieces import clean, said_of
from tests.geomocap.test_silhouettes_joint import ball, render, ring_rig


def test_says_follow_the_sensor_model() -> None:
    assert say(np.array([0.0])) == 0
    far = say(np.array([20.0, -20.0])) / STEPS
    np.testing.assert_allclose(far, [np.log(0.98 / 0.3), np.log(0.02 / 0.7)], atol=0.04)


def test_voxels_and_rays_are_read_as_in_numpy() -> None:
    rng = np.random.default_rng(2)
    rig = ring_rig(3)
    others = OtherCameras.of(rig)
    says = rng.integers(-50, 20, others.valid.shape).astype(np.int8)
    beyond = np.array([-5, 0, -7], np.int8)
    origin, edge, shape = np.array([-0.7, -0.6, -0.9]), 0.09, (15, 14, 20)
    origin.setflags(write=False)  # as a grid's
    volume = np.empty((3, *shape), np.int8)
    gather(others.projections, says, beyond, origin, edge, volume)
    centers = origin + (np.stack(np.mgrid[:15, :14, :20], axis=-1) + 0.5) * edge
    q = (
        np.einsum("cij,xyzj->cxyzi", others.projections[:, :, :3], centers)
        + others.projections[:, None, None, None, :, 3]
    )
    u, v = np.floor(q[..., 0] / q[..., 2]).astype(int), np.floor(q[..., 1] / q[..., 2]).astype(int)
    H, W = says.shape[1:]
    inside = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    c = np.arange(3)[:, None, None, None]
    expected = np.where(inside, says[c, v.clip(0, H - 1), u.clip(0, W - 1)], beyond[c])
    assert (expected == volume).mean() > 0.9999  # a centre on the border between two pixels may fall into either

    camera = others.cameras[0]
    word = volume[1:].sum(axis=0, dtype=np.int16)
    best, _ = best_on_rays(camera.origin, camera.rays, word, origin, edge, 300.0, 10_000)
    steps = np.arange(0, 5, edge / 50)
    for y, x in np.argwhere(best < np.inf)[::37]:
        place = np.floor((camera.origin + steps[:, None] * camera.rays[y, x] - origin) / edge).astype(int)
        i, j, k = place[((place >= 0) & (place < shape)).all(axis=1)].T
        finest = word[i, j, k].max(initial=int(NOWHERE * STEPS)) / STEPS
        assert best[y, x] <= finest + 1e-6  # steps of a whole voxel may pass a corner by, but never invent one
        if len(i) > 400:
            assert best[y, x] > NOWHERE
    least = float(np.quantile(word, 0.7))
    for enough in (10_000, 20):
        best, length = best_on_rays(camera.origin, camera.rays, word, origin, edge, least, enough)
        assert 0 < length.max() < 40
        for y, x in np.argwhere(best < np.inf)[::37]:
            expected = _best_on_ray(camera.origin, camera.rays[y, x], word, origin, edge, least, enough)
            assert (best[y, x], length[y, x]) == (np.float32(expected[0]), expected[1])


def _best_on_ray(
    origin: np.ndarray, ray: np.ndarray, word: np.ndarray, low: np.ndarray, edge: float, least: float, enough: int
) -> tuple[float, int]:
    """`best_on_rays` of one ray, step by step from where it meets the grid."""
    ray = ray.astype(float)
    borders = np.sort((np.array([low, low + np.array(word.shape) * edge]) - origin) / ray, axis=0)
    near, far = max(0.0, borders[0].max()), borders[1].min()
    best, length = NOWHERE * STEPS, 0
    for n in range(int((far - near) / edge) + 1 if near < far else 0):
        place = (origin + near * ray - low) / edge + (n + 0.5) * ray
        if (place >= 0).all() and (place < word.shape).all():
            said = word[tuple(place.astype(int))]
            best, length = max(best, said), length + (said >= least)
    return min(best, enough) / STEPS, length


def test_what_is_confirmed_is_as_large_as_it_is_in_space():
    """A ball that seven of eight cameras are sure of, as the eighth sees it: in voxels, whatever the lens."""
    rig = ring_rig(8)
    others = OtherCameras.of(rig)
    masks = render(rig, [ball((0.0, 0.0, 0.0), 0.3)])
    words = others.words([np.where(mask, 6.0, -6.0).astype(np.float32) for mask in masks])
    assert words is not None
    voxel = 0.6 * (1 + 2 * 0.04) / 96  # the grid goes round the ball
    for word, mask in zip(words, masks, strict=True):
        assert (word.size[~cv2.dilate(mask.view(np.uint8), np.ones((15, 15), np.uint8)).view(bool)] == 0).all()
        assert word.size.max() == pytest.approx(0.6 / voxel, rel=0.25)  # a hull is larger, a box has a margin
        rows, columns = np.nonzero(mask)
        assert word.size[int(rows.mean()), int(columns.mean())] > 0.9 * word.size.max()


def test_a_large_volume_is_worth_more_than_a_thin_one():
    counts = Counts(
        np.zeros((2, len(BINS))),
        np.zeros(LEVELS**3),
        np.zeros((2, CLASSES + 1)),
        np.array([[90.0, 80, 70, 50, 20, 9, 0, 0], [10.0, 20, 70, 100, 400, 900, 999, 0]]),
        np.ones((2, 2)),
    )
    likelihood = Likelihood.of(counts)
    sizes = np.array([[0.0, 0.3, 0.9, 3.0, 6.0, 12.0, 31.0, 200.0]])
    bonus = likelihood.bonus(sizes)[0]
    assert bonus[0] == bonus[1] == 0.0
    assert (np.diff(bonus) >= 0).all()
    of_four_to_eight = np.log(401 / 21)
    assert likelihood.bonus(np.array([[8.0 * np.sqrt(2)]]))[0, 0] == pytest.approx(of_four_to_eight)
    assert bonus[-1] <= SURE


def test_a_piece_that_the_others_deny_everywhere_goes() -> None:
    """One other camera that sees the place is too little against each pixel, but not against all of a piece."""
    mask = np.zeros((60, 80), bool)
    mask[10:50, 10:30] = mask[20:40, 50:70] = True
    odds = np.where(mask, 6.0, -6.0).astype(np.float32)
    words = np.full(mask.shape, -3.5, np.float32)
    words[15:45, 12:28] = 2.0  # the rim of the subject isn't confirmed, but hangs together with what is
    alone, together = (clean(mask, odds, 1.0, 1e-4, said) for said in (None, words))
    np.testing.assert_array_equal(alone, mask)
    assert together[10:50, 10:30].all() and together.sum() == 40 * 20
    words[25:30, 55:60] = 0.0  # nobody else sees this
    np.testing.assert_array_equal(clean(mask, odds, 1.0, 1e-4, words), mask)


def test_what_others_say_of_regions_is_their_largest_word():
    rng = np.random.default_rng(3)
    labels = rng.integers(0, 9, (40, 30)).astype(np.int32)
    words = rng.normal(-3.0, 1.2, labels.shape).astype(np.float32)
    found = said_of(labels, words, 10)  # label 9: no pixel
    largest = maximum(words, labels, np.arange(9))
    np.testing.assert_array_equal(found[:9], largest >= 0.0)
    assert 0 < found.sum() < 9 and not found[9]
