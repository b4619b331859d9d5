"""Colours of bodies."""

from __future__ import annotations

import numpy as np

from viz import body_colors as palette

DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
LMS = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def oklab(colors: np.ndarray, ray: np.ndarray) -> np.ndarray:
    c = np.asarray(colors) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.cbrt(np.clip(linear @ ray.T, 0, 1) @ LMS.T) @ LAB.T


def test_colors_stay_what_they_are() -> None:
    assert [palette.hex_color(palette.body_color(b)) for b in range(4)] == ["#0072b2", "#e68214", "#960f2d", "#b4e178"]
    assert palette.body_color(-1) == palette.UNASSIGNED


def test_first_twelve_are_told_apart_by_normal_and_by_red_green_blind_sight() -> None:
    colors = np.array([palette.UNASSIGNED, *(palette.body_color(b) for b in range(12))])
    for ray in (np.eye(3), DEUTERANOPIA):
        lab = oklab(colors, ray)
        distance = np.linalg.norm(lab[:, None] - lab[None], axis=2) + np.eye(13)
        assert distance.min() > 0.07


def test_a_hundred_bodies_have_different_colors() -> None:
    colors = palette.body_colors(np.arange(100))
    assert len(np.unique(colors, axis=0)) == 100


def test_array_and_single_colors_agree() -> None:
    bodies = np.array([3, -1, 30, 0, -7])
    expected = [palette.body_color(int(b)) for b in bodies]
    assert palette.body_colors(bodies).tolist() == [list(c) for c in expected]
    assert palette.body_colors(np.array([], int)).shape == (0, 3)
