"""Undistorted silhouettes: the right pixel, and what is seen at all."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from geomocap.carving.silhouette_views import PinholeViews, Undistortion, pad
from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig


def rig(*params: tuple[int, int, list[float]]) -> Rig:
    cameras = [pycolmap.Camera(model="OPENCV", width=w, height=h, params=p) for w, h, p in params]
    pose = np.column_stack([np.eye(3), np.zeros(3)])
    return Rig(tuple(f"cam{i}" for i in range(len(cameras))), tuple(cameras), np.array([pose] * len(cameras)))


def test_without_distortion_masks_stay_as_they_are_and_sizes_may_differ():
    r = rig((32, 20, [40, 40, 16, 10, 0, 0, 0, 0]), (24, 30, [40, 41, 12, 15, 0, 0, 0, 0]))
    rng = np.random.default_rng(0)
    masks = [(rng.random((20, 32)) < 0.5) * np.uint8(255), rng.random((30, 24)) < 0.5]
    views = Undistortion.of(r).views(masks)
    assert views.masks.shape == (2, 30, 32)
    for c, mask in enumerate(masks):
        h, w = mask.shape
        np.testing.assert_array_equal(views.masks[c, :h, :w], mask != 0)
        assert (
            views.valid[c, :h, :w].all() and views.valid[c].sum() == h * w and views.masks[c].sum() == (mask != 0).sum()
        )
    np.testing.assert_array_equal(views.projections, r.projections)


@pytest.mark.parametrize("k1", [-0.25, 0.2])
def test_distorted_masks_say_the_same_of_points_as_the_original(k1):
    r = rig((160, 120, [140, 142, 82, 59, k1, 0.03, 0.002, -0.001]))
    y, x = np.mgrid[0:120, 0:160]
    mask = ((x // 12 + y // 12) % 2).astype(np.uint8)
    views = Undistortion.of(r).views([mask])
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.8, 0.8, 4000), rng.uniform(-0.7, 0.7, 4000), np.ones(4000)])
    true = r.project(points)[0]
    flat = points @ views.projections[0, :, :3].T
    flat = flat[:, :2] / flat[:, 2:]
    H, W = views.masks.shape[1:]
    # a pixel's rounding apart from the checkers' edges both must agree; a half pixel's error would show at once
    clear = np.abs((true + 6) % 12 - 6).min(axis=1) > 1.2
    inside = (true > 0.7).all(axis=1) & (true < np.array([160, 120]) - 0.7).all(axis=1)
    outside = (true < -0.7).any(axis=1) | (true > np.array([160, 120]) + 0.7).any(axis=1)
    on_canvas = (flat >= 0).all(axis=1) & (flat < [W, H]).all(axis=1)
    assert on_canvas[inside].all() and (inside & clear).sum() > 800
    pick = inside & clear
    column, row = np.floor(flat[pick]).astype(int).T
    t_column, t_row = np.floor(true[pick]).astype(int).T
    np.testing.assert_array_equal(views.masks[0, row, column], mask[t_row, t_column])
    assert views.valid[0, row, column].all()
    column, row = np.floor(flat[outside & on_canvas]).astype(int).T
    assert not views.valid[0, row, column].any() and not views.masks[0, row, column].any()


@pytest.mark.parametrize("k1", [-0.25, 0.2])
def test_small_silhouettes_are_undistorted_as_parts_of_whole_images(k1):
    undistortion = Undistortion.of(rig((160, 120, [140, 142, 82, 59, k1, 0.03, 0.002, -0.001])))
    source, valid = undistortion.sources[0], undistortion.valid[0]
    for y, x in ((0, 0), (50, 70), (100, 140)):
        mask = np.zeros((120, 160), np.uint8)
        mask[y : y + 20, x : x + 20] = 255
        expected = (mask[source[..., 1], source[..., 0]] != 0) & (valid != 0)
        assert expected.any()
        np.testing.assert_array_equal(undistortion.views([mask]).masks[0], expected)
    assert not undistortion.views([np.zeros((120, 160), np.uint8)]).masks.any()


def test_half_a_pixel_is_noticed():
    """The columns where a vertical edge comes out average to where it is, far better than half a pixel."""
    r = rig((160, 120, [140, 140, 80, 60, -0.2, 0, 0, 0]))
    mask = np.zeros((120, 160), np.uint8)
    mask[:, 110:] = 1
    undistortion = Undistortion.of(r)
    flat = undistortion.views([mask])
    height = flat.masks.shape[1]
    errors = []
    for v in range(20, height - 20):
        row = flat.masks[0, v]
        edge = int(np.flatnonzero(np.diff(row.astype(int)) == 1)[0]) + 1
        ray = np.array(
            [(edge - undistortion.projections[0, 0, 2]) / 140, (v + 0.5 - undistortion.projections[0, 1, 2]) / 140, 1]
        )
        errors.append(r.project(ray[None])[0, 0, 0] - 110)
    assert abs(np.mean(errors)) < 0.1


def test_images_land_where_masks_do():
    r = rig((160, 120, [140, 140, 80, 60, -0.2, 0.05, 0, 0]), (100, 90, [120, 120, 50, 45, 0, 0, 0, 0]))
    masks = [np.zeros((120, 160), np.uint8), np.zeros((90, 100), np.uint8)]
    masks[0][30:80, 40:130] = 1
    masks[1][20:50, 30:60] = 1
    undistortion = Undistortion.of(r)
    views = undistortion.views(masks)
    images = undistortion.images([np.repeat(m[..., None] * np.uint8(200), 3, axis=2) for m in masks])
    assert images.shape == (*views.masks.shape, 3) and images.dtype == np.uint8
    assert ((images[..., 0] > 100) != (views.masks != 0)).mean() < 0.004  # interpolated edges apart


def test_images_are_undistorted_where_the_subject_is_if_that_is_enough():
    r = rig((160, 120, [140, 140, 80, 60, -0.2, 0.05, 0, 0]), (100, 90, [120, 120, 50, 45, 0, 0, 0, 0]))
    masks = [np.zeros((120, 160), np.uint8), np.zeros((90, 100), np.uint8)]
    masks[0][40:50, 60:90] = 1
    masks[1][80:90, 50:60] = 1  # at the image's border, which is not the canvas's
    images = [np.random.default_rng(c).integers(1, 255, (*m.shape, 3)).astype(np.uint8) for c, m in enumerate(masks)]
    undistortion = Undistortion.of(r)
    views = undistortion.views(masks)
    whole, part = undistortion.images(images), undistortion.images(images, views)
    for c, mask in enumerate(views.masks):
        np.testing.assert_array_equal(part[c][mask != 0], whole[c][mask != 0])
        assert 0 < (part[c] != 0).mean() < 0.2
    empty = undistortion.views([np.zeros_like(m) for m in masks])
    assert not undistortion.images(images, empty).any()


def test_a_polynomial_that_folds_back_shows_nothing_twice():
    # beyond radius 1 / sqrt(−3 k1) the distortion turns round and would show the image again
    r = rig((200, 150, [80, 80, 100, 75, -0.1, 0, 0, 0]))
    undistortion = Undistortion.of(r)
    H, W = undistortion.valid.shape[1:]
    y, x = np.mgrid[0:H, 0:W] + 0.5
    P = undistortion.projections[0]
    radius = np.hypot((x - P[0, 2]) / P[0, 0], (y - P[1, 2]) / P[1, 1])
    assert not undistortion.valid[0][radius > 1 / np.sqrt(0.3) + 0.05].any()
    assert undistortion.valid[0][radius < 0.9].all()


def test_wrong_numbers_and_sizes_are_named():
    undistortion = Undistortion.of(rig((32, 20, [40, 40, 16, 10, 0, 0, 0, 0])))
    with pytest.raises(CalibrationError, match="2 images for 1 cameras"):
        undistortion.views([np.zeros((20, 32))] * 2)
    with pytest.raises(CalibrationError, match="cam0: image of 20×32, but calibrated for 32×20"):
        undistortion.views([np.zeros((32, 20))])
    with pytest.raises(CalibrationError, match="expected one 3×4 matrix"):
        PinholeViews(("a",), np.zeros((2, 3, 4)), np.zeros((1, 2, 2), np.uint8), np.zeros((1, 2, 2), np.uint8))


def test_padding():
    canvas = pad([np.ones((2, 3), np.uint8), np.ones((4, 1), np.uint8)])
    assert canvas.shape == (2, 4, 3) and canvas.sum() == 10
