"""Wallis filter and Foerstner operator against slow references."""

from __future__ import annotations

import numpy as np
import pytest

from geomocap.matching.foerstner import foerstner, interest_points
from geomocap.matching.matching_settings import SeedSettings, WallisSettings
from geomocap.matching.wallis import local_statistics, wallis


def window_of(image: np.ndarray, row: int, column: int, half: int) -> np.ndarray:
    return image[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]


@pytest.mark.parametrize("masked", [False, True])
def test_local_statistics_are_exact_up_to_the_borders(masked: bool) -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 255, (30, 40))
    mask = rng.uniform(size=image.shape) > 0.3 if masked else np.ones(image.shape, bool)
    mean, deviation = local_statistics(image, 9, mask if masked else None)
    for row, column in [(0, 0), (0, 39), (29, 20), (15, 15), (3, 38)]:
        values = window_of(image, row, column, 4)[window_of(mask, row, column, 4)]
        assert mean[row, column] == pytest.approx(values.mean(), abs=1e-9)
        assert deviation[row, column] == pytest.approx(values.std(), abs=1e-6)


def test_a_window_without_pixels_has_no_statistics() -> None:
    mean, deviation = local_statistics(np.full((20, 20), 7.0), 5, np.zeros((20, 20)))
    assert not mean.any() and not deviation.any()


def test_wallis_brings_mean_and_contrast_to_the_targets() -> None:
    rng = np.random.default_rng(1)
    ramp = np.linspace(20, 200, 120)[None, :]
    image = ramp + rng.normal(0, 1, (100, 120)) * np.linspace(2, 30, 100)[:, None]
    out = wallis(image, WallisSettings(window=21, contrast=1.0))
    mean, deviation = local_statistics(out, 21)
    assert mean.mean() == pytest.approx(127, abs=3)
    assert deviation.mean() == pytest.approx(50, rel=0.25)
    m, s = local_statistics(image, 21)
    np.testing.assert_allclose(out, (image - m) * 50 / s + 127, atol=1e-3)
    soft = wallis(image, WallisSettings(window=21, contrast=0.5))
    assert local_statistics(soft, 21)[1].mean() < deviation.mean()
    kept = wallis(image, WallisSettings(window=21, brightness=0.0, contrast=1.0))
    assert np.corrcoef(local_statistics(kept, 21)[0].ravel(), local_statistics(image, 21)[0].ravel())[0, 1] > 0.9


def test_wallis_of_a_flat_image_is_flat() -> None:
    assert np.ptp(wallis(np.full((50, 60), 90, np.uint8))) < 1e-3


def test_foerstner_agrees_with_its_definition() -> None:
    image = np.random.default_rng(2).uniform(0, 255, (24, 30))
    w, q = foerstner(image, 5)
    gx, gy = np.zeros_like(image), np.zeros_like(image)
    gx[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    gy[1:-1] = (image[2:] - image[:-2]) / 2
    for row, column in [(12, 15), (4, 6), (0, 0)]:
        x, y = (window_of(g, row, column, 2).ravel() for g in (gx, gy))
        N = np.array([[x @ x, x @ y], [x @ y, y @ y]])
        assert w[row, column] == pytest.approx(np.linalg.det(N) / np.trace(N))
        assert q[row, column] == pytest.approx(4 * np.linalg.det(N) / np.trace(N) ** 2)


def test_corners_are_found_and_edges_are_not() -> None:
    image = np.zeros((80, 100))
    image[30:60, 40:80] = 200
    settings = SeedSettings(window=5, minimum_weight=0.0, minimum_roundness=0.5, cell=10)
    points = interest_points(image, settings=settings).pixels
    corners = np.array([[40, 30], [80, 30], [40, 60], [80, 60]])
    distance = np.linalg.norm(points[:, None] - corners[None], axis=2)
    assert len(points) == 4
    assert distance.min(axis=0).max() < 3
    assert len(interest_points(image, np.zeros_like(image)).pixels) == 0
    mask = np.zeros_like(image)
    mask[:, :60] = 1
    assert interest_points(image, mask, settings).pixels[:, 0].max() < 60


def test_interest_points_keep_their_distance_and_limit() -> None:
    image = np.random.default_rng(3).uniform(0, 255, (120, 160))
    found = interest_points(image, settings=SeedSettings(minimum_weight=0.5, minimum_roundness=0.5, cell=12, limit=40))
    assert len(found.pixels) == 40
    assert (np.diff(found.weight) <= 0).all()
    apart = np.linalg.norm(found.pixels[:, None] - found.pixels[None], axis=2) + 99 * np.eye(40)
    assert apart.min() >= 6
