from __future__ import annotations

import cv2
import numpy as np
import pytest

from data_tools.plates import compose_plate, register, warp
from geomocap.errors import CaptureError

W, H = 240, 180


def room(rng: np.random.Generator) -> np.ndarray:
    """A cluttered room: boxes of different colours with a fine texture, (H, W, 3) float32, larger than the view."""
    image = np.full((H + 40, W + 40, 3), 120, np.float32)
    for _ in range(90):
        x, y, w, h = rng.integers(0, W), rng.integers(0, H), rng.integers(8, 50), rng.integers(8, 50)
        image[y : y + h, x : x + w] = rng.uniform(40, 210, 3)
    texture = cv2.GaussianBlur(rng.normal(0, 18, image.shape).astype(np.float32), (0, 0), 0.8)
    return cv2.GaussianBlur(image + texture, (0, 0), 0.6)


def person(image: np.ndarray, x: int, y: int, rng: np.random.Generator) -> np.ndarray:
    """Paint a standing figure; returns where it is."""
    where = np.zeros(image.shape[:2], np.uint8)
    cv2.ellipse(where, (x, y), (14, 40), 0, 0, 360, 1, -1)
    cv2.circle(where, (x, y - 48), 10, 1, -1)
    cloth = np.array([225, 40, 60]) + rng.normal(0, 12, image.shape)
    image[where > 0] = cloth[where > 0]
    return where > 0


@pytest.fixture(scope="module")
def recording() -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Video of a figure that sways in place, reference (scaled, darker) with it at the side, true room, true affine."""
    rng = np.random.default_rng(11)
    scene = room(rng)[20 : 20 + H, 20 : 20 + W]
    frames = []
    for k in range(16):
        image = scene.copy()
        person(image, 90 + int(14 * np.sin(k)), 100, rng)
        frames.append(np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8))
    affine = np.array([[0.98, 0, 1.5], [0, 0.98, 2.5]])  # video from reference
    elsewhere = scene.copy()
    person(elsewhere, 190, 110, rng)
    inverse = cv2.invertAffineTransform(affine)
    seen = cv2.warpAffine(elsewhere, inverse, (W, H), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    reference = np.clip(0.85 * seen + 4 + rng.normal(0, 1.5, seen.shape), 0, 255).astype(np.uint8)
    return frames, reference, scene, affine


def test_plate_is_the_empty_room(recording: tuple) -> None:
    frames, reference, scene, _ = recording
    plate, known = compose_plate(frames, reference)
    assert plate.shape == (H, W, 3) and plate.dtype == np.uint8 and known.dtype == bool
    error = np.abs(plate.astype(float) - scene).max(axis=-1)
    assert known.mean() > 0.97
    assert (error[known] < 25).mean() > 0.985
    middle = np.s_[80:130, 85:95]  # never seen in the video
    assert known[middle].mean() > 0.9 and np.median(error[middle]) < 8
    aside = np.s_[80:140, 182:198]  # hidden in the reference
    assert known[aside].mean() > 0.9 and np.median(error[aside]) < 3


def test_what_neither_shows_is_unknown(recording: tuple) -> None:
    frames, _, scene, _ = recording
    rng = np.random.default_rng(3)
    reference = scene.copy()
    person(reference, 112, 100, rng)  # partly where the video's figure always is
    plate, known = compose_plate(frames, np.clip(reference, 0, 255).astype(np.uint8))
    hidden = np.zeros((H, W), bool)
    hidden[80:120, 100:103] = True  # in both at all times
    red = (plate[..., 0] > 180) & (plate[..., 1] < 90) & (scene[..., 1] > 110)
    assert not known[hidden].all()
    assert (red & known).mean() < 0.01


def test_registration_finds_size_and_offset(recording: tuple) -> None:
    frames, reference, _, affine = recording
    found = register(reference, frames[0])
    corners = np.array([[0, 0, 1], [W, 0, 1], [0, H, 1], [W, H, 1]]).T
    np.testing.assert_allclose(found @ corners, affine @ corners, atol=0.5)
    moved, inside = warp(reference, found, (W, H))
    assert moved.shape == (H, W, 3) and not inside.all() and inside[H // 2, W // 2]


def test_another_view_is_refused(recording: tuple) -> None:
    frames, *_ = recording
    other = np.clip(room(np.random.default_rng(99)), 0, 255).astype(np.uint8)
    with pytest.raises(CaptureError, match="points agree with the video"):
        compose_plate(frames, other)
    with pytest.raises(CaptureError, match="at least 3"):
        compose_plate(frames[:2], other)
