"""Bodies that carry a surface as it moves agree with it; others don't."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.evaluation.surface_agreement import surface_disagreement

FRAMES, REACH = 4, 0.1
ROTATIONS = np.stack(
    [
        np.tile(np.eye(3), (FRAMES, 1, 1)),
        Rotation.from_euler("z", 20.0 * np.arange(FRAMES)[:, None], degrees=True).as_matrix(),
    ],
    axis=1,
)
STILL = np.zeros((FRAMES, 2, 3))


def rods(frame: int) -> np.ndarray:
    """A rod along −x that is still, and one along x that turns about z at the origin, (400, 3)."""
    rng = np.random.default_rng(frame)
    rod = np.column_stack([rng.random(200), 0.02 * rng.normal(size=(200, 2))])
    return np.concatenate([rod * [-1, 1, 1], rod @ ROTATIONS[frame, 1].T])


def by_rod(frame: int, points: np.ndarray) -> np.ndarray:
    return np.repeat([0, 1], 200)


def test_right_motions_agree_within_the_points_spacing():
    assert surface_disagreement(rods, by_rod, ROTATIONS, STILL, range(FRAMES), REACH) < 0.03


@pytest.mark.parametrize(
    "label",
    [lambda k, p: np.zeros(len(p), int), lambda k, p: 1 - by_rod(k, p), lambda k, p: by_rod(k, p) - 1],
    ids=["one body", "exchanged", "a part without body"],
)
def test_wrong_bodies_disagree(label):
    right = surface_disagreement(rods, by_rod, ROTATIONS, STILL, range(FRAMES), REACH)
    assert surface_disagreement(rods, label, ROTATIONS, STILL, range(FRAMES), REACH) > 1.4 * right


def test_without_bodies_all_of_the_reach_is_missed():
    none = surface_disagreement(rods, lambda k, p: np.full(len(p), -1), ROTATIONS, STILL, range(FRAMES), REACH)
    assert none == pytest.approx(REACH)
