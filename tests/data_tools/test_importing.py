from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from data_tools.calibration_files import write_pose2sim
from data_tools.camera_views import look_at
from data_tools.image_sizes import find_fit, has_black_bars, possible_fits, refit_camera
from data_tools.importing import import_colmap, import_pose2sim
from data_tools.video_writing import VideoFile
from geomocap.errors import CalibrationError, CaptureError
from geomocap.files.rigs import write_rig
from geomocap.model.rig import Rig

CALIBRATED, PLAYED = (272, 480), (256, 480)


def scenery(seed: int = 0) -> np.ndarray:
    """A picture with features of many sizes, in the calibrated size."""
    random = np.random.default_rng(seed)
    width, height = CALIBRATED
    picture = np.zeros((height, width, 3), np.float32)
    for size in (4, 12, 40):
        grain = random.uniform(0, 1, (height // size + 2, width // size + 2, 3)).astype(np.float32)
        picture += cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(40 + picture * 70, 0, 255).astype(np.uint8)


def played(picture: np.ndarray, mode: str) -> np.ndarray:
    """What each way of changing the size makes of a picture."""
    (w, h), (W, H) = PLAYED, CALIBRATED
    if mode == "crop-right":
        return picture[:h, :w]
    if mode == "center":
        return picture[:, (W - w) // 2 : (W + w) // 2]
    if mode == "scale":
        return cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA)
    inner = round(H * w / W)
    top = (h - inner) // 2
    out = np.zeros((h, w, 3), np.uint8)
    out[top : top + inner] = cv2.resize(picture, (w, inner), interpolation=cv2.INTER_AREA)
    return out


def rig_of(size: tuple[int, int], names: tuple[str, ...] = ("a", "b")) -> Rig:
    params = [300.0, 301.0, size[0] / 2 + 3, size[1] / 2 - 2, -0.05, 0.01, 0.001, 0.0]
    camera = pycolmap.Camera(model="OPENCV", width=size[0], height=size[1], params=params)
    poses = [look_at(np.array([np.cos(k), np.sin(k), 0.5]) * 3, np.array([0, 0, 1.0])) for k in range(len(names))]
    return Rig(names, (camera,) * len(names), np.array(poses))


def session(folder: Path, sizes: dict[str, str | None], frames: int = 3) -> Path:
    """A Pose2Sim session whose videos were resized in these ways (None: as calibrated)."""
    write_pose2sim(rig_of(CALIBRATED, tuple(sizes)), folder / "calibration" / "Calib_scene.toml")
    for k, (name, mode) in enumerate(sizes.items()):
        picture = scenery(k)
        reference = folder / "calibration" / "extrinsics" / f"{name}_ext.png"
        reference.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(reference), picture[:, :, ::-1])
        picture = picture if mode is None else played(picture, mode)
        video = VideoFile(folder / "videos" / f"{name}.mp4", picture.shape[1], picture.shape[0], 25)
        for _ in range(frames):
            video.add(picture)
        video.finish()
    return folder


@pytest.mark.parametrize("mode", ["crop-right", "center", "scale", "letterbox"])
def test_size_is_explained_by_the_picture(mode: str) -> None:
    picture = scenery()
    found, fit, reason = find_fit(played(picture, mode), picture, CALIBRATED)
    assert found == mode
    assert "features" in reason
    assert has_black_bars(played(picture, mode), possible_fits(CALIBRATED, PLAYED)["letterbox"]) == (
        mode == "letterbox"
    )
    # A camera fitted to it sees a point where the changed picture shows it
    rig = rig_of(CALIBRATED)
    fitted = Rig(rig.names, tuple(refit_camera(c, fit, PLAYED) for c in rig.cameras), np.array(rig.cam_from_world))
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.3], (20, 3))
    np.testing.assert_allclose(fitted.project(points)[1], fit.apply(rig.project(points)[1]), atol=1e-9)


def test_without_a_picture_bars_or_shape_decide() -> None:
    picture = scenery()
    assert find_fit(played(picture, "letterbox"), None, CALIBRATED)[0] == "letterbox"
    half = cv2.resize(picture, (136, 240), interpolation=cv2.INTER_AREA)
    assert find_fit(half, None, CALIBRATED)[0] == "scale"
    name, _, reason = find_fit(played(picture, "center"), None, CALIBRATED)
    assert (name, "guess" in reason) == ("crop-right", True)
    assert find_fit(played(picture, "scale"), picture, CALIBRATED, "center")[0] == "center"


def test_inexplicable_sizes_are_refused() -> None:
    picture = scenery()
    turned = cv2.warpAffine(picture, cv2.getRotationMatrix2D((128, 240), 8, 1.1), PLAYED)
    with pytest.raises(CalibrationError, match="nothing explains"):
        find_fit(turned, picture, CALIBRATED)
    one_focal = pycolmap.Camera(model="SIMPLE_RADIAL", width=272, height=480, params=[300, 136, 240, 0.1])
    with pytest.raises(CalibrationError, match="can't be stretched"):
        refit_camera(one_focal, possible_fits(CALIBRATED, PLAYED)["scale"], PLAYED)


def test_pose2sim_session_becomes_a_capture(tmp_path: Path) -> None:
    source = session(tmp_path / "walk", {"left": "letterbox", "right": None})
    seen = []
    report = import_pose2sim(source, tmp_path / "capture", plates=False, progress=lambda *a: seen.append(a))
    capture = report.capture
    assert (capture.info.name, capture.n_frames, capture.fps) == ("walk", 3, 25)
    assert capture.cameras == ("left", "right")
    assert capture.rig.sizes.tolist() == [[256, 480], [272, 480]]
    for name in capture.cameras:  # copied, not coded again
        copy, original = (p / "videos" / f"{name}.mp4" for p in (capture.path, source))
        assert copy.read_bytes() == original.read_bytes()
    assert len(report.notes) == 1
    assert "left" in report.notes[0] and "letterbox" in report.notes[0]
    assert seen[-1] == ("videos", 2, 2)
    uniform = 256 / 272
    camera = capture.rig.cameras[0]
    assert camera.focal_length_x == pytest.approx(300 * uniform)
    assert camera.principal_point_x == pytest.approx(139 * uniform)
    assert camera.principal_point_y == pytest.approx(240 - 2 * uniform)


def test_pose2sim_plates_have_their_unknown_parts_transparent(tmp_path: Path, monkeypatch) -> None:
    def half_known(frames, reference):
        plate = np.asarray(next(iter(frames)))
        known = np.zeros(plate.shape[:2], bool)
        known[:, 100:] = True
        return plate, known

    monkeypatch.setattr("data_tools.importing.compose_plate", half_known)
    source = session(tmp_path / "walk", {"left": None, "right": None})
    report = import_pose2sim(source, tmp_path / "capture")
    plate = cv2.imread(str(tmp_path / "capture" / "background" / "right.png"), cv2.IMREAD_UNCHANGED)
    assert plate.shape == (480, 272, 4)
    assert np.all(plate[:, :100, 3] == 0) and np.all(plate[:, 100:, 3] == 255)
    np.testing.assert_array_equal(plate[:, :, 2::-1], report.capture.frame("right", 0))
    assert sum("background plate" in note for note in report.notes) == 2


def test_videos_with_other_names_are_paired_in_order(tmp_path: Path) -> None:
    source = session(tmp_path / "s", {"a": None, "b": None})
    for old, new in (("a", "GX01"), ("b", "GX02")):
        (source / "videos" / f"{old}.mp4").rename(source / "videos" / f"{new}.mp4")
    report = import_pose2sim(source, tmp_path / "c", plates=False)
    assert report.capture.cameras == ("a", "b")
    assert "GX01.mp4 – a" in report.notes[0]
    (source / "videos" / "GX02.mp4").unlink()
    with pytest.raises(CaptureError, match="1 videos"):
        import_pose2sim(source, tmp_path / "c2", plates=False)


def test_trial_finds_its_sessions_calibration_and_frame_rate(tmp_path: Path) -> None:
    source = session(tmp_path / "session", {"a": None, "b": None})
    trial = source / "trial"
    trial.mkdir()
    (source / "videos").rename(trial / "videos")
    (trial / "Config.toml").write_text("[project]\nframe_rate = 50\n")
    assert import_pose2sim(trial, tmp_path / "c", plates=False).capture.fps == 50


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match="no videos"):
        import_pose2sim(tmp_path / "empty", tmp_path / "c")
    source = session(tmp_path / "s", {"a": None})
    with pytest.raises(CaptureError, match="is not empty"):
        import_pose2sim(source, tmp_path / "s")
    (source / "calibration" / "Calib_scene.toml").unlink()
    with pytest.raises(CalibrationError, match="no calibration"):
        import_pose2sim(source, tmp_path / "c")
    with pytest.raises(CaptureError, match="no images"):
        write_rig(tmp_path / "model" / "sparse", rig_of(CALIBRATED))
        import_colmap(tmp_path / "model", tmp_path / "c2", 30)


def test_colmap_project_becomes_a_capture(tmp_path: Path) -> None:
    rig = rig_of((32, 24))
    write_rig(tmp_path / "project" / "sparse" / "0", rig)
    random = np.random.default_rng(0)
    for name in rig.names:
        folder = tmp_path / "project" / "images" / name
        folder.mkdir(parents=True)
        for k in (7, 12):
            cv2.imwrite(
                str(folder / f"frame{k:03d}.{'png' if name == 'a' else 'bmp'}"), random.integers(0, 255, (24, 32, 3))
            )
    report = import_colmap(tmp_path / "project", tmp_path / "c", 12.5, metres_per_unit=0.5, up="y")
    capture = report.capture
    assert (capture.fps, capture.info.up, capture.n_frames) == (12.5, "y", 2)
    np.testing.assert_allclose(capture.rig.centers, 0.5 * rig.centers, atol=1e-12)
    for name, ending in (("a", "png"), ("b", "bmp")):
        original = cv2.imread(str(tmp_path / "project" / "images" / name / f"frame012.{ending}"))
        np.testing.assert_array_equal(capture.frame(name, 1), original[:, :, ::-1])
    with pytest.raises(CalibrationError, match="metres_per_unit"):
        import_colmap(tmp_path / "project", tmp_path / "c3", 12.5, metres_per_unit=-1)


def test_real_session_is_letterboxed_in_two_cameras(data: Path, tmp_path: Path) -> None:
    report = import_pose2sim(data / "captures" / "pose2sim_single", tmp_path / "c", plates=False)
    assert (report.capture.n_frames, report.capture.fps) == (100, 60)
    assert [note.split(":")[0] for note in report.notes] == ["cam01", "cam02"]
    assert all("letterbox" in note for note in report.notes)
    assert report.rig.sizes.tolist() == [[1080, 1920]] * 2 + [[1088, 1920]] * 2
