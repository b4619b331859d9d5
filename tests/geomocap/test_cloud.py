"""Surface measurement of a textured ball: precision, completeness, bad input, all around."""

from __future__ import annotations

import cv2
import numba
import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from geomocap.cameras import Rig
from geomocap.cloud import CloudFrame, CloudSettings, cloud_of_frame, match_groups
from geomocap.cloud.bounds import hull_depth, inside_silhouettes
from geomocap.cloud.groups import scene_center
from geomocap.cloud.settings import GroupSettings
from geomocap.errors import CalibrationError, GeometryError
from geomocap.geometry import Voxels
from tests.geomocap.ball import RADIUS, Texture, cosines, off_surface, photograph, ring, surface_points

SETTINGS = CloudSettings.model_validate({"growing": {"step": 3.0, "radius": 4}})
TRIPLET = ring(3, 40)
PIXEL = 1.6 / 420
"""Size of a pixel on the ball, metres."""


def measure(rig: Rig, images, masks, settings: CloudSettings = SETTINGS, hull: Voxels | None = None) -> CloudFrame:
    return cloud_of_frame(images, masks, hull, rig, match_groups(rig, settings.groups), settings)


@pytest.fixture(scope="module")
def sharp() -> CloudFrame:
    """The ball as it should be."""
    return measure(TRIPLET, *photograph(TRIPLET, Texture.random()))


def completeness(frame: CloudFrame, rig: Rig, least_cosine: float = 0.5) -> float:
    """Share of the surface that all cameras see not too much at a slant with a point near."""
    points = surface_points()
    seen = points[(cosines(rig, points) > least_cosine).all(axis=0)]
    return float(np.mean(cKDTree(frame.points.positions).query(seen)[0] < 4 * PIXEL))


def test_precision_and_completeness(sharp: CloudFrame) -> None:
    error = off_surface(sharp.points.positions)
    assert np.median(error) < 2.0 / 2500
    assert np.mean(error < 5 * 2.0 / 2500) > 0.99
    assert completeness(sharp, TRIPLET) > 0.95
    assert (sharp.points.views >= 2).all() and np.mean(sharp.points.views == 3) > 0.7


def test_predicted_sigma_fits_the_errors(sharp: CloudFrame) -> None:
    # Where the view is not at a slant the surface is plane enough for its bending not to show
    p = sharp.points
    radial = p.positions / np.linalg.norm(p.positions, axis=1, keepdims=True)
    front = (cosines(TRIPLET, RADIUS * radial) > 0.8).all(axis=0)
    # Bending moves all points alike; noise spreads them
    signed = np.linalg.norm(p.positions[front], axis=1) - RADIUS
    spread = 1.48 * np.median(np.abs(signed - np.median(signed)))
    assert 0.5 < spread / np.median(p.sigma[front]) < 2


def test_normals_colours_and_attributes(sharp: CloudFrame) -> None:
    p = sharp.points
    true = p.positions / np.linalg.norm(p.positions, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", p.normals, true), -1, 1)))
    assert np.median(angle) < 5
    grey = Texture.random().at(true * RADIUS)
    assert np.corrcoef(p.colors[:, 0], grey)[0, 1] > 0.9
    cloud = sharp.cloud
    assert isinstance(cloud, o3d.t.geometry.PointCloud)
    assert set(cloud.point) == {"positions", "normals", "colors", "sigma", "views", "correlation", "template"}
    assert (p.template == 1).all()
    assert sharp.reasons["matched"] == len(p)
    cells = sharp.templates[0].surface
    known = ("seed", "images disagree", "outside another silhouette", "matched in one")
    total = sum(n for reason, n in sharp.reasons.items() if not reason.startswith(known))
    assert total + sharp.reasons.get("outside another silhouette", 0) == len(cells.grid)


def test_paper_order_measures_the_same_surface(sharp: CloudFrame) -> None:
    settings = CloudSettings.model_validate({"growing": {"step": 3.0, "radius": 4, "order": "paper"}})
    paper = measure(TRIPLET, *photograph(TRIPLET, Texture.random()), settings)
    assert len(paper.points) > 0.9 * len(sharp.points)
    assert np.mean(off_surface(paper.points.positions) < 5 * 2.0 / 2500) > 0.99
    region = paper.templates[0].surface.region
    assert region.min() == 0 and region.max() == len(paper.templates[0].surface.seeds) - 1


def test_same_cloud_with_any_number_of_threads(sharp: CloudFrame) -> None:
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    again = measure(TRIPLET, *photograph(TRIPLET, Texture.random()))
    numba.set_num_threads(before)
    np.testing.assert_array_equal(again.points.positions, sharp.points.positions)
    np.testing.assert_array_equal(again.points.sigma, sharp.points.sigma)


def test_distorted_cameras_measure_as_well() -> None:
    rig = ring(3, 40, distortion=-0.12)
    frame = measure(rig, *photograph(rig, Texture.random()))
    assert np.median(off_surface(frame.points.positions)) < 2.0 / 2500
    assert completeness(frame, rig) > 0.9


def test_another_exposure_is_taken(sharp: CloudFrame) -> None:
    images, masks = photograph(TRIPLET, Texture.random(), gains=np.array([0.6, 1.0, 1.25]))
    frame = measure(TRIPLET, images, masks)
    assert len(frame.points) > 0.9 * len(sharp.points)
    assert np.mean(off_surface(frame.points.positions) < 5 * 2.0 / 2500) > 0.99


def bad_images(kind: str):
    images, masks = photograph(TRIPLET, Texture.random(contrast=1.5 if kind == "low texture" else 40))
    if kind == "repetitive":
        images, masks = photograph(TRIPLET, Texture.stripes())
    if kind == "out of focus":
        images[2] = cv2.GaussianBlur(images[2], (0, 0), 3.0)
    return images, masks


@pytest.mark.parametrize("kind", ["low texture", "repetitive", "out of focus"])
def test_bad_images_give_fewer_points_not_wrong_ones(sharp: CloudFrame, kind: str) -> None:
    frame = measure(TRIPLET, *bad_images(kind))
    assert len(frame.points) < 1.02 * len(sharp.points)
    # No more wrong points than one in a hundred of what the ball gives
    assert np.sum(off_surface(frame.points.positions) > 0.02) < 0.01 * len(sharp.points)
    assert sum(frame.reasons.values()) > len(frame.points)


def test_wrong_calibration_gives_next_to_nothing(sharp: CloudFrame) -> None:
    images, masks = photograph(TRIPLET, Texture.random())
    poses = np.array(TRIPLET.cam_from_world)
    poses[[0, 2]] = poses[[2, 0]]
    frame = measure(Rig(TRIPLET.names, TRIPLET.cameras, poses), images, masks)
    assert len(frame.points) < 0.03 * len(sharp.points)


def test_black_images_give_an_empty_cloud() -> None:
    images, masks = photograph(TRIPLET, Texture.random())
    frame = measure(TRIPLET, [0 * i for i in images], masks)
    assert len(frame.points) == 0 and len(frame.cloud.point.positions) == 0
    none = measure(TRIPLET, images, [0 * m for m in masks])
    assert len(none.points) == 0


def test_images_have_to_fit_the_cameras() -> None:
    images, masks = photograph(TRIPLET, Texture.random())
    with pytest.raises(GeometryError, match="cam1"):
        measure(TRIPLET, [images[0], images[1][:50], images[2]], None)
    with pytest.raises(GeometryError, match="2 images"):
        measure(TRIPLET, images[:2], None)
    with pytest.raises(GeometryError, match="cam0"):
        measure(TRIPLET, images, [masks[0][:5], *masks[1:]])


def test_all_around_is_one_closed_surface_without_double_layers() -> None:
    rig = ring(8, 360)
    images, masks = photograph(rig, Texture.random())
    frame = measure(rig, images, masks, CloudSettings.model_validate({"growing": {"step": 5.0, "radius": 4}}))
    before = sum(len(t.points) for t in frame.templates)
    assert len(frame.templates) == 8
    assert len(frame.points) < 0.75 * before
    error = off_surface(frame.points.positions)
    assert np.mean(error < 5 * 2.0 / 2500) > 0.99
    # All that two cameras see well is there
    points = surface_points()
    seen = points[np.sort(cosines(rig, points), axis=0)[-2] > 0.6]
    tree = cKDTree(frame.points.positions)
    assert np.mean(tree.query(seen)[0] < 6 * PIXEL) > 0.9
    # Where templates meet, their points stand beside and not behind each other
    spacing = np.median(tree.query(frame.points.positions, 2)[0][:, 1])
    crowd = np.array([len(n) for n in tree.query_ball_point(frame.points.positions, 1.5 * spacing)])
    assert np.mean(crowd > 2.2 * np.median(crowd)) < 0.02


def test_hull_bounds_the_search() -> None:
    rig = TRIPLET
    images, _ = photograph(rig, Texture.random())
    size = 0.02
    low = np.full(3, -0.6)
    grid = np.stack(np.meshgrid(*[np.arange(60)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.linalg.norm(low + (grid + 0.5) * size, axis=1)
    hull = Voxels(grid[np.abs(away - RADIUS - 0.01) < size], np.zeros((0, 3), np.uint8), low, size)
    depth = hull_depth(rig, 1, (160, 200), hull)
    assert depth[112, 144] == pytest.approx(2.0 - RADIUS, abs=0.04)
    assert np.isinf(depth[2, 2])
    frame = measure(rig, images, None, hull=hull)
    assert np.mean(off_surface(frame.points.positions) < 5 * 2.0 / 2500) > 0.98
    assert len(frame.points) > 1000


def test_silhouettes_judge_points() -> None:
    _, masks = photograph(TRIPLET, Texture.random())
    points = np.array([[0, 0, 0.0], [0, 0, RADIUS + 0.03], [50.0, 0, 0]])
    assert inside_silhouettes(TRIPLET, masks, points, 2).tolist() == [True, False, True]


def test_groups_take_neighbours_on_both_sides() -> None:
    eight = match_groups(ring(8, 360)).groups
    assert [g.template for g in eight] == list(range(8))
    assert all(sorted(g.searches.tolist()) == sorted([(g.template - 1) % 8, (g.template + 1) % 8]) for g in eight)
    three = match_groups(TRIPLET).groups
    assert [(g.template, sorted(g.searches.tolist())) for g in three] == [(1, [0, 2])]
    named = match_groups(TRIPLET, GroupSettings(template_camera="cam2")).groups
    assert [g.template for g in named] == [2]
    assert len(match_groups(TRIPLET, GroupSettings(templates="all")).groups) == 3
    np.testing.assert_allclose(scene_center(ring(6, 360)), 0, atol=1e-3)


def test_groups_that_can_t_be() -> None:
    with pytest.raises(CalibrationError, match="no two cameras"):
        match_groups(ring(2, 180))
    with pytest.raises(CalibrationError, match="camX"):
        match_groups(TRIPLET, GroupSettings(template_camera="camX"))
