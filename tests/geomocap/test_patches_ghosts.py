"""Parts of a hull behind which there are others."""

from dataclasses import replace

import numpy as np

from geomocap.patches.ghosts import nothing_behind
from tests.geomocap.moving_ellipsoid import MovingEllipsoid

VOXEL = 0.02


def _shell(center: tuple[float, float, float], radius: float) -> np.ndarray:
    steps = np.arange(-40, 41) * VOXEL
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.linalg.norm(grid - center, axis=1)
    return grid[(away <= radius) & (away > radius - 2 * VOXEL)]


def test_of_two_balls_only_the_one_behind_is_certain():
    front, behind = _shell((0.4, 0, 0), 0.15), _shell((-0.3, 0, 0), 0.15)
    view = MovingEllipsoid(n_cameras=2).view(0)
    centers = np.array([[5.0, 0, 0], [0, 5.0, 0]])  # before both, and beside them
    view = replace(view, surface=np.concatenate([front, behind]), voxel_size=VOXEL, centers=centers)
    middle = front[np.linalg.norm(front[:, 1:], axis=1) < 0.08]
    certain = nothing_behind(view, middle[middle[:, 0] > 0.4])
    assert not certain[:, 0].any()
    assert certain[:, 1].all()
    assert nothing_behind(view, behind).all()


def test_one_closed_surface_has_nothing_behind_and_an_open_one_too():
    view = replace(MovingEllipsoid(n_cameras=2).view(0), centers=np.array([[5.0, 0, 0], [0, 0, 5.0]]), voxel_size=VOXEL)
    ball = _shell((0, 0, 0), 0.3)
    assert nothing_behind(replace(view, surface=ball), ball).all()
    half = ball[ball[:, 0] > 0]
    seen = half[half[:, 0] > 0.15]
    assert nothing_behind(replace(view, surface=half), seen)[:, 0].all()
