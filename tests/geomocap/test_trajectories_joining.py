"""Broken trajectories of the same point are joined, those of different points are not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from geomocap.model.trajectories import Trajectories
from geomocap.trajectories.joining import join_broken

T = 20
TURN = Rotation.from_rotvec(np.outer(np.arange(T), [0.02, 0.05, -0.03])).as_matrix()
PLACE = np.outer(np.arange(T), [0.02, 0.0, 0.01])


def rigid(points, first, noise=0.0):
    """Points (N, 3) of a body that moves, turns counted from frame `first` (N,)."""
    points = np.asarray(points, float)
    N = len(points)
    positions = np.einsum("tij,nj->nti", TURN, points) + PLACE
    positions += np.random.default_rng(0).normal(0, 1, positions.shape) * noise
    rotations = np.stack([TURN @ TURN[f].T for f in first])
    flat = np.zeros(N, int)
    return Trajectories(
        positions,
        rotations,
        np.full((N, T), 0.0002),
        np.ones((N, T)),
        np.full((N, T), 3),
        np.zeros((N, T, 3)),
        np.tile([0.0, 0, 1], (N, 1)),
        np.asarray(first),
        flat,
        flat.copy(),
    )


def cut(tracks, *spans):
    """Leave each trajectory only its span of frames."""
    drop = np.ones((len(tracks), T), bool)
    for row, (low, high) in enumerate(spans):
        drop[row, low:high] = False
    tracks = tracks.select(np.arange(len(tracks)))
    tracks.clear(drop)
    return tracks


GRID = [[0.02 * i, 0.02 * j, 0.0] for i in range(4) for j in range(3)]


def test_two_parts_of_one_point_become_one():
    whole = rigid([*GRID, [0.003, 0.002, 0.0]], [0] * 12 + [9])
    spans = [(0, 12)] + [(0, T)] * 11 + [(8, T)]
    joined = join_broken(cut(whole, *spans))
    assert len(joined) == 12
    assert joined.measured.all()
    assert_allclose(joined.positions[0], whole.positions[0], atol=1e-9)
    assert_allclose(joined.rotations[0], whole.rotations[0], atol=1e-9)


def test_noise_is_stated():
    whole = rigid([*GRID, [0.003, 0.002, 0.0]], [0] * 13, noise=0.0002)
    joined = join_broken(cut(whole, (0, 15), *[(0, T)] * 11, (8, T)))
    true = rigid(GRID, [0] * 12).positions[0]
    assert len(joined) == 12
    error = np.linalg.norm(joined.positions[0] - true, axis=1)[15:]
    assert error.max() < 0.001
    assert (joined.sigma[0, 15:] > 0.00025).all() and (joined.sigma[0, :15] == 0.0002).all()


@pytest.mark.parametrize("reason", ["other motion", "far", "short"])
def test_others_stay_apart(reason):
    beside = {"other motion": [0.003, 0.002, 0], "far": [0.01, 0.012, 0.02], "short": [0.003, 0.002, 0]}[reason]
    tracks = rigid([*GRID, beside], [0] * 13)
    if reason == "other motion":
        tracks.positions[12] += np.outer(np.arange(T), [0, 0.001, 0])
    spans = [(0, 12)] + [(0, T)] * 11 + [(10 if reason == "short" else 4, T)]
    tracks = cut(tracks, *spans)
    assert len(join_broken(tracks)) == 13


def test_nothing_to_join():
    none = rigid(GRID, [0] * 12).select(np.zeros(12, bool))
    assert len(join_broken(none)) == 0
    one = rigid(GRID[:1], [0])
    assert len(join_broken(one)) == 1
