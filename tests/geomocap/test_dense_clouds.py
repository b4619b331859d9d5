"""Surface measurement of a textured ball: precision, completeness, bad input, all around."""

from __future__ import annotations

import cv2
import numba
import numpy as np
import open3d as o3d
import pycolmap
import pytest
from scipy.spatial import cKDTree

from geomocap.dense.dense_frame import CloudFrame, cloud_of_frame
from geomocap.dense.dense_settings import CloudSettings, GroupSettings, TrustSettings
from geomocap.dense.match_evidence import MatchEvidence
from geomocap.dense.match_groups import match_groups, scene_center, too_far_apart
from geomocap.dense.search_bounds import box_depth, hull_depth, inside_silhouettes
from geomocap.errors import CalibrationError, GeometryError
from geomocap.model.frame_geometry import Voxels
from geomocap.model.rig import Rig
from tests.geomocap.ball import (
    HEIGHT,
    RADIUS,
    WIDTH,
    Texture,
    cosines,
    off_surface,
    photograph,
    ring,
    surface_points,
)

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
    """Fraction of the surface that all cameras see not too much at a slant with a point near."""
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
    center, meet = scene_center(ring(6, 360))
    np.testing.assert_allclose(center, 0, atol=1e-3)
    assert meet


def test_groups_that_can_t_be() -> None:
    with pytest.raises(CalibrationError, match=r"by 180°, .* 6° to 60°; enlarge cloud\.groups\.greatest_angle or"):
        match_groups(ring(2, 180))
    with pytest.raises(CalibrationError, match=r"by \d+°, .*; reduce cloud\.groups\.least_angle or"):
        match_groups(ring(2, 15), GroupSettings(least_angle=30, best_angle=40))
    with pytest.raises(CalibrationError, match="no two cameras"):
        match_groups(ring(3, 360))
    with pytest.raises(CalibrationError, match="camX"):
        match_groups(TRIPLET, GroupSettings(template_camera="camX"))


def test_cameras_that_are_too_far_apart() -> None:
    settings = GroupSettings()
    assert too_far_apart(ring(3, 360), settings)
    assert too_far_apart(ring(2, 180), settings)
    assert too_far_apart(TRIPLET, GroupSettings(greatest_angle=15.0, best_angle=10.0))
    assert not too_far_apart(TRIPLET, settings)
    assert not too_far_apart(ring(3, 4), settings)  # these are too near
    assert not too_far_apart(ring(8, 360), settings)


def turned(rig: Rig, camera: int, degrees: float) -> Rig:
    """The rig as if one camera had been turned, about an oblique axis."""
    poses = np.array(rig.cam_from_world)
    axis = np.array([0.6, 0.64, 0.48]) * np.radians(degrees)
    poses[camera] = cv2.Rodrigues(axis)[0] @ poses[camera]
    return Rig(rig.names, rig.cameras, poses)


@pytest.mark.parametrize("degrees", [1.0, 5.0])
def test_turned_camera_is_left_out(sharp: CloudFrame, degrees: float) -> None:
    frame = measure(turned(TRIPLET, 2, degrees), *photograph(TRIPLET, Texture.random()))
    assert np.sum(off_surface(frame.points.positions) > 0.02) < 0.01 * len(sharp.points)
    # The other pair still measures
    assert len(frame.points) > 0.3 * len(sharp.points)
    assert any("cam2" in w for w in frame.warnings)


def test_turned_template_gives_way_to_another(sharp: CloudFrame) -> None:
    frame = measure(turned(TRIPLET, 1, 1.0), *photograph(TRIPLET, Texture.random()))
    assert np.sum(off_surface(frame.points.positions) > 0.02) < 0.01 * len(sharp.points)
    assert any("cam1" in w for w in frame.warnings)


def test_mirrored_images_are_not_believed(sharp: CloudFrame) -> None:
    images, masks = photograph(TRIPLET, Texture.random())
    frame = measure(TRIPLET, [i[:, ::-1] for i in images], [m[:, ::-1] for m in masks])
    assert len(frame.points) < 0.01 * len(sharp.points)
    assert frame.warnings


def test_swapped_images_are_not_believed(sharp: CloudFrame) -> None:
    images, masks = photograph(TRIPLET, Texture.random())
    frame = measure(TRIPLET, images[::-1], masks[::-1])
    assert len(frame.points) < 0.01 * len(sharp.points)
    assert frame.warnings


@pytest.mark.parametrize("black", [1, 2])
def test_one_black_camera_is_named(sharp: CloudFrame, black: int) -> None:
    images, masks = photograph(TRIPLET, Texture.random())
    images[black] = 0 * images[black]
    frame = measure(TRIPLET, images, masks)
    assert 0.2 * len(sharp.points) < len(frame.points)
    assert np.mean(off_surface(frame.points.positions) < 5 * 2.0 / 2500) > 0.99
    assert any(f"cam{black}: nothing matches" in w for w in frame.warnings)


def test_highlights_give_no_wrong_points(sharp: CloudFrame) -> None:
    """A lamp's reflection lies elsewhere on the ball in every image."""
    images, masks = photograph(TRIPLET, Texture.random())
    y, x = np.mgrid[: images[0].shape[0], : images[0].shape[1]]
    for c, image in enumerate(images):
        spot = 255 * np.exp(-((x - 110 - 30 * c) ** 2 + (y - 90) ** 2) / (2 * 12.0**2))
        images[c] = np.clip(image + spot[..., None], 0, 255).astype(np.uint8)
    frame = measure(TRIPLET, images, masks)
    assert np.sum(off_surface(frame.points.positions) > 0.02) < 0.005 * len(sharp.points)
    assert len(frame.points) > 0.6 * len(sharp.points)


def test_images_of_different_size(sharp: CloudFrame) -> None:
    images, masks = photograph(TRIPLET, Texture.random())
    smaller = TRIPLET.cameras[2].todict()
    half = pycolmap.Camera(smaller)
    half.rescale(0.5)
    rig = Rig(TRIPLET.names, (*TRIPLET.cameras[:2], half), TRIPLET.cam_from_world)
    images[2] = cv2.resize(images[2], (half.width, half.height), interpolation=cv2.INTER_AREA)
    masks[2] = cv2.resize(masks[2].astype(np.uint8), (half.width, half.height), interpolation=cv2.INTER_NEAREST)
    frame = measure(rig, images, masks)
    assert np.mean(off_surface(frame.points.positions) < 5 * 2.0 / 2500) > 0.99
    assert len(frame.points) > 0.5 * len(sharp.points)


@pytest.mark.parametrize("rig", [ring(2, 20), ring(16, 360)], ids=["pair", "ring of 16"])
def test_without_silhouettes_and_hull(rig: Rig) -> None:
    images, _ = photograph(rig, Texture.random())
    settings = CloudSettings.model_validate({"growing": {"step": 5.0, "radius": 4}})
    box = ((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6))
    frame = cloud_of_frame(images, None, None, rig, match_groups(rig, settings.groups), settings, box)
    error = off_surface(frame.points.positions)
    assert np.mean(error < 5 * 2.0 / 2500) > 0.98
    points = surface_points()
    seen = points[np.sort(cosines(rig, points), axis=0)[-2] > 0.6]
    assert np.mean(cKDTree(frame.points.positions).query(seen)[0] < 6 * PIXEL) > 0.9


def test_box_bounds_depths() -> None:
    entry, leaving = box_depth(TRIPLET, 1, (HEIGHT, WIDTH), ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)))
    # The middle ray of the middle camera runs along y, a little up or down
    assert entry[HEIGHT // 2, WIDTH // 2] == pytest.approx(1.5, abs=0.02)
    assert leaving[HEIGHT // 2, WIDTH // 2] == pytest.approx(2.5, abs=0.05)
    assert np.isnan(entry[2, 2])
    here = box_depth(TRIPLET, 1, (HEIGHT, WIDTH), ((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0)))
    assert (here[0] < 1e-3).all() and (here[1] > 5).all()


def test_spacing_in_metres(sharp: CloudFrame) -> None:
    settings = SETTINGS.model_copy(update={"spacing": 0.02})
    frame = measure(TRIPLET, *photograph(TRIPLET, Texture.random()), settings)
    # Facing the camera, a ball's front is nearer than its middle
    near = np.median(cKDTree(frame.points.positions).query(frame.points.positions, 2)[0][:, 1])
    assert 0.013 < near < 0.021


def test_parallel_axes_have_a_scene_too() -> None:
    """Two cameras side by side, as in a stereo head."""
    rig = ring(2, 20)
    poses = np.array([rig.cam_from_world[0]] * 2)
    base = 0.3
    poses[1, 0, 3] -= base
    stereo = Rig(rig.names, rig.cameras, poses)
    center, meet = scene_center(stereo)
    assert not meet
    ahead = (center - stereo.centers) @ stereo.viewing_directions[0]
    np.testing.assert_allclose(ahead, 8 * base, rtol=1e-6)
    images, _ = photograph(stereo, Texture.random())
    frame = measure(stereo, images, None, SETTINGS)
    assert len(frame.points) > 500
    assert np.mean(off_surface(frame.points.positions) < 0.02) > 0.98
    middle = match_groups(stereo, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))).groups[0].depth
    assert middle == pytest.approx(float(-stereo.centers[0] @ stereo.viewing_directions[0]))


@pytest.mark.parametrize(
    ("residuals", "growth", "removed", "confirmed", "words"),
    [
        ([0.03, 0.05], 1.2, 0.02, 0.6, ""),
        ([0.03, np.nan], 1.2, 0.1, 0.0, ""),
        ([0.5], 1.2, 0.1, np.nan, ""),
        ([0.03, 0.05], 0.05, 0.02, 0.6, "spread"),
        ([0.03, 0.9], 1.2, 0.02, 0.6, "by 0.90 px"),
        ([0.03, np.inf], 1.2, 0.02, 0.6, "leave their epipolar lines"),
        ([np.inf], 1.2, 0.02, np.nan, "leave their epipolar lines"),
        ([0.3, np.nan], 1.2, 0.02, 0.0, "by 0.30 px and no third image"),
        ([0.03], 1.2, 0.4, np.nan, "40% of the matches"),
    ],
)
def test_evidence(residuals: list[float], growth: float, removed: float, confirmed: float, words: str) -> None:
    doubt = MatchEvidence(np.array(residuals), growth, removed, confirmed).doubt(TrustSettings())
    assert words in doubt and bool(doubt) == bool(words)


def test_right_calibration_leaves_no_residuals(sharp: CloudFrame) -> None:
    evidence = sharp.templates[0].evidence
    assert (evidence.residuals < 0.1).all() and evidence.growth > 0.5
    assert evidence.removed < 0.05 and evidence.confirmed > 0.7
