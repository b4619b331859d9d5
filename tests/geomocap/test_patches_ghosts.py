"""Parts of a hull behind which there are others."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_fill_holes

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


def _with_arrays(surface: np.ndarray, points: np.ndarray, center: np.ndarray) -> np.ndarray:
    """What `nothing_behind` says for one camera, written with whole arrays: never inside after four steps outside."""
    origin = surface.min(axis=0) - 1.5 * VOXEL
    indices = np.floor((surface - origin) / VOXEL).astype(int)
    filled = np.zeros(indices.max(axis=0) + 2, bool)
    filled[tuple(indices.T)] = True
    filled = binary_fill_holes(filled)
    steps = 0.7 * VOXEL * np.arange(int(np.ceil(np.linalg.norm(filled.shape) / 0.7)))
    direction = points - center
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    at = np.floor((points[:, None] + steps[:, None] * direction[:, None] - origin) / VOXEL).astype(int)
    inside = filled[tuple(at.clip(0, np.array(filled.shape) - 1).transpose(2, 0, 1))]
    windows = np.lib.stride_tricks.sliding_window_view(inside[:, :-1], 4, axis=1)
    return ~(inside[:, 4:] & ~windows.any(axis=2)).any(axis=1)


def test_rays_are_walked_as_with_whole_arrays():
    rng = np.random.default_rng(2)
    middles = np.array([[0.4, 0, 0], [-0.3, 0.1, 0], [0, -0.2, 0.4]])
    surface = np.concatenate([_shell(middle, 0.15) for middle in middles])
    centers = 5 * middles[[0, 0, 1, 2]] - 4 * middles[[1, 2, 2, 0]]  # each sees one ball before another
    view = replace(MovingEllipsoid(n_cameras=4).view(0), surface=surface, voxel_size=VOXEL, centers=centers)
    points = surface + rng.normal(scale=0.2 * VOXEL, size=surface.shape)
    found = nothing_behind(view, points)
    assert 0.05 < found.mean() < 0.95
    for c, center in enumerate(centers):
        np.testing.assert_array_equal(found[:, c], _with_arrays(surface, points, center))
