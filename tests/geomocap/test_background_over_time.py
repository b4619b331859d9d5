"""The background of recordings without an empty frame."""

from __future__ import annotations

import cv2
import numpy as np

from geomocap.silhouettes.background import agreement, model_from_frames
from geomocap.silhouettes.enclosed_regions import enclosed
from geomocap.silhouettes.recurrence import recurrences

W, H = 96, 72


def wall(rng: np.random.Generator) -> np.ndarray:
    """A textured wall, (H, W, 3), grey levels."""
    noise = cv2.GaussianBlur(rng.normal(size=(H, W, 3)), (0, 0), 1.5)
    return 120 + 25 * noise / noise.std()


def seen(background: np.ndarray, shapes: list[np.ndarray], color: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Frames (H, W, 3) uint8 of shapes (H, W) bool of one colour before a background, with noise."""
    pictures = [np.where(shape[..., None], color, background) for shape in shapes]
    return [np.rint(p + rng.normal(0, 1, p.shape)).clip(0, 255).astype(np.uint8) for p in pictures]


def disc(x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:H, :W]
    return (columns - x) ** 2 + (rows - y) ** 2 <= radius**2


def test_recurrences_are_those_of_whole_windows() -> None:
    rng = np.random.default_rng(2)
    stack = rng.integers(100, 112, (5, 70, 53, 3)).astype(np.uint8)
    light = np.full((5, 3), 1.0, np.float32), np.full((5, 3), 2.0, np.float32)
    found = recurrences(stack, *light, np.full((70, 53), 8, np.float32), 3, 0.75)

    def within(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values.astype(float), -1, (7, 7), normalize=False, borderType=cv2.BORDER_CONSTANT)

    expected = np.ones((5, 70, 53), int)
    for t in range(5):
        for u in range(t):
            close = np.abs(stack[t].astype(int) - stack[u]).max(axis=-1) <= 8
            again = within(close) >= 0.75 * within(np.ones((70, 53))) - 1e-9
            expected[[t, u]] += again
    assert 1.5 < expected.mean() < 4.5
    np.testing.assert_array_equal(found, expected)


def test_the_background_comes_back_with_its_surroundings_a_spotted_subject_does_not() -> None:
    rng = np.random.default_rng(3)
    background = wall(rng)
    spots = np.where(rng.random((H, W)) < 0.25, 150.0, 60.0)  # most of it of one colour, which most frames agree on
    frames = seen(background, [np.zeros((H, W), bool)] * 30, 0.0, rng)
    for k in range(22):  # it is elsewhere in 8 frames, and never twice in the same place
        place = disc(48 + (k % 5) - 2, 36 + (k // 5) - 2, 22)
        moved = np.roll(spots, (k // 5, k % 5), axis=(0, 1))[..., None] + rng.normal(0, 1, (H, W, 1))
        frames[k] = np.where(place[..., None], moved, frames[k]).astype(np.uint8)
    model = model_from_frames(frames)
    middle = disc(48, 36, 14)
    assert (np.abs(np.stack(frames)[:, middle] - 60.0).max(axis=-1) < 6).mean() > 0.5
    assert (np.abs(model.mean - background).max(axis=-1) < 12)[middle].mean() > 0.9


def test_the_middle_of_a_subject_that_stays_is_not_known() -> None:
    rng = np.random.default_rng(4)
    background = wall(rng)
    shapes = [disc(48 + 9 * np.sin(t), 36 + 9 * np.cos(1.7 * t), 20) for t in range(30)]
    model = model_from_frames(seen(background, shapes, 60.0, rng))
    always, never = np.all(shapes, axis=0), ~np.any(shapes, axis=0)
    assert not model.known[always].any()
    assert model.known[never].mean() > 0.99


def test_what_an_animal_runs_around_is_known() -> None:
    rng = np.random.default_rng(5)
    background = wall(rng)
    turns = 2 * np.pi * np.arange(30) / 30
    shapes = [disc(48 + 24 * np.cos(a), 36 + 24 * np.sin(a), 7) for a in turns]
    model = model_from_frames(seen(background, shapes, 60.0, rng))
    assert model.known.mean() > 0.99


def test_what_goes_on_to_the_border_is_not_enclosed() -> None:
    changed = np.zeros((10, H, W), np.uint8)
    changed[:6, 20:50, 20:24] = changed[:6, 20:50, 60:64] = 1
    changed[:6, 20:24, 20:64] = 1
    mean = np.full((H, W, 3), 100, np.float32)
    assert not enclosed(mean, changed).any()
    changed[:6, 46:50, 20:64] = 1
    assert enclosed(mean, changed)[26:44, 26:58].all()
    assert not enclosed(mean, changed)[:18].any()


def test_agreement_is_the_largest_group() -> None:
    rng = np.random.default_rng(4)
    stack = rng.integers(0, 256, (7, 6, 5, 3)).astype(np.uint8)
    stack[2:5] = stack[2] // 2 + rng.integers(0, 4, (3, 6, 5, 3)).astype(np.uint8)
    gains, offsets = np.full((7, 3), 1.1, np.float32), np.full((7, 3), 2.0, np.float32)
    reach = np.full((6, 5), 4.0, np.float32)
    mean, support = agreement(stack, gains, offsets, reach, np.ones((7, 6, 5), np.uint16), 2.0)
    values = (stack - 2.0) / 1.1
    close = (np.abs(values[:, None] - values[None]) <= 4).all(-1)  # (T, T, H, W)
    best = close.sum(axis=1).argmax(axis=0)
    group = np.take_along_axis(close, best[None, None], axis=0)[0]
    np.testing.assert_allclose(support, group.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(mean, (values * group[..., None]).sum(0) / group.sum(0)[..., None], atol=1e-3)


def test_a_place_mostly_in_shadow_is_taken_as_it_looks_lit() -> None:
    stack = np.full((10, 2, 2, 3), 120, np.uint8)
    stack[:7, :, 0] = 72
    light = np.ones((10, 3), np.float32), np.zeros((10, 3), np.float32)
    windows = np.ones((10, 2, 2), np.uint16)
    mean, support = agreement(stack, *light, np.full((2, 2), 4.0, np.float32), windows, 0.15)
    np.testing.assert_allclose(mean, 120)
    np.testing.assert_allclose(support, [[0.3, 1], [0.3, 1]])
