"""The renderer against analytic projections and compositing."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geomocap.model.ray_casting import touched_pixels
from geomocap.model.rig import Rig
from viz.ray_kernels import shade
from viz.rendering import Layer, Look, Model, render
from viz.shapes import EMPTY, ball, ellipsoid, tube
from viz.viewpoints import CameraView, PinholeView, ViewStage, camera_view, look, stage_of, window_around

UP = np.array([0.0, 0.0, 1.0])
PLAIN = Look(samples=4, outline=0, hollows=0)


def rig(params: list[float] | None = None) -> Rig:
    model = "OPENCV" if params else "PINHOLE"
    values = [150.0, 150.0, 61.5, 42.0, *(params or [])]
    camera = pycolmap.Camera(model=model, width=120, height=90, params=values)
    return Rig(("a",), (camera,), look(np.array([3.0, -0.5, 1.2]), np.array([0, 0, 1.0]), UP)[None])


def cone_mask(view: CameraView, center: np.ndarray, radius: float) -> np.ndarray:
    """Fraction of each pixel whose rays meet a sphere, from 8 × 8 rays a pixel."""
    width, height = view.size
    s = 8
    grid = np.stack(np.meshgrid((np.arange(width * s) + 0.5) / s, (np.arange(height * s) + 0.5) / s), axis=-1)
    origin, directions = view.rays(grid.reshape(-1, 2))
    to = center - origin
    along = directions @ to
    met = (to @ to - along**2 < radius**2).astype(float)
    return met.reshape(height, s, width, s).mean(axis=(1, 3))


@pytest.mark.parametrize("params", [None, [-0.25, 0.08, 0.002, -0.001]])
@pytest.mark.parametrize("size", [(120, 90), (60, 45)])
def test_sphere_covers_its_analytic_projection(params: list[float] | None, size: tuple[int, int]) -> None:
    view = CameraView(rig(params), 0, size, (0, 0, 120, 90))
    center, radius = np.array([0.1, 0.15, 1.05]), 0.35
    seen = render([ball(center, radius, (200, 0, 0), level=24)], view, PLAIN).rgba[..., 3]
    expected = cone_mask(view, center, radius)
    assert abs(seen.sum() - expected.sum()) < 0.005 * expected.sum()
    assert np.abs(seen - expected).max() < 0.35  # of a pixel
    y, x = np.mgrid[: size[1], : size[0]]
    for coordinate in (x, y):  # a shift by half a pixel would show here
        shift = (seen * coordinate).sum() / seen.sum() - (expected * coordinate).sum() / expected.sum()
        assert abs(shift) < 0.02


def test_point_projects_where_its_ray_comes_from() -> None:
    view = camera_view(rig([-0.2, 0.05, 0, 0]), 0, 60)
    assert view.size == (60, 45)
    pixels = np.array([[10.0, 8.0], [30.5, 22.5], [55.0, 40.0]])
    origin, directions = view.rays(pixels)
    back, depth = view.project(origin + 2.5 * directions)
    np.testing.assert_allclose(back, pixels, atol=1e-6)
    assert (depth > 0).all()


def test_a_part_of_a_view_is_cut_out_of_the_whole() -> None:
    cameras = rig([-0.2, 0.05, 0, 0])
    whole = camera_view(cameras, 0)
    points = np.array([[0.05, 0.1, 1.05], [0.15, 0.2, 1.0]])
    part = camera_view(cameras, 0, 240, around=points)
    left, top, width, height = part.window
    assert width < whole.size[0] / 2 and part.size == (4 * width, 4 * height)  # enlarged, and no more
    expected = (whole.project(points)[0] - [left, top]) * 4.0
    np.testing.assert_allclose(part.project(points)[0], expected, atol=1e-9)
    pixels = np.array([[3.0, 5.0], [20.0, 30.0]])
    origin, directions = part.rays(pixels)
    np.testing.assert_allclose(part.project(origin + 2.0 * directions)[0], pixels, atol=1e-6)
    image = np.arange(whole.size[0] * whole.size[1]).reshape(whole.size[::-1])
    assert part.part_of(image).shape == (height, width) and part.part_of(image)[0, 0] == top * whole.size[0] + left


def test_windows_keep_the_proportions_and_stay_in_the_image() -> None:
    size = (400, 300)
    assert window_around(np.array([[10.0, 20.0], [390.0, 40.0]]), size) == (0, 0, 400, 300)  # hardly less
    assert window_around(np.zeros((0, 2)), size) == window_around(np.full((3, 2), np.nan), size) == (0, 0, 400, 300)
    left, top, width, height = window_around(np.array([[0.0, 290.0], [40.0, 300.0]]), size)
    assert (left, top + height) == (0, 300) and width == 60 and height == 45
    beside = np.array([[-50.0, 10.0], [100.0, 100.0], [100.0, 100.0]])  # the first isn't in the image
    assert window_around(beside, size)[2:] == (40, 30)


def test_nearer_surface_hides_the_one_behind() -> None:
    view = camera_view(rig(), 0)
    near, far = ball([0.6, 0, 1], 0.2, (250, 0, 0)), ball([-0.6, 0.1, 1], 0.4, (0, 0, 250))
    for meshes in ([near, far], [far, near]):
        image = render(meshes, view, PLAIN).over((255, 255, 255))
        (x, y), *_ = view.project(np.array([[0.6, 0, 1.0]]))[0]
        r, _, b = image[int(y), int(x)].astype(int)
        assert r > b + 60


def test_translucent_layers_composite_front_to_back() -> None:
    view = camera_view(rig(), 0)
    glass = ball([0, 0, 1], 0.3, (0, 200, 0), level=10).translucent(0.5, rim=0.0)
    (x, y), *_ = (int(v) for v in view.project(np.array([[0, 0, 1.0]]))[0][0]), 0
    two = render([glass], view, Look(samples=2, layers=2)).rgba[y, x, 3]
    one = render([glass], view, Look(samples=2, layers=1)).rgba[y, x, 3]
    assert one == pytest.approx(0.5, abs=1e-3)
    assert two == pytest.approx(0.75, abs=1e-3)
    core = ball([0, 0, 1], 0.1, (200, 0, 0), level=6)
    filled = render([glass, core], view, Look(samples=2, layers=2, outline=0, hollows=0)).rgba[y, x]
    assert filled[3] == pytest.approx(1.0, abs=1e-3)
    alone = render([core], view, PLAIN).rgba[y, x, 0]
    assert filled[0] == pytest.approx(0.5 * alone, abs=0.06)  # half of the red core shines through one layer


def test_layer_over_photograph() -> None:
    rgba = np.zeros((2, 2, 4), np.float32)
    rgba[0, 0] = [0.5, 0, 0, 0.5]
    photograph = np.full((2, 2, 3), 100, np.uint8)
    image = Layer(rgba).over(photograph)
    assert image[0, 0].tolist() == [178, 50, 50]
    assert image[1, 1].tolist() == [100, 100, 100]
    assert Layer(rgba).over(photograph, opacity=0)[0, 0].tolist() == [100, 100, 100]


def test_rendering_repeats_to_the_bit() -> None:
    view = camera_view(rig(), 0)
    meshes = [
        ball([0, 0, 1], 0.3, (9, 200, 9)).translucent(0.3),
        ellipsoid([0, 0, 1], [0.1, 0.2, 0.05], np.eye(3), (9, 9, 99)),
    ]
    assert np.array_equal(render(meshes, view).rgba, render(meshes, view).rgba)


def test_nothing_and_out_of_sight_give_an_empty_layer() -> None:
    view = camera_view(rig(), 0)
    for meshes in ([], [EMPTY], [ball([0, 50, 1], 0.1, (1, 2, 3))]):
        assert not render(meshes, view).rgba.any()


def test_something_behind_the_view_does_not_hide_what_is_in_front() -> None:
    view = camera_view(rig(), 0)
    through = tube(np.array([[6.0, -1.2, 1.2], [-3.0, 0.6, 0.9]]), 0.02, (1, 2, 3))
    assert render([through, ball([0, 0, 1], 0.2, (200, 0, 0))], view).rgba[..., 3].sum() > 50


@settings(max_examples=25, deadline=None)
@given(azimuth=st.floats(-180, 180), elevation=st.floats(-80, 89), seed=st.integers(0, 99), wide=st.booleans())
def test_free_views_take_in_everything(azimuth: float, elevation: float, seed: int, wide: bool) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(200, 3)) * ([2, 0.5, 1] if wide else [0.2, 0.3, 1.5])
    stage = ViewStage(points, np.array([[5.0, -3.0, 1.0]]), UP, np.array([1.0, 0, 0]), 0.0)
    view = stage.view(azimuth, elevation, (200, 150))
    pixels, depth = view.project(points + stage.centers[0])
    assert (depth > 0).all()
    assert (pixels > 0).all() and (pixels < [200, 150]).all()
    assert np.ptp(pixels, axis=0).max() > 90  # and not from too far away


def test_views_stand_still_on_the_spot_and_follow_a_traveller() -> None:
    rng = np.random.default_rng(0)
    body = rng.normal(size=(500, 3)) * 0.2
    on_the_spot = stage_of([body, body + 0.05], [0, 9], 10, UP)
    assert np.ptp(on_the_spot.centers, axis=0).max() == 0
    walking = stage_of([body + np.array([0.0, t, 0]) for t in range(0, 10, 3)], [0, 3, 6, 9], 10, UP)
    np.testing.assert_allclose(np.diff(walking.centers, axis=0), [[0, 1.0, 0]] * 9, atol=0.05)
    view = walking.view(0, 10, (100, 100))
    a = view.project(body)[0]
    b = walking.at(view, 9).project(body + np.array([0, 9.0, 0]))[0]
    assert np.abs(a - b).max() < 3


def test_pinhole_view_moves() -> None:
    view = PinholeView(
        (10, 10), np.array([[9.0, 0, 5], [0, 9, 5], [0, 0, 1]]), look(np.array([2.0, 0, 0]), np.zeros(3), UP)
    )
    point = np.array([[0.1, 0.2, -0.1]])
    offset = np.array([3.0, 2.0, 1.0])
    np.testing.assert_allclose(view.moved(offset).project(point + offset)[0], view.project(point)[0])


def test_model_looks_the_same_from_every_view_as_if_made_for_it() -> None:
    meshes = [ball([0, 0, 1], 0.3, (9, 200, 9)).translucent(0.3), ball([0, 0.1, 1], 0.1, (200, 0, 0))]
    model = Model(meshes)
    for size in (120, 60):
        view = camera_view(rig(), 0, size)
        assert np.array_equal(model.render(view).rgba, render(meshes, view).rgba)


def test_shading_kernel_agrees_with_numpy() -> None:
    rng = np.random.default_rng(0)

    def unit(count: int) -> np.ndarray:
        v = rng.normal(size=(count, 3))
        return v / np.linalg.norm(v, axis=1, keepdims=True)

    faces, normals, colors = rng.integers(0, 30, (40, 3)), unit(30), rng.random((40, 3))
    alpha, rim = rng.random(40), rng.random(40)
    triangle, directions, (key, above) = rng.integers(0, 40, 500), unit(500), unit(2)
    uv = rng.dirichlet(np.ones(3), 500)[:, :2]
    rgba = np.empty((500, 4))
    shade(triangle, uv, directions, faces, normals, colors, alpha, rim, key, above, rgba)

    n = np.einsum("nk,nki->ni", np.column_stack([1 - uv.sum(axis=1), uv]), normals[faces[triangle]])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n *= -np.sign((n * directions).sum(axis=1, keepdims=True))
    facing = -(n * directions).sum(axis=1)
    half = key - directions
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    light = 0.30 + 0.16 * (0.5 + 0.5 * n @ above) + 0.20 * facing + 0.44 * np.clip(n @ key, 0, 1)
    shine = np.clip((n * half).sum(axis=1), 0, 1) ** 40
    expected = np.clip(colors[triangle] * light[:, None] + 0.10 * shine[:, None], 0, 1)
    np.testing.assert_allclose(rgba[:, :3], expected, atol=1e-12)
    np.testing.assert_allclose(rgba[:, 3], np.clip(alpha[triangle] + rim[triangle] * (1 - facing) ** 2, 0, 1))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 999), spread=st.floats(1, 300))
def test_marked_tiles_are_those_that_boxes_meet(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    pixels, faces = rng.uniform(-60, 160, (1, 2)) + rng.normal(size=(20, 2)) * spread, rng.integers(0, 20, (15, 3))
    rows, columns, tile = 18, 24, 4
    tiles = touched_pixels(pixels, faces, columns * tile - 2, rows * tile - 1)[::tile, ::tile]
    low, high = pixels[faces].min(axis=1), pixels[faces].max(axis=1)
    margin = 1.5 + 0.03 * (high - low).max(axis=1, keepdims=True)
    low, high = low - margin, high + margin
    left, top = np.arange(columns) * tile, np.arange(rows) * tile
    across = (low[:, :1] < left + tile) & (high[:, :1] >= left)
    down = (low[:, 1:] < top + tile) & (high[:, 1:] >= top)
    np.testing.assert_array_equal(tiles, (down[:, :, None] & across[:, None, :]).any(axis=0))


def test_a_model_of_recoloured_meshes_looks_the_same_whether_they_are_sorted_again_or_not() -> None:
    view = camera_view(rig(), 0, 60)
    skin = ball(np.array([0.0, 0.0, 1.0]), 0.4, (200, 0, 0))
    bones = [ball(np.array([0.1, 0.0, 1.0]), 0.2, (0, 200, 0)), tube(np.array([np.zeros(3), UP]), 0.05, (0, 0, 200))]
    meshes = [skin.recolored((90, 90, 90)).translucent(0.2), *bones]
    again = Model(meshes, like=Model([skin]))
    assert np.array_equal(again.render(view).rgba, Model(meshes).render(view).rgba)
