"""Bodies that turn nearly as one beside them does, which holds them by nothing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap import find_motion
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.model.motion_paths import MotionPaths

FRAMES = 40
TOP, FOOT = np.array([0.43, 0.0, -0.15]), np.array([0.37, 0.0, -0.22])


def shield(turn_deg: float, slide: float) -> tuple[np.ndarray, np.ndarray]:
    """Tracks and bodies of a ball, a small plate beside it, and an arm that swings the plate along the ball, metres."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(900, 3))
    ball = 0.4 * d / np.linalg.norm(d, axis=1, keepdims=True)
    plate = np.insert(0.15 * rng.uniform(-1, 1, (260, 2)), 0, 0.43, axis=1)
    along, around = rng.random((60, 1)), rng.uniform(0, 2 * np.pi, 60)
    ring = np.stack([0.7 * np.cos(around), np.sin(around), -0.7 * np.cos(around)], axis=1)
    arm = FOOT + along * (TOP - FOOT) + 0.025 * ring
    axis = np.cross(TOP - FOOT, [0.0, 1.0, 0.0])
    length = np.linalg.norm(axis)
    phase = 2 * np.pi * np.arange(FRAMES)[:, None] / 20
    swing = Rotation.from_rotvec(axis / length * np.arcsin(slide / length) * np.cos(phase)).as_matrix()
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.sin(phase) * [1.0, 0.0, 0.0]).as_matrix()
    tip = FOOT + swing @ (TOP - FOOT)
    tracks = np.concatenate(
        [
            np.tile(ball[:, None], (1, FRAMES, 1)),
            tip + np.einsum("tij,nj->nti", turn, plate - TOP),
            FOOT + np.einsum("tij,nj->nti", swing, arm - FOOT),
        ]
    )
    return tracks + rng.normal(0, 0.0005, tracks.shape), np.repeat([0, 1, 2], [900, 260, 60])


@pytest.mark.parametrize(("slide", "bodies"), [(0.03, 3), (0.01, 1)])
def test_what_slides_along_a_larger_body_is_one_of_its_own(slide, bodies):
    tracks, body = shield(turn_deg=12.0 if bodies == 3 else 8.0, slide=slide)
    found = find_motion_bodies(MotionPaths(tracks))
    assert found.body_count == bodies
    assert len({(one, other) for one, other in zip(body, found.label, strict=True)}) == 3  # none is torn


def test_tracks_may_lie_on_one_another():
    tracks, body = shield(turn_deg=30.0, slide=0.05)
    twice = np.repeat(tracks, 2, axis=0)
    motion = find_motion(twice, fps=30)
    assert motion.body_count == 3
    labels = motion.label(0, tracks[:, 0])
    assert all(len(np.unique(labels[body == b])) == 1 for b in range(3))
