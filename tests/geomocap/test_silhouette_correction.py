"""Cameras corrected by the outlines of a recording: found where they are wrong, left alone where they are right."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from geomocap.calibration.silhouette_correction import correct_cameras, disagreement
from geomocap.calibration.silhouette_tangents import OutlineRays, Tangents
from geomocap.config import Config
from geomocap.errors import CaptureError, RunError
from geomocap.files.capture import Capture, CaptureInfo, write_capture_info
from geomocap.files.corrected_cameras import as_seen, camera_warnings
from geomocap.files.results import read_voxels
from geomocap.files.rigs import write_rig
from geomocap.files.run import Run
from geomocap.model.rig import Rig
from geomocap.pipeline import correction_stage
from geomocap.pipeline.correction_stage import find_correction, with_cameras
from geomocap.pipeline.job import Job
from geomocap.pipeline.track_stage import tracks
from geomocap.pipeline.voxel_stage import voxels
from tests.geomocap.carving_scenes import FIGURE, ring, silhouettes

FOCAL, WIDTH, HEIGHT, FRAMES = 300.0, 320, 240, 20


def rig_of(projections: np.ndarray) -> Rig:
    camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    poses = np.linalg.solve(K, projections)
    return Rig(tuple(f"cam{c}" for c in range(len(poses))), (camera,) * len(poses), poses)


def turned(rig: Rig, camera: int, degrees: float) -> Rig:
    """One camera turned about its vertical axis, as if somebody had touched its tripod."""
    poses = rig.cam_from_world.copy()
    poses[camera] = Rotation.from_euler("y", degrees, degrees=True).as_matrix() @ poses[camera]
    return Rig(rig.names, rig.cameras, poses)


def figure(frame: int) -> np.ndarray:
    """The figure with limbs that swing, walking in a circle."""
    rng = np.random.default_rng(frame)
    moved = FIGURE.copy()
    moved[2:, :3] += rng.normal(0, 0.06, (len(FIGURE) - 2, 3))
    moved[:, :3] += [0.4 * np.cos(frame), 0.4 * np.sin(frame), 0]
    return moved


@pytest.fixture(scope="module")
def rig() -> Rig:
    return rig_of(ring(4, focal=FOCAL))


@pytest.fixture(scope="module")
def masks(rig) -> list[list[np.ndarray]]:
    return [silhouettes(ring(4, focal=FOCAL), figure(k)) for k in range(FRAMES)]


def misfits_of(rig: Rig, outlines: OutlineRays) -> tuple[np.ndarray, Tangents]:
    poses = rig.cam_from_world[:, :, :3], rig.centers
    tangents = Tangents.of(outlines, *poses)
    return tangents.misfits(*poses), tangents


def test_tangents_of_true_cameras_agree_to_a_pixel(rig, masks):
    outlines = OutlineRays.of(rig, masks)
    misfits, tangents = misfits_of(rig, outlines)
    assert np.isfinite(misfits).mean() > 0.8
    assert np.nanmedian(np.abs(misfits)) < 1.0
    wrong = turned(rig, 1, 2.0)
    worse, _ = misfits_of(wrong, outlines)
    touched = tangents.of_camera(1)
    assert np.nanmedian(np.abs(worse[touched])) > 3 * np.nanmedian(np.abs(misfits[touched]))
    np.testing.assert_array_equal(worse[~touched], misfits[~touched])


def test_misfits_at_the_same_corners_are_right_until_another_one_is_touched(rig, masks):
    outlines = OutlineRays.of(rig, masks)
    before, tangents = misfits_of(rig, outlines)
    wrong = turned(rig, 1, 0.2)
    after, moved = misfits_of(wrong, outlines)
    quick = tangents.misfits(wrong.cam_from_world[:, :, :3], wrong.centers)
    same = (tangents.touching == moved.touching).all(axis=(1, 4)) & np.isfinite(after)
    assert same.mean() > 0.8
    assert np.nanmax(np.abs(after - before)) > 0.01
    np.testing.assert_allclose(quick[same], after[same], atol=1e-9)


def test_a_silhouette_cut_off_or_missing_says_nothing(rig, masks):
    cut = [[m.copy() for m in frame] for frame in masks]
    for frame in cut:
        frame[0][:] = 0
        rows = np.flatnonzero(frame[1].any(axis=1))
        frame[1][rows[0] : HEIGHT, :][:, : WIDTH // 2] = 255  # reaches the border at the left and below
    outlines = OutlineRays.of(rig, cut)
    assert not outlines.seen[0].any() and outlines.cut[1].any()
    misfits, tangents = misfits_of(rig, outlines)
    assert np.isnan(misfits[tangents.of_camera(0)]).all()
    assert np.isfinite(misfits).any()


def test_a_camera_that_was_touched_is_put_right(rig, masks):
    wrong = turned(rig, 2, 2.0)
    found = correct_cameras(wrong, OutlineRays.of(wrong, masks))
    assert found.is_corrected and found.after < 0.4 * found.before
    # what the cameras now agree on is what the true ones do, as far as silhouettes can tell
    points = figure(3)[:, :3]

    def spread(cameras: Rig) -> float:
        """How far from its pixels a point is that all cameras' rays come nearest to, pixels."""
        seen = rig.project(points)
        apart = []
        for k in range(len(points)):
            rays = [cameras.rays(c, seen[c, k : k + 1]) for c in range(4)]
            across = [np.eye(3) - np.outer(d[0], d[0]) for _, d in rays]
            place = np.linalg.solve(sum(across), sum(a @ o for a, (o, _) in zip(across, rays, strict=True)))
            apart.append(np.linalg.norm(cameras.project(place[None])[:, 0] - seen[:, k], axis=1).mean())
        return float(np.mean(apart))

    assert spread(found.rig) < 0.35 * spread(wrong)


def test_right_cameras_stay_as_they_are(rig, masks):
    found = correct_cameras(rig, OutlineRays.of(rig, masks))
    assert found.rig is rig and not found.is_corrected and found.before < 1.0


def test_silhouettes_that_are_wrong_don_t_move_right_cameras(rig, masks):
    spoilt = [[m.copy() for m in frame] for frame in masks]
    for k, frame in enumerate(spoilt):
        rows = np.flatnonzero(frame[k % 4].any(axis=1))
        frame[k % 4][rows[-1] - 25 :] = 0  # feet missing
    found = correct_cameras(rig, OutlineRays.of(rig, spoilt))
    assert not found.is_corrected


@pytest.mark.parametrize("wrong", ["legs", "half", "noise"])
def test_a_camera_whose_silhouettes_are_always_wrong_moves_no_camera(rig, masks, wrong):
    spoilt = [[m.copy() for m in frame] for frame in masks]
    rng = np.random.default_rng(0)
    for frame in spoilt:
        rows = np.flatnonzero(frame[1].any(axis=1))
        columns = np.flatnonzero(frame[1].any(axis=0))
        if wrong == "legs":
            frame[1][(rows[0] + rows[-1]) // 2 :] = 0
        elif wrong == "half":
            frame[1][:, int(columns.mean()) :] = 0
        else:
            x, y = rng.integers(20, 200, 2)
            frame[1][:] = 0
            frame[1][y : y + 30, x : x + 60] = 255
    found = correct_cameras(rig, OutlineRays.of(rig, spoilt))
    assert not found.is_corrected and found.before > 1.0


def test_too_little_is_no_evidence(rig, masks):
    wrong = turned(rig, 2, 2.0)
    assert not correct_cameras(wrong, OutlineRays.of(wrong, masks[:2])).is_corrected
    assert not correct_cameras(
        wrong.select(["cam0"]), OutlineRays.of(wrong.select(["cam0"]), [[m[0]] for m in masks])
    ).is_corrected


@pytest.fixture
def capture(tmp_path, rig, masks):
    """A capture of masks alone, calibrated before a camera was touched."""
    folder = tmp_path / "capture"
    write_capture_info_in(folder)
    for k, frame in enumerate(masks):
        for name, mask in zip(rig.names, frame, strict=True):
            file = folder / "masks" / name / f"{k:06d}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), np.where(mask > 0, 255, 0).astype(np.uint8))
    write_rig(folder / "sparse", turned(rig, 2, 2.0))
    return Capture.open(folder)


def write_capture_info_in(folder) -> None:
    folder.mkdir()
    write_capture_info(folder, CaptureInfo(name="figure", fps=25.0))


def test_a_run_uses_corrected_cameras_and_says_so(tmp_path, capture):
    run = Run(tmp_path / "run")
    with ThreadPoolExecutor(1) as executor:
        job = Job(run, Config(), executor, capture=capture, fps=capture.fps)
        seen, key = with_cameras(job)
        assert seen.capture is not None and seen.capture.rig.names == capture.rig.names
        np.testing.assert_allclose(as_seen(run, capture).rig.cam_from_world, seen.capture.rig.cam_from_world)
        assert with_cameras(seen)[1] == key
        written = json.loads((run.path / "correction.json").read_text())
        assert written["corrected"] and written["left_px"] < 0.5 * written["disagreement_px"]
        assert "Calibrate again" in camera_warnings(run)[0]
        (run.path / "correction.json").write_text("{}")
        with pytest.raises(RunError, match="damaged"):
            camera_warnings(run)
        off = Config.model_validate({"silhouettes": {"correct_cameras": False}})
        plain, _ = with_cameras(Job(run, off, executor, capture=capture, fps=capture.fps))
        assert plain.capture is capture and not (run.path / "sparse").exists() and camera_warnings(run) == []


def test_masks_without_images_are_a_capture(tmp_path, capture):
    assert not capture.has_images and capture.has_masks and capture.n_frames == FRAMES
    run = Run(tmp_path / "run")
    with ThreadPoolExecutor(1) as executor:
        config = Config.model_validate({"carving": {"resolution": 48}})
        job = Job(run, config, executor, capture=capture, fps=capture.fps)
        voxels(job)
        found = read_voxels(run.frame_file("voxels", 0))
        assert len(found.points) > 500 and len(np.unique(found.colors)) == 1
        with pytest.raises(CaptureError, match="masks without images"):
            tracks(job)


@pytest.mark.parametrize("touched", [False, True])
def test_all_outlines_are_cut_only_where_a_few_don_t_settle_it(tmp_path, rig, capture, monkeypatch, touched):
    read = []
    mask = Capture.mask
    monkeypatch.setattr(correction_stage, "FIRST", correction_stage.OUTLINES // 2)  # so short a recording tells little
    monkeypatch.setattr(Capture, "mask", lambda self, camera, k: read.append(k) or mask(self, camera, k))
    if not touched:
        write_rig(capture.path / "sparse", rig)
        capture = Capture.open(capture.path)
    with ThreadPoolExecutor(1) as executor:
        found = find_correction(Job(Run(tmp_path / "run"), Config(), executor, capture=capture, fps=25.0), capture)
    assert found.is_corrected == touched
    assert len(set(read)) == (FRAMES if touched else FRAMES // 2)
    assert found.before > 1.0 if touched else found.before < 0.5 and np.isnan(found.after)


def test_cameras_of_which_outlines_tell_too_little_aren_t_said_to_agree(rig, masks):
    blind = [[m * (c > 0) for c, m in enumerate(frame)] for frame in masks]
    assert np.isnan(disagreement(rig, OutlineRays.of(rig, blind)))
    assert np.isnan(disagreement(rig.select(["cam0"]), OutlineRays.of(rig.select(["cam0"]), [m[:1] for m in masks])))
    assert (
        disagreement(rig, OutlineRays.of(rig, masks))
        < 0.5
        < disagreement(turned(rig, 1, 2.0), OutlineRays.of(rig, masks))
    )
