"""The working volume, and the lines that say why there is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from geomocap.carving.agreement import (
    check_agreement,
    check_cameras,
    check_inside,
    check_silhouettes,
    silhouette_coverage,
)
from geomocap.carving.block_kernels import possible_parts, summed
from geomocap.carving.carving_settings import CarvingSettings, HullSettings
from geomocap.carving.frames import carve_frame
from geomocap.carving.hull import heard, hull, rounding_bounds
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.subject_bounds import connected_keys, subject_box
from geomocap.carving.volume import MOST_VOXELS, working_volume
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import CalibrationError, GeometryError
from tests.geomocap.carving_scenes import FIGURE, look_at, ring, silhouettes

LOW = (FIGURE[:, :3] - FIGURE[:, 3:]).min(axis=0)
HIGH = (FIGURE[:, :3] + FIGURE[:, 3:]).max(axis=0)


def figure(P: np.ndarray, **size: int) -> PinholeViews:
    return PinholeViews.of(P, silhouettes(P, FIGURE, **size), names=[f"cam{c}" for c in range(len(P))])


@pytest.mark.parametrize(
    ("P", "slack"),
    [
        (ring(8), 0.06),
        (ring(3), 0.12),
        (ring(8, radius=25, focal=400), 0.12),  # a subject of 29 pixels
        (ring(6, radius=60, focal=4000), 0.12),  # seen from far away
    ],
    ids=["ring", "three", "small", "far"],
)
def test_box_is_the_subject_s(P, slack):
    low, high = subject_box(figure(P), HullSettings())
    # pixels are decided by their centres: half of one may be missing
    assert (low <= LOW + 0.035).all() and (high >= HIGH - 0.035).all()
    assert (low >= LOW - slack).all() and (high <= HIGH + slack).all()


def test_cameras_on_an_arc_get_the_whole_hull():
    views = figure(ring(4, arc_deg=40))
    grid = working_volume([views])
    check_inside(hull(views, grid).surface_indices(), grid, 0)
    assert (grid.low <= LOW).all() and (grid.high >= HIGH).all()
    # along the ray the hull is longer than the subject: nobody looks from the side
    assert 1.2 < np.ptp(grid.centers(hull(views, grid).surface_indices())[:, 0]) < 2.0


def test_volume_holds_all_frames_and_nothing_depends_on_false_blobs():
    P = ring(8)
    frames = []
    for shift in (-0.3, 0.0, 0.4):
        moved = FIGURE + np.array([shift, 0, 0, 0, 0, 0])
        masks = silhouettes(P, moved)
        for c, mask in enumerate(masks):
            mask[(17 * c) % 200 : (17 * c) % 200 + 12, 5 + 30 * c : 20 + 30 * c] = 1
        frames.append(PinholeViews.of(P, masks))
    # one blob that all cameras agree on, far from the subject
    ball = silhouettes(P, np.array([[-0.9, 0.9, 0.1, 0.04, 0.04, 0.04]]))
    frames[1] = PinholeViews.of(P, [m | b for m, b in zip(silhouettes(P, FIGURE), ball, strict=True)])
    grid = working_volume(frames, CarvingSettings(margin=0, resolution=128))
    assert 126 <= max(grid.shape) <= 130
    np.testing.assert_allclose(grid.low, LOW - np.array([0.3, 0, 0]), atol=0.07)
    np.testing.assert_allclose(grid.high, HIGH + np.array([0.4, 0, 0]), atol=0.07)


def test_a_subject_that_travels_is_carved_as_finely_as_one_that_stays():
    P = ring(8, radius=9)
    far = [PinholeViews.of(P, silhouettes(P, FIGURE + np.array([s, 0, 0, 0, 0, 0]))) for s in (-1.5, 0.0, 1.5)]
    settings = CarvingSettings(resolution=64)
    still, moving = working_volume(far[1:2], settings), working_volume(far, settings)
    assert moving.voxel_size == pytest.approx(still.voxel_size, rel=0.05)
    assert moving.shape[0] * moving.voxel_size > still.shape[0] * still.voxel_size + 2.7


def test_settings_decide_before_anything_is_measured():
    given = CarvingSettings(volume=((-1, -1, 0), (1, 1, 2)), voxel_size=0.05)
    grid = working_volume([], given)
    assert grid.shape == (40, 40, 40) and grid.voxel_size == 0.05
    with pytest.raises(GeometryError, match="no frames"):
        working_volume([])


@pytest.mark.parametrize(
    "settings",
    [
        CarvingSettings(volume=((-1, -1, 0), (1, 1, 2)), voxel_size=0.0005),
        CarvingSettings(volume=((-1, -1, 0), (1, 1, 2)), voxel_size=1e-300),
        CarvingSettings(volume=((-1, 0, 0), (1, 0.001, 0.5)), voxel_size=2e-5),
        CarvingSettings(voxel_size=0.0005),
    ],
    ids=["given", "beyond all numbers", "thin", "found"],
)
def test_voxels_finer_than_memory_holds_are_refused_with_the_finest_possible(settings):
    frames = [figure(ring(6))]
    with pytest.raises(GeometryError, match=r"carving\.voxel_size = .* makes .* set .* m or more") as raised:
        working_volume(frames, settings)
    named = float(str(raised.value).partition("set ")[2].partition(" m")[0])
    count = np.prod(working_volume(frames, settings.model_copy(update={"voxel_size": named})).shape, dtype=float)
    assert 0.9 * MOST_VOXELS < count <= MOST_VOXELS
    with pytest.raises(GeometryError, match=f"set {named:g} m"):
        working_volume(frames, settings.model_copy(update={"voxel_size": 0.98 * named}))


def test_a_resolution_that_a_given_volume_is_too_large_for_is_refused():
    cube = CarvingSettings(volume=((-1, -1, 0), (1, 1, 2)), resolution=2048)
    with pytest.raises(GeometryError, match=r"carving\.resolution = 2048 makes 8\.6e\+09 .* set 10\d\d or less"):
        working_volume([], cube)
    flat = CarvingSettings(volume=((-1, -1, 0), (1, 1, 0.1)), resolution=2048)
    assert working_volume([], flat).shape == (2048, 2048, 103)


def test_volume_of_what_not_all_cameras_see():
    P = ring(5)
    masks = silhouettes(P, FIGURE)
    seen = [np.ones_like(m) for m in masks]
    seen[0][:, :170] = 0
    views = PinholeViews.of(P, masks, seen)
    low, high = subject_box(views, HullSettings(outside="unseen", min_views=4))
    assert (low <= LOW + 0.02).all() and (high >= HIGH - 0.02).all()
    assert np.linalg.norm(high - low) < 1.25 * np.linalg.norm(HIGH - LOW)


@pytest.mark.parametrize("wrong", [0, 3])
@pytest.mark.parametrize("aim", [[0, 2.0, 0.9], [0.35, 0.3, 0.9]], ids=["elsewhere", "beside"])
def test_the_camera_that_contradicts_the_others_is_named(wrong, aim):
    P = ring(8)
    masks = silhouettes(P, FIGURE)
    center = -np.linalg.solve(P[wrong, :, :3], P[wrong, :, 3])
    P[wrong] = look_at(center, aim, 300, 320, 240)
    views = PinholeViews.of(P, masks, names=[f"cam{c}" for c in range(8)])
    with pytest.raises(GeometryError, match=f"frame 7: the silhouettes of camera cam{wrong} contradict the others"):
        working_volume([views], numbers=[7])


def test_two_cameras_that_disagree_are_both_named():
    P = ring(2, arc_deg=90)
    masks = silhouettes(P, FIGURE)
    masks[0][70:] = 0  # the head in one camera, the feet in the other
    masks[1][:170] = 0
    with pytest.raises(GeometryError, match="silhouettes of cam0, cam1 have no common volume"):
        working_volume([PinholeViews.of(P, masks, names=["cam0", "cam1"])])


def test_agreeing_silhouettes_are_explained():
    views = figure(ring(6))
    assert (silhouette_coverage(views, HullSettings()) > 0.99).all()
    check_agreement(views, 0, HullSettings())


def test_a_camera_that_looks_away_is_named():
    P = ring(6)
    settings = HullSettings(outside="empty")
    check_cameras(figure(P), settings)
    center = -np.linalg.solve(P[2, :, :3], P[2, :, 3])
    P[2] = look_at(center, 2 * center, 300, 320, 240)
    with pytest.raises(CalibrationError, match="camera cam2 looks away"):
        check_cameras(PinholeViews.of(P, [np.ones((240, 320))] * 6, names=[f"cam{c}" for c in range(6)]), settings)
    P[4] = look_at(center, 2 * center, 300, 320, 240)
    with pytest.raises(CalibrationError, match="no point is seen by all cameras"):
        check_cameras(PinholeViews.of(P, [np.ones((240, 320))] * 6), settings)


def test_cameras_that_all_look_elsewhere_are_reported():
    P = ring(3)
    centers = [-np.linalg.solve(p[:, :3], p[:, 3]) for p in P]
    everywhere = [np.ones((240, 320))] * 3
    check_cameras(PinholeViews.of(P, everywhere), HullSettings())
    away = np.array([look_at(c, 2 * c, 300, 320, 240) for c in centers])
    with pytest.raises(CalibrationError, match="no point is seen by 3 of 0, 1, 2"):
        check_cameras(PinholeViews.of(away, everywhere), HullSettings())


def test_a_camera_turned_away_is_named_by_its_silhouette():
    P = ring(6)
    masks = silhouettes(P, FIGURE)
    masks[2][:, 300:] |= masks[2][:, 140:160]  # what it sees is cut off by the border: it may not see all
    center = -np.linalg.solve(P[2, :, :3], P[2, :, 3])
    P[2] = look_at(center, 2 * center, 300, 320, 240)
    with pytest.raises(GeometryError, match="frame 0: camera 2 looks away"):
        working_volume([PinholeViews.of(P, masks)])


def test_cameras_that_cut_the_subject_off_dont_cut_its_volume():
    """Three of eight cameras see a part only, one nothing: the volume is what the others see, less what those say."""
    P = ring(8)
    whole = silhouettes(P, FIGURE)
    masks = [m[:130] if c == 1 else m[110:] if c == 4 else m[:, :165] if c == 6 else m for c, m in enumerate(whole)]
    lowered = P.copy()
    lowered[4, 1] -= 110 * P[4, 2]
    masks[3] = np.zeros_like(masks[3])
    masks[3][40:45, 70:76] = 1  # a false blob
    views = PinholeViews.of(lowered, masks)
    assert views.cut_off().nonzero()[0].tolist() == [1, 4, 6] and views.blind().nonzero()[0].tolist() == [3]
    grid = Grid.of_box(LOW - 0.2, HIGH + 0.2, resolution=96)
    cut, complete = hull(views, grid).dense(), hull(PinholeViews.of(P, whole), grid).dense()
    rest = hull(PinholeViews.of(P, whole).without(6).without(4).without(3).without(1), grid).dense()
    assert (complete <= cut).all() and (cut <= rest).all() and complete.sum() < cut.sum() < rest.sum()
    low, high = subject_box(views, HullSettings())
    assert (low <= LOW + 0.02).all() and (high >= HIGH - 0.02).all()
    assert (high - low < 1.2 * (HIGH - LOW)).all()
    with pytest.raises(GeometryError, match="camera 3 is empty"):
        working_volume([views], CarvingSettings(hull=HullSettings(outside="empty")))


def test_empty_silhouettes_are_named():
    P = ring(4)
    masks = silhouettes(P, FIGURE)
    masks[1][:] = 0
    views = PinholeViews.of(P, masks, names=["a", "b", "c", "d"])
    strict = HullSettings(outside="empty")
    with pytest.raises(GeometryError, match="frame 12: the silhouette of camera b is empty"):
        check_silhouettes(views, 12, strict)
    check_silhouettes(views, 12, HullSettings(outside="empty", tolerance=1))
    check_silhouettes(views, 12, HullSettings())
    with pytest.raises(GeometryError, match="frame 3: the silhouette of camera b is empty"):
        carve_frame(views, Grid.of_box(LOW, HIGH, resolution=32), CarvingSettings(hull=strict), frame=3)


def test_an_empty_silhouette_comes_with_advice_that_can_be_followed():
    views = figure(ring(4))
    views.masks[1] = 0
    strict = HullSettings(outside="empty")
    with pytest.raises(GeometryError, match=r"check its image and background; .* set carving\.hull\.outside = 'auto'"):
        check_silhouettes(views, 3, strict)
    given = {n: Path(f"masks/{n}/000003.png") for n in views.names}
    with pytest.raises(GeometryError, match=rf"check masks/{views.names[1]}/000003\.png \(expected: 255"):
        check_silhouettes(views, 3, strict, given)
    allowed = CarvingSettings(resolution=32)
    grid = working_volume([figure(ring(4)), views], allowed)
    assert len(carve_frame(views, grid, allowed, frame=3).indices) > 100
    with pytest.raises(GeometryError, match=r"camera cam1: its silhouettes are empty, or nearly so, in all 1 frames"):
        working_volume([views], allowed)
    views.masks[:3] = 0
    with pytest.raises(GeometryError, match=r"out of view, name the frames that show it in capture\.toml"):
        check_silhouettes(views, 3, HullSettings())


def test_views_from_one_side_only_bound_nothing():
    with pytest.raises(GeometryError, match="don't bound the subject"):
        working_volume([figure(ring(2, arc_deg=2))])


def test_subject_outside_the_volume():
    views = figure(ring(6))
    with pytest.raises(GeometryError, match=r"frame 4: subject outside the volume .* no voxel is left"):
        carve_frame(views, Grid.of_box([2, 2, 0], [3, 3, 1], resolution=32), frame=4)
    cut = Grid.of_box(LOW - 0.1, [*(HIGH[:2] + 0.1), 1.2], resolution=64)
    with pytest.raises(GeometryError, match=r"it is cut off at high z \(\d"):
        carve_frame(views, cut, frame=4)
    allowed = carve_frame(views, cut, CarvingSettings(max_cut=1.0))
    assert len(allowed.indices) > 100
    whole = Grid.of_box(LOW - 0.1, HIGH + 0.1, resolution=64)
    voxels = carve_frame(views, whole, CarvingSettings(hull=HullSettings(phantoms=False)))
    np.testing.assert_array_equal(voxels.indices, hull(views, whole).surface_indices())
    assert hull(views, whole).dense()[tuple(voxels.indices.T)].all() and (voxels.colors == voxels.colors[0, 0]).all()


def test_a_frame_that_leaves_much_room_doesnt_make_all_frames_coarse():
    P = ring(8, radius=9)
    whole, bulky = (PinholeViews.of(P, silhouettes(P, scale * FIGURE)) for scale in (1.0, 2.0))
    low, high = subject_box(bulky, HullSettings())
    settings = CarvingSettings(resolution=64, margin=0)
    alone, together = (working_volume(frames, settings) for frames in ([whole] * 3, [whole, whole, bulky]))
    assert together.voxel_size == pytest.approx(1.5 * alone.voxel_size)
    assert (together.low <= low + 1e-9).all() and (together.high >= high - 1e-9).all()


@pytest.mark.parametrize(("count", "size"), [(1, 3), (40, 8), (900, 14), (2000, 40)])
def test_connected_cells_are_those_of_labelled_images(count, size):
    rng = np.random.default_rng(count)
    cells = np.unique(rng.integers(0, size, (count, 3)), axis=0)
    cells = cells[rng.permutation(len(cells))]
    dense = np.zeros((size, size, size), bool)
    dense[tuple(cells.T)] = True
    expected = ndimage.label(dense, np.ones((3, 3, 3)))[0][tuple(cells.T)]
    keys = (cells + 1) @ [(size + 2) ** 2, size + 2, 1]
    order = np.argsort(keys)
    labels = connected_keys(keys[order], order, size + 2)
    _, first = np.unique(expected, return_index=True)
    np.testing.assert_array_equal(labels, np.searchsorted(np.sort(first), first)[expected - 1])


def test_parts_of_cells_are_those_that_all_cameras_may_see():
    P = ring(8)
    views, cells = figure(P), np.array([[0, 0, 0], [1, 1, 1], [0, 1, 1]])
    origin, edge = np.array([-1.0, -1.0, -0.2]), 1.0
    heeded, unseen, least = heard(views, HullSettings())
    subject = summed(heeded.masks)
    space = Grid(origin, 2.0, (1, 1, 1))
    found = possible_parts(
        P, rounding_bounds(views, space), subject, summed(heeded.valid), unseen, 0, least, origin, edge / 2, cells
    )
    dense = hull(views, Grid(origin, edge / 16, (32, 32, 32))).dense()
    blocks = dense.reshape(4, 8, 4, 8, 4, 8).max(axis=(1, 3, 5))
    kept = {tuple(part) for part in found.tolist()}
    inside = {tuple(c) for c in np.argwhere(blocks).tolist() if [n // 2 for n in c] in cells.tolist()}
    assert inside <= kept < {tuple((2 * c + [i, j, k]).tolist()) for c in cells for i, j, k in np.ndindex(2, 2, 2)}
    assert found.tolist() == [[*c] for cell in cells for c in sorted(kept) if [n // 2 for n in c] == cell.tolist()]
