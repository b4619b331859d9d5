from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.silhouette_views import Undistortion
from geomocap.carving.subject_bounds import subject_box
from geomocap.errors import GeometryError
from geomocap.model.rig import Rig
from geomocap.silhouettes.contradictions import OwnSilhouettes, find_contradictions
from geomocap.silhouettes.ray_agreement import denied_rays, unexplained
from tests.geomocap.camera_scenes import changed, posed, walk, walk_rig, with_focal

FRAMES = 6


def found_in(rig, shown, moments=None):
    evidence = OwnSilhouettes.of(Undistortion.of(rig), shown)
    return find_contradictions(evidence, len(shown), moments)


@pytest.mark.parametrize("cameras", [3, 4, 8])
def test_right_cameras_deny_nothing(cameras):
    rig = walk_rig(cameras)
    shown = walk(rig, FRAMES)
    for row in shown[::2]:
        assert np.nanmax(unexplained(Undistortion.of(rig).views(row))) == 0
    assert found_in(rig, shown) == ()


def test_images_that_cut_the_subject_off_are_no_contradiction():
    rig = walk_rig(4)
    near = rig
    for c in range(3):
        near = with_focal(near, c, 2.5)
    shown = walk(near, FRAMES)
    assert sum(m[0].any() or m[-1].any() for m in shown[0]) >= 3
    assert found_in(near, shown) == ()


@pytest.mark.parametrize("cameras", [4, 8])
@pytest.mark.parametrize(
    ("says", "how"),
    [
        ("seem mirrored", lambda m: m[:, ::-1].copy()),
        ("upside down and mirrored", lambda m: m[::-1].copy()),
        ("seem upside down", lambda m: m[::-1, ::-1].copy()),
        ("inverted", lambda m: 1 - m),
        ("100% of its image", np.ones_like),
        ("sees nothing", np.zeros_like),
    ],
)
def test_wrong_silhouettes_are_named(cameras, says, how):
    rig = walk_rig(cameras)
    (wrong,) = found_in(rig, changed(walk(rig, FRAMES), 1, how))
    assert wrong.cameras == ("cam2",)
    assert says in str(wrong)


@pytest.mark.parametrize("cameras", [4, 8])
@pytest.mark.parametrize(
    ("says", "how"),
    [
        ("rolled by 90°", lambda r: posed(r, 1, Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix())),
        ("the others deny", lambda r: posed(r, 1, Rotation.from_rotvec([0, 0.35, 0]).as_matrix())),
        ("the others deny", lambda r: posed(r, 1, np.eye(3), (2.0, 0, 0))),
        ("half of the calibrated", lambda r: with_focal(r, 1, 2.0)),
        ("twice the calibrated", lambda r: with_focal(r, 1, 0.5)),
    ],
)
def test_wrong_calibration_is_named(cameras, says, how):
    rig = walk_rig(cameras)
    (wrong,) = found_in(how(rig), walk(rig, FRAMES))
    assert wrong.cameras == ("cam2",)
    assert says in str(wrong)


@pytest.mark.parametrize("cameras", [4, 8])
def test_cameras_that_are_mixed_up_are_named(cameras):
    rig = walk_rig(cameras)
    (wrong,) = found_in(rig, [[row[1], row[0], *row[2:]] for row in walk(rig, FRAMES)])
    assert wrong.cameras == ("cam1", "cam2")
    assert "mixed up" in str(wrong)


@pytest.mark.parametrize("lag", [-2, 2])
def test_a_camera_of_another_time_is_named(lag):
    rig, count = walk_rig(5), 9
    shown = walk(rig, count)
    of_camera = [shown[min(max(k - lag, 0), count - 1)][2] for k in range(count)]
    late = [[*row[:2], other, *row[3:]] for row, other in zip(shown, of_camera, strict=True)]
    evidence = OwnSilhouettes.of(Undistortion.of(rig), late[2:7], range(2, 7))
    (wrong,) = find_contradictions(evidence, count, lambda camera, frames: [late[k][camera] for k in frames])
    assert wrong.cameras == ("cam3",)
    assert f"{abs(lag)} frames {'late' if lag > 0 else 'early'}" in str(wrong)


def test_a_single_frame_that_contradicts_tells_no_other_time():
    rig, count = walk_rig(4), 5
    shown = walk(rig, count)
    shown[0] = changed(shown[:1], 1, lambda m: np.roll(m, m.shape[1] // 4, axis=1))[0]
    evidence = OwnSilhouettes.of(Undistortion.of(rig), shown)
    found = find_contradictions(evidence, count, lambda camera, frames: [shown[k][camera] for k in frames])
    assert not any("late" in str(wrong) or "early" in str(wrong) for wrong in found)


def test_two_wrong_cameras_are_both_named():
    rig = walk_rig(8)
    shown = changed(walk(rig, FRAMES), 1, lambda m: m[:, ::-1].copy())
    wrong = found_in(rig, changed(shown, 4, np.ones_like))
    assert {w.cameras for w in wrong} == {("cam2",), ("cam5",)}


def test_silhouettes_with_mistakes_are_no_contradiction():
    rig = walk_rig(6)
    blob = np.zeros((72, 96), np.uint8)
    blob[58:68, 6:16] = 1
    without_feet = np.uint8(np.arange(72)[:, None] < 50)
    shown = changed(walk(rig, FRAMES), 1, lambda m: m * without_feet)
    shown = changed(shown, 3, lambda m: m | blob)
    assert found_in(rig, shown) == ()


@pytest.mark.parametrize("cameras", [4, 8])
@pytest.mark.parametrize("frame", [0, 3])
def test_a_subject_in_the_background_is_told(cameras, frame):
    rig = walk_rig(cameras)
    shown = walk(rig, FRAMES)
    there = shown[frame][1]  # what is the same in the background isn't seen, and what was there is
    (wrong,) = found_in(rig, changed(shown, 1, lambda m: m ^ there))
    assert wrong.cameras == ("cam2",)


@pytest.mark.parametrize("cameras", [4, 8])
def test_a_subject_that_hides_from_a_camera_is_no_contradiction(cameras):
    rig = walk_rig(cameras)
    shown = walk(rig, FRAMES)
    shown = [[m * np.uint8(c != 1 or k > 1) for c, m in enumerate(row)] for k, row in enumerate(shown)]
    shown[2][1] &= np.uint8(np.arange(96) < 48)
    assert found_in(rig, shown) == ()


def test_cameras_in_one_place_are_refused():
    rig = walk_rig(4)
    poses = np.array(rig.cam_from_world)
    poses[:, :, 3] = 0
    rig = Rig(rig.names, rig.cameras, poses)
    shown = walk(walk_rig(4), 2)
    found_in(rig, shown)  # can't be judged
    with pytest.raises(GeometryError, match="cameras cam1, cam2, cam3, cam4 stand in one place"):
        subject_box(Undistortion.of(rig).views(shown[0]), HullSettings())


def test_all_inverted_silhouettes_are_told():
    rig = walk_rig(4)
    (wrong,) = found_in(rig, [[1 - m for m in row] for row in walk(rig, 3)])
    assert wrong.cameras == rig.names
    assert "inverted" in str(wrong)


def denied_reference(P, masks, valid, unseen, origin, rays, spans, step, slack, least):
    """`denied_rays` in NumPy, all points of a ray at once."""
    H, W = masks.shape[1:]
    grown = [cv2.dilate(m, np.ones((2 * slack + 1, 2 * slack + 1), np.uint8)) for m in masks]
    denied = []
    for ray, (near, far) in zip(rays, spans, strict=True):
        depths = np.arange(near, far, step) + step / 2
        points = np.column_stack([origin + depths[:, None] * ray, np.ones(len(depths))])
        agreed, within = np.ones(len(depths), bool), np.zeros(len(depths), int)
        for c in range(len(P)):
            q = points @ P[c].T
            front = q[:, 2] > 0
            u, v = (q[:, :2] / np.where(front, q[:, 2], 1)[:, None]).T
            inside = front & (u >= 0) & (u < W) & (v >= 0) & (v < H)
            i, j = np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)
            inside &= valid[c][i, j] > 0
            agreed &= np.where(inside, grown[c][i, j] > 0, unseen[c])
            within += inside
        denied.append(not (agreed & (within >= least)).any())
    return np.array(denied)


@pytest.mark.parametrize(("slack", "least"), [(1, 0), (0, 0), (1, 2)])
def test_kernel_agrees_with_its_reference(slack, least):
    rng = np.random.default_rng(5)
    rig = walk_rig(4)
    masks = np.array([cv2.resize(rng.random((9, 12)), (96, 72)) > 0.7 for _ in range(4)]).astype(np.uint8)
    valid = np.ones_like(masks)
    valid[1, :, 70:] = 0
    unseen = np.array([False, True, False, True])
    pixels = rng.uniform((0, 0), (96, 72), (60, 2))
    origin, rays = rig.rays(0, pixels)
    spans = np.column_stack([rng.uniform(0.0, 1.0, 60), rng.uniform(5.0, 6.0, 60)])
    given = rig.projections[1:], masks[1:], valid[1:], unseen[1:], np.array(origin), rays, spans, 0.03, slack, least
    result = denied_rays(*given)
    assert 0 < result.sum() < len(result)
    np.testing.assert_array_equal(result, denied_reference(*given))
