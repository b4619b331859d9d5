"""Calibrations from image sizes alone: images, missing and false targets, knocked cameras, degenerate motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import tomli_w

from geomocap.calibration.bar_calibration import Calibration, calibrate_bar
from geomocap.calibration.calibration_settings import BarSettings, TargetSettings
from geomocap.calibration.from_capture import calibrate_capture
from geomocap.calibration.initial import pair_all
from geomocap.calibration.recording import Recording, measure
from geomocap.errors import CalibrationError, CaptureError
from geomocap.files.rigs import read_rig
from geomocap.model.rig import Rig
from tests.geomocap.bar_scenes import (
    Scene,
    eight_cameras,
    joined,
    knocked,
    object_errors,
    random_bars,
    render,
    seen,
    three_cameras,
)

FLAT = BarSettings(targets=TargetSettings(shape="flat"))
NOISE = 0.02


def check(scene: Scene, calibration: Calibration) -> None:
    """What every good calibration of a scene must show."""
    network = calibration.adjusted.network
    errors, reprojection = object_errors(scene, calibration.rig, network.bars, network.frames)
    assert 0.85 < calibration.sigma0 < 1.15
    assert calibration.held_out.relative < 1 / 3000
    assert np.sqrt(np.mean(errors**2)) < 1.35 * calibration.covariance.point_sigma
    assert reprojection < 0.1
    assert not calibration.moved
    assert not any(test.significant and abs(test.value) > 5 * test.sigma for test in calibration.tests)


def write_bar(scene: Scene, folder: Path, seed: int) -> None:
    """Write a bar recording with sensor noise of 1.5 grey levels."""
    rng = np.random.default_rng(seed)
    for c, name in enumerate(scene.rig.names):
        (folder / "bar" / name).mkdir(parents=True)
        for t in range(len(scene.bars)):
            image = render(scene, t, c, rng)
            cv2.imwrite(str(folder / "bar" / name / f"{t:06d}.png"), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 0])
    (folder / "bar" / "bar.toml").write_text(tomli_w.dumps({"length": scene.length, "length_sigma": 5e-6}))


def write_reference(scene: Scene, folder: Path) -> None:
    """Write images of an L-shaped reference a metre above the origin, long arm x, short arm y."""
    targets = np.array([[[0.0, 0.0, 1.0], [0.45, 0.0, 1.0], [0.0, 0.3, 1.0]]])
    shape = replace(scene, bars=targets)
    for c, name in enumerate(scene.rig.names):
        (folder / "reference" / name).mkdir(parents=True)
        image = render(shape, 0, c, np.random.default_rng(c))
        cv2.imwrite(str(folder / "reference" / name / "000000.png"), image[..., ::-1])
    (folder / "reference" / "reference.toml").write_text("long_arm = 0.45\nshort_arm = 0.3\n")


@pytest.mark.parametrize(("make", "seed", "n_bars"), [(three_cameras, 7, 60), (eight_cameras, 8, 30)])
def test_from_images_alone(make: Callable[[int, int], Scene], seed: int, n_bars: int, tmp_path: Path) -> None:
    scene = make(seed, n_bars)
    write_bar(scene, tmp_path, seed)
    if make is three_cameras:
        write_reference(scene, tmp_path)
    calibration = calibrate_capture(tmp_path)
    check(scene, calibration)
    assert calibration.estimate.target_radius == pytest.approx(scene.radius, rel=0.02)
    if make is three_cameras:
        assert calibration.datum.source == "an L-shaped reference" and not calibration.datum.warnings
        np.testing.assert_allclose(calibration.rig.centers, scene.rig.centers - [0, 0, 1], atol=0.003)
    else:
        assert "nothing fixes the world" in calibration.verdict.warnings[-1]
        assert calibration.adjusted.network.bars[..., 2].min() == pytest.approx(0, abs=1e-9)

    calibration.write(tmp_path / "sparse")
    model = pycolmap.Reconstruction(str(tmp_path / "sparse"))
    assert len(model.images) == len(scene.rig) and len(model.points3D) == 2 * len(calibration.adjusted.network.bars)
    assert model.compute_mean_reprojection_error() < 0.02
    tracks = sum(p.track.length() for p in model.points3D.values())
    assert tracks == len(calibration.adjusted.network.bar)
    read = read_rig(tmp_path / "sparse", scene.rig.names)
    np.testing.assert_allclose(read.centers, calibration.rig.centers, atol=1e-9)
    calibration.write(tmp_path / "sparse")  # our own may be replaced
    (tmp_path / "sparse" / "calibration.json").unlink()
    with pytest.raises(CalibrationError, match="--force"):
        calibration.write(tmp_path / "sparse")
    calibration.write(tmp_path / "sparse", force=True)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize("make", [three_cameras, eight_cameras])
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_missing_and_false_targets(make: Callable[[int], Scene], seed: int) -> None:
    scene = make(seed)
    rng = np.random.default_rng(seed)
    missing = np.zeros(len(scene.rig))
    missing[1] = 0.5
    calibration = calibrate_bar(seen(scene, rng, NOISE, 0.05, missing), scene.length, FLAT, length_sigma=1e-5)
    check(scene, calibration)
    assert len(calibration.adjusted.network.bars) >= 57


@pytest.mark.parametrize("make", [three_cameras, eight_cameras])
@pytest.mark.parametrize(("angle", "shift"), [(2.0, 0.02), (0.15, 0.002), (15.0, 0.1)])
def test_a_knocked_camera_is_named(make: Callable[[int], Scene], angle: float, shift: float) -> None:
    scene = make(14)
    camera = 2
    after = knocked(scene, camera, angle, shift)
    rng = np.random.default_rng(5)
    observations = joined(seen(scene, rng, NOISE, 0.03), seen(after, rng, NOISE, 0.03), 30)
    calibration = calibrate_bar(observations, scene.length, FLAT, length_sigma=1e-5)
    (moved,) = calibration.moved
    assert moved.camera == scene.rig.names[camera]
    assert 27 <= moved.before < moved.after <= 32
    assert moved.angle_deg == pytest.approx(angle, rel=0.1)
    assert calibration.verdict.grade == "poor"
    assert f"camera {moved.camera} was moved between frames" in calibration.verdict.warnings[0]
    # The calibration is right for the later position
    network = calibration.adjusted.network
    _, reprojection = object_errors(after, calibration.rig, network.bars, network.frames)
    assert reprojection < 0.15


def test_swapped_ends_are_told_apart_by_geometry() -> None:
    scene = three_cameras(3)
    observations = seen(scene, np.random.default_rng(0), 0.0)
    pairings = pair_all(observations, BarSettings())
    truth = scene.rig.project(scene.bars.reshape(-1, 3)).reshape(3, -1, 2, 2)
    first = np.linalg.norm(observations.pixels[:, :, :1] - truth, axis=-1).argmin(axis=2)
    assert len(pairings) == 3
    for (i, j), pairing in pairings.items():
        np.testing.assert_array_equal(pairing.swapped, (first[i] != first[j])[pairing.frames])
        assert len(pairing.frames) >= 57


def with_bars(scene: Scene, middles: np.ndarray, directions: np.ndarray) -> Scene:
    half = 0.5 * scene.length * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return replace(scene, bars=np.stack([middles - half, middles + half], axis=1))


def test_degenerate_motion_is_named() -> None:
    scene = three_cameras(2)
    rng = np.random.default_rng(0)
    middles = scene.bars.mean(axis=1)
    parallel = with_bars(scene, middles, np.tile([0.6, 0.5, 0.62], (60, 1)) + rng.normal(0, 0.01, (60, 3)))
    warnings = words_of(parallel)
    assert "nearly parallel" in warnings
    flat = rng.normal(size=(60, 3))
    flat[:, 1] = 0
    plane = with_bars(scene, middles * [1, 0, 1] + rng.normal(0, 0.004, (60, 3)), flat)
    assert "plane" in words_of(plane)
    corner = with_bars(scene, 0.15 * (middles - [0, 0, 1]) + [0.3, 0, 1.2], rng.normal(size=(60, 3)))
    assert "of its image only" in words_of(replace(corner, bars=corner.bars * 0.4 + [0.15, 0, 0.65], length=0.2))


def words_of(scene: Scene) -> str:
    """Warnings or the error's words of a calibration."""
    try:
        observations = seen(scene, np.random.default_rng(1), NOISE)
        return " ".join(calibrate_bar(observations, scene.length, FLAT).verdict.warnings)
    except CalibrationError as error:
        return str(error)


def test_cameras_without_common_bars_are_named() -> None:
    scene = three_cameras(3)
    observations = seen(scene, np.random.default_rng(0), NOISE)
    observations.pixels[2, :55] = np.nan
    with pytest.raises(CalibrationError, match="camera c"):
        calibrate_bar(observations, scene.length, FLAT)
    observations.pixels[1:] = np.nan
    with pytest.raises(CalibrationError, match="no two cameras"):
        calibrate_bar(observations, scene.length, FLAT)


def test_given_interior_orientations_are_kept() -> None:
    scene = three_cameras(3)
    observations = seen(scene, np.random.default_rng(0), NOISE)
    calibration = calibrate_bar(observations, scene.length, FLAT, given=scene.rig, length_sigma=1e-5)
    for one, other in zip(calibration.rig.cameras, scene.rig.cameras, strict=True):
        np.testing.assert_allclose(one.params, other.params)
    check(scene, calibration)


def test_recordings_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no bar recording"):
        calibrate_capture(tmp_path)
    scene = three_cameras(3, 3)
    write_bar(scene, tmp_path, 0)
    (tmp_path / "bar" / "b" / "000002.png").unlink()
    with pytest.raises(CaptureError, match="different frames"):
        calibrate_capture(tmp_path)
    (tmp_path / "bar" / "bar.toml").write_text("length = -1")
    with pytest.raises(CaptureError, match=r"bar\.toml: length"):
        calibrate_capture(tmp_path)
    (tmp_path / "bar" / "bar.toml").unlink()
    with pytest.raises(CaptureError, match="metres between the target centres"):
        calibrate_capture(tmp_path)
    (tmp_path / "sparse").symlink_to(tmp_path.parent)
    with pytest.raises(CaptureError, match="sparse: leads out of the capture folder"):
        calibrate_capture(tmp_path)


def test_a_stronger_lens_model_only_where_it_is_needed() -> None:
    scene = three_cameras(6, 60)
    cameras = []
    for _ in range(3):
        params = [430.0, 431.0, 322.0, 238.0, -0.2, 0.08, 5e-4, -5e-4, -0.06, 0.0, 0.0, 0.0]
        cameras.append(pycolmap.Camera(model="FULL_OPENCV", width=640, height=480, params=params))
    rig = Rig(scene.rig.names, tuple(cameras), np.array(scene.rig.cam_from_world))
    half, target = np.array([1.1, 0.9, 0.8]), np.array([0, 0, 1.0])
    wide = replace(scene, rig=rig, bars=random_bars(np.random.default_rng(1), rig, 60, 0.5, half, target, 3))
    observations = seen(wide, np.random.default_rng(0), NOISE)
    calibration = calibrate_bar(observations, wide.length, FLAT, length_sigma=1e-5)
    assert all(c.model.name == "FULL_OPENCV" for c in calibration.rig.cameras)
    np.testing.assert_allclose([c.params[8] for c in calibration.rig.cameras], -0.06, atol=0.03)
    check(wide, calibration)
    plain = FLAT.model_copy(update={"model": "OPENCV"})
    fixed = calibrate_bar(observations, wide.length, plain, length_sigma=1e-5)
    assert fixed.sigma0 > calibration.sigma0
    assert any(t.significant for t in fixed.tests if t.parameter == "k3")


def test_videos_are_read_frame_by_frame(tmp_path: Path) -> None:
    scene = three_cameras(6, 5)
    (tmp_path / "bar").mkdir()
    for c, name in enumerate(scene.rig.names):
        writer = cv2.VideoWriter(str(tmp_path / "bar" / f"{name}.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (640, 480))
        for t in range(5):
            writer.write(render(scene, t, c, np.random.default_rng(t), 0.0)[..., ::-1])
        writer.release()
    recording = Recording.open(tmp_path / "bar", length=scene.length)
    observations = measure(recording, TargetSettings(background_frames=5))
    truth = scene.rig.project(scene.bars.reshape(-1, 3)).reshape(3, 5, 2, 2)
    near = np.linalg.norm(observations.pixels[:, :, :, None] - truth[:, :, None], axis=-1).min(axis=2)
    assert (near[scene.visible()] < 0.3).mean() > 0.9
