"""Results checked without truth: an ellipsoid that turns, seen by a ring of cameras, with exact silhouettes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.carving.silhouette_views import Undistortion
from geomocap.errors import RunError
from geomocap.evaluation.result_check import SeenOutlines, check_result
from geomocap.files.check_file import read_self_check, write_self_check
from geomocap.files.run import Run
from geomocap.model.self_check import SelfCheck
from geomocap.model.surface import surface_through
from geomocap.skeleton.body_observations import SkinPoints
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.subject.model_mesh import ModelMesh
from tests.geomocap.ball import HEIGHT, WIDTH, ring, surface_points

RADII = np.array([0.42, 0.18, 0.12])
FRAMES = [0, 1, 2]
TURNS = Rotation.from_rotvec(np.deg2rad([[0, 0, 0], [0, 0, 50], [0, 0, 100]])).as_matrix()


@pytest.fixture(scope="module")
def rig():
    return ring(6, 360.0)


def silhouettes(rig, frame):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    masks = []
    for c in range(len(rig)):
        origin, rays = rig.rays(c, np.column_stack([x.ravel(), y.ravel()]))
        o, d = origin @ TURNS[frame] / RADII, rays @ TURNS[frame] / RADII
        hit = (d @ o) ** 2 - (d * d).sum(axis=1) * (o @ o - 1.0) > 0
        masks.append(hit.reshape(HEIGHT, WIDTH))
    return masks


def check(rig, turns=TURNS, order=None, blind=None, speck=None):
    undistortion = Undistortion.of(rig)
    order = list(range(len(rig))) if order is None else order

    def views(frame):
        masks = silhouettes(rig, frame)
        if blind is not None:
            masks[blind][:] = False
        if speck is not None:
            masks[speck][:12, :12] = True
        return undistortion.views([masks[c] for c in order])

    ball = surface_points(3000)
    points = ball / np.linalg.norm(ball, axis=1, keepdims=True) * RADII
    normals = points / RADII**2
    surface = surface_through(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))
    skin = SkinPoints.of_weights(surface.vertices, np.ones((len(surface.vertices), 1)))
    motion = BodyMotion(turns[:, None], np.zeros((len(turns), 1, 3)))
    mesh = ModelMesh(surface, skin, np.zeros((0, 3), np.uint8))
    return check_result(rig.names, FRAMES, SeenOutlines(views, rig.undistorted()), mesh, motion)


def test_what_is_right_agrees_with_every_camera(rig):
    found = check(rig)
    assert found.model.min() > 0.97  # outlines of some 100 pixels' length, off by a part of a pixel
    # the hull of five cameras, most of them at one height, is larger than the ellipsoid: up to 1.4 times in a view
    assert found.left_out.min() > 0.6 and found.left_out.mean() > 0.8


def test_a_wrong_motion_shows_in_the_frames_in_which_it_is_wrong(rig):
    wrong = TURNS.copy()
    wrong[2] = TURNS[0]
    found = check(rig, wrong)
    assert found.model[:, :2].min() > 0.97 and found.model[:, 2].mean() < 0.8


def test_cameras_that_contradict_the_others_stand_out(rig):
    swapped = [1, 0, 2, 3, 4, 5]
    found = check(rig, order=swapped)
    mean = np.nanmean(found.left_out, axis=1)
    assert mean[:2].max() < mean[2:].min()


def test_a_camera_that_sees_nothing_has_no_say(rig):
    found = check(rig, blind=4)
    assert np.isnan(found.left_out[4]).all() and np.isnan(found.model[4]).all()
    assert np.isfinite(np.delete(found.left_out, 4, axis=0)).all()


def test_what_one_camera_alone_sees_beside_the_subject_is_not_compared_with_the_others(rig):
    clear, found = check(rig), check(rig, speck=2)
    np.testing.assert_array_equal(found.left_out, clear.left_out)
    assert (found.model[2] < clear.model[2]).all()  # the model is judged by silhouettes as they are


def made_check(model=0.95, left_out=0.9, camera_low=None, residual=0.002):
    cameras = ("a", "b", "c", "d")
    outlines, hulls = np.full((4, 3), model), np.full((4, 3), left_out)
    if camera_low is not None:
        hulls[camera_low] = 0.4
    outlines[1, 2] = np.nan
    return SelfCheck(cameras, np.array([0, 5, 9]), outlines, hulls, residual)


def test_verdict_in_plain_words():
    assert made_check().verdict() == ("trust it", ())
    word, reasons = made_check(model=0.7).verdict()
    assert word == "check it" and "70%" in reasons[0]
    assert made_check(model=0.5).verdict()[0] == "don't use it"
    word, reasons = made_check(residual=0.014).verdict()
    assert word == "check it" and "1.4% of the subject's diagonal" in reasons[0]
    assert made_check(residual=float("nan")).verdict()[0] == "trust it"
    assert made_check().verdict(("turns are unsure",)) == ("check it", ("turns are unsure",))


def test_a_camera_that_contradicts_is_named():
    word, reasons = made_check(camera_low=2).verdict()
    assert word == "check it" and "silhouettes of c contradict" in reasons[0]
    assert made_check(camera_low=2).contradicting == ("c",)


def test_what_was_checked_is_read_as_it_was_written(tmp_path):
    run, made = Run(tmp_path), made_check()
    assert read_self_check(run) is None
    write_self_check(run, made)
    found = read_self_check(run)
    np.testing.assert_array_equal(found.model, made.model)
    assert found.figures == pytest.approx(made.figures, abs=1e-4) and found.cameras == made.cameras
    (tmp_path / "check.json").write_text('{"cameras": ["a"], "frames": [0], "model": [], "left_out": []}')
    with pytest.raises(RunError, match=r"check\.json: damaged"):
        read_self_check(run)
