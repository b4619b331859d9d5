"""Captures: lazy reading, and one clear line for each thing that can be wrong with them."""

from __future__ import annotations

import os
import pickle
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from geomocap.errors import CaptureError
from geomocap.files.capture import Capture, CaptureInfo, write_capture_info
from geomocap.files.rigs import write_rig
from geomocap.files.videos import Video
from tests.geomocap.test_cameras import make_rig


def picture(camera: int, frame: int) -> np.ndarray:
    image = np.zeros((240, 320, 3), np.uint8)
    image[..., 0] = 10 * camera + 20
    image[20:100, 8 * frame : 8 * frame + 40, 1] = 200
    image[..., 2] = 2 * frame
    return image


def make_capture(path, cameras=3, frames=4):
    write_capture_info(path, CaptureInfo(name="test", fps=25.0))
    for c in range(cameras):
        folder = path / "images" / f"cam{c}"
        folder.mkdir(parents=True)
        for k in range(frames):
            cv2.imwrite(str(folder / f"{k:06d}.png"), picture(c, k)[..., ::-1])
    write_rig(path / "sparse", make_rig())
    return path


def write_video(path, frames=30, cut=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(25), options={"g": "8", "crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for k in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(0, k), format="rgb24")))
        container.mux(stream.encode())
    if cut:
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * cut)])


def test_images_are_read_as_they_were_written(tmp_path):
    capture = Capture.open(make_capture(tmp_path))
    assert capture.cameras == ("cam0", "cam1", "cam2")
    assert capture.n_frames == 4 and capture.fps == 25.0
    np.testing.assert_array_equal(capture.frame("cam1", 2), picture(1, 2))
    assert capture.rig.names == capture.cameras
    assert not capture.has_masks and not capture.has_background("cam0")


def test_part_of_a_recording(tmp_path):
    """Frames and masks count from the first that is used; what came before is still there to learn from."""
    make_capture(tmp_path)
    write_capture_info(tmp_path, CaptureInfo(fps=25.0, frames=(1, 2)))
    for k in range(4):
        file = tmp_path / "masks" / "cam1" / f"{k:06d}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        mask = np.zeros((240, 320), np.uint8)
        mask[:, : k + 1] = 255
        cv2.imwrite(str(file), mask)
    capture = Capture.open(tmp_path)
    assert (capture.n_frames, capture.n_recorded) == (2, 4)
    np.testing.assert_array_equal(capture.frame("cam1", 1), picture(1, 2))
    np.testing.assert_array_equal(capture.sources["cam1"].read(0), picture(1, 0))
    assert np.count_nonzero(capture.mask("cam1", 0)[0]) == 2
    with pytest.raises(CaptureError, match=r"cam1/000002\.png"):
        (tmp_path / "masks" / "cam1" / "000002.png").unlink()
        capture.mask("cam1", 1)


def test_videos_are_read_in_any_order(tmp_path):
    write_video(tmp_path / "videos" / "cam0.mp4")
    write_capture_info(tmp_path, CaptureInfo(fps=25.0))
    capture = Capture.open(tmp_path)
    assert capture.n_frames == 30
    video = pickle.loads(pickle.dumps(capture.sources["cam0"]))
    for k in (0, 1, 2, 17, 16, 3, 29, 28, 0, 13):
        error = np.abs(video.read(k).astype(int) - picture(0, k)).mean()
        assert error < 3, f"frame {k} is not the one that was written"


@pytest.mark.parametrize(
    "text", ["ffconcat version 1.0\nfile good.mp4\n", "#EXTM3U\n#EXTINF:1,\ngood.mp4\n", "<svg xmlns='a' width='9'/>"]
)
def test_a_list_of_other_files_is_no_video(tmp_path, text):
    write_video(tmp_path / "good.mp4")
    (tmp_path / "a.mp4").write_text(text)
    with pytest.raises(CaptureError, match=r"a\.mp4: no readable video \((it is no MP4|Invalid data)"):
        len(Video(tmp_path / "a.mp4"))


def test_a_pipe_in_place_of_a_video_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.mp4")
    with pytest.raises(CaptureError, match="it is a pipe or a device"):
        len(Video(tmp_path / "a.mp4"))


def test_truncated_video(tmp_path):
    write_video(tmp_path / "a.mp4", cut=0.6)
    with pytest.raises(CaptureError, match=r"a\.mp4: no readable video"):
        len(Video(tmp_path / "a.mp4"))


def test_missing_camera_folder(tmp_path):
    make_capture(tmp_path)
    write_capture_info(tmp_path, CaptureInfo(fps=25.0, cameras=("cam0", "cam7")))
    with pytest.raises(CaptureError, match=r"camera cam7 of capture\.toml has no folder"):
        Capture.open(tmp_path)


def test_unequal_frame_counts(tmp_path):
    make_capture(tmp_path)
    (tmp_path / "images/cam1/000003.png").unlink()
    with pytest.raises(CaptureError, match=r"unequal numbers of frames \(cam0: 4, cam1: 3, cam2: 4\)"):
        Capture.open(tmp_path)


def test_gap_in_the_frames(tmp_path):
    make_capture(tmp_path)
    (tmp_path / "images/cam1/000001.png").unlink()
    with pytest.raises(CaptureError, match=r"000002\.png: expected frame 000001"):
        Capture.open(tmp_path)


def test_truncated_png(tmp_path):
    make_capture(tmp_path)
    file = tmp_path / "images/cam1/000001.png"
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(CaptureError, match=r"cam1/000001\.png: damaged or truncated"):
        Capture.open(tmp_path).frame("cam1", 1)


def test_image_size_against_calibration(tmp_path):
    make_capture(tmp_path)
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"images/cam2/{k:06d}.png"), np.zeros((200, 320, 3), np.uint8))
    with pytest.raises(CaptureError, match="camera cam2 are 320×200, but it is calibrated for 320×240"):
        _ = Capture.open(tmp_path).rig


@pytest.mark.parametrize(("odd", "named"), [(3, 3), (0, 3)])
def test_a_frame_of_another_size(tmp_path, odd, named):
    make_capture(tmp_path)
    cv2.imwrite(str(tmp_path / f"images/cam2/{odd:06d}.png"), np.zeros((60, 160, 3), np.uint8))
    capture = Capture.open(tmp_path)
    with pytest.raises(CaptureError, match=rf"cam2/{named:06d}\.png: \d+×\d+ pixels, but 000000\.png is"):
        capture.frame("cam2", 3)
    if odd == 0:
        with pytest.raises(CaptureError, match="all frames of a camera need the same size"):
            _ = capture.rig


@pytest.mark.parametrize(
    ("mask", "said"),
    [
        (np.full((60, 80), 255, np.uint8), "80×60 pixels, but the images of camera cam1 are 320×240"),
        (np.eye(240, 320, dtype=np.uint8), "its values go up to 1 only; expected 0 for background and 255"),
    ],
)
def test_a_given_mask_that_can_not_be_used(tmp_path, mask, said):
    capture = Capture.open(make_capture(tmp_path))
    file = tmp_path / "masks/cam1/000001.png"
    file.parent.mkdir(parents=True)
    cv2.imwrite(str(file), mask)
    with pytest.raises(CaptureError, match=rf"masks/cam1/000001\.png: {said}"):
        capture.mask("cam1", 1)


def test_a_given_mask_may_be_empty(tmp_path):
    capture = Capture.open(make_capture(tmp_path))
    (tmp_path / "masks/cam1").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "masks/cam1/000001.png"), np.zeros((240, 320), np.uint8))
    assert not capture.mask("cam1", 1).any()


def test_a_turned_photograph_has_the_size_as_it_is_read(tmp_path):
    make_capture(tmp_path, cameras=1, frames=1)
    (tmp_path / "images/cam0/000000.png").unlink()
    turn = Image.Exif()
    turn[0x0112] = 6
    Image.fromarray(picture(0, 0)).save(tmp_path / "images/cam0/000000.jpg", exif=turn)
    capture = Capture.open(tmp_path)
    assert capture.frame("cam0", 0).shape == (320, 240, 3)
    assert capture.sources["cam0"].size == (240, 320)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fps = -3", "fps: must be greater than"),
        ("name = 'x'", "fps: is missing"),
        ("fps = 30\nspeed = 3", r"speed: no such key; see docs/captures\.md"),
        ("fps = ", "not valid TOML"),
        ("fps = 30\nup = 'x'", "up: must be 'y' or 'z'"),
        ("fps = 30\ncameras = ['cam1', 'cam1']", "cameras: camera cam1 is there more than once"),
        ("fps = 30\nregion_of_interest = [[0, 1, 0], [1, 0, 1]]", "region_of_interest: expected the corners"),
        ("fps = 30\nframes = [2, 1]", r"frames: expected the first and the last frame to use, got \[2, 1\]"),
        ("fps = 30\nframes = [1, 4]", r"frames: \[1, 4\], but 4 were recorded; the last is 3"),
        ("fps = 30\ntemplate_camera = 'nix'", "template_camera: there is no camera nix; choose one of cam0, cam1"),
        ("fps = 30\ncameras = ['cam0']\ntemplate_camera = 'cam1'", "template_camera: there is no camera cam1"),
    ],
)
def test_wrong_capture_toml(tmp_path, text, said):
    make_capture(tmp_path)
    (tmp_path / "capture.toml").write_text(text)
    with pytest.raises(CaptureError, match=rf"capture\.toml: {said}"):
        Capture.open(tmp_path)


@pytest.mark.parametrize(
    "part",
    [
        "images/cam9",
        "images/cam1/000002.png",
        "videos/cam9.mp4",
        "background/cam1.png",
        "masks",
        "masks/cam1",
        "masks/cam1/000000.png",
        "sparse",
        "sparse/cameras.txt",
        "capture.toml",
        "bar/cam1",
    ],
)
def test_links_can_not_lead_out_of_the_capture(tmp_path, part):
    inside, outside = make_capture(tmp_path / "capture"), tmp_path / "outside"
    link = inside / part
    outside.mkdir()
    link.parent.mkdir(parents=True, exist_ok=True)
    if link.exists():
        link.rename(outside / link.name)
    link.symlink_to(outside / link.name)
    with pytest.raises(CaptureError, match=f"{part}: leads out of the capture folder"):
        Capture.open(inside)


def test_links_within_the_capture_are_followed(tmp_path):
    inside = make_capture(tmp_path / "capture")
    (inside / "images/cam1").rename(inside / "raw")
    (inside / "images/cam1").symlink_to("../raw")
    (tmp_path / "name").symlink_to(inside)
    np.testing.assert_array_equal(Capture.open(tmp_path / "name").frame("cam1", 2), picture(1, 2))
    (inside / "raw/000002.png").unlink()
    (inside / "raw/000002.png").symlink_to(tmp_path / "elsewhere.png")
    with pytest.raises(CaptureError, match=r"cam1/000002\.png: leads out of the capture folder"):
        Capture.open(inside)


def test_fingerprint_notices_changed_images(tmp_path):
    capture = Capture.open(make_capture(tmp_path))
    before = capture.fingerprint("images")
    assert before == capture.fingerprint("images")
    cv2.imwrite(str(tmp_path / "images/cam0/000000.png"), picture(2, 2))
    assert before != capture.fingerprint("images")


@pytest.mark.parametrize(("kept", "most"), [(64e6, 5), (0, 16)])
def test_a_video_read_backwards_keeps_what_it_decodes(tmp_path, monkeypatch, kept, most):
    write_video(tmp_path / "cam0.mp4")  # 30 frames, a key frame in every eighth
    video = Video(tmp_path / "cam0.mp4", kept)
    forwards = [video.read(k) for k in range(30)]
    opened, open_file = [], Video._open
    monkeypatch.setattr(Video, "_open", lambda self: opened.append(self.path) or open_file(self))
    for k in range(29, -1, -1):
        np.testing.assert_array_equal(video.read(k), forwards[k])
        assert len(video._recent) <= (4 if kept == 0 else 30)
    assert len(opened) <= most
