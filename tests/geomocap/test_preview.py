"""Previews of captures: which frames are read, how often, and what they look like."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from geomocap.config import PREVIEW, Config, load_config, preview_config
from geomocap.errors import RunError
from geomocap.files.capture import Capture, CaptureInfo, write_capture_info
from geomocap.files.preview import PreviewCapture, PreviewFrames, frames_apart, preview_of
from geomocap.files.run_records import read_run_record
from geomocap.files.videos import Video
from tests.geomocap.test_capture import make_capture, picture, write_video


class Counted:
    """Frames that say in which order they were read."""

    size = (8, 6)

    def __init__(self, count):
        self.count, self.asked = count, []

    def __len__(self):
        return self.count

    def read(self, frame):
        self.asked.append(frame)
        return np.full((6, 8, 3), frame, np.uint8)


def small(image):
    return cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(("fps", "every"), [(60, 5), (30, 2), (25, 2), (24, 2), (23.9, 1), (12, 1), (5, 1), (120, 10)])
def test_twelve_frames_a_second_are_left(fps, every):
    assert frames_apart(fps) == every
    assert fps / every >= min(fps, 12)


def test_frames_are_read_once_and_in_order():
    source = Counted(23)
    frames = PreviewFrames(source, 2, 4, (4, 3))
    assert len(frames) == 6
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(frames.read, [5, 0, 3, 3, 1, 5, 2, 4, 0]))
    assert [image[0, 0, 0] for image in read] == [22, 2, 14, 14, 6, 22, 10, 18, 2]
    assert source.asked == [2, 6, 10, 14, 18, 22]
    assert all(image.shape == (3, 4, 3) for image in read)
    read[1][:] = 99  # what is done to a frame doesn't change the one that is kept
    assert (frames.read(0) == 2).all()


def test_more_than_memory_holds_is_read_again(monkeypatch):
    monkeypatch.setattr("geomocap.files.preview.KEPT", 100)
    source = Counted(23)
    frames = PreviewFrames(source, 0, 4, (4, 3))
    for k in (4, 1, 4):
        assert (frames.read(k) == 4 * k).all()
    assert source.asked == [16, 4, 16]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = make_capture(tmp_path_factory.mktemp("capture"), frames=9)
    (path / "background").mkdir()
    plate = np.full((240, 320, 4), 200, np.uint8)
    plate[..., 3] = 255
    plate[10, 10, 3] = 0
    for c in range(3):
        cv2.imwrite(str(path / "background" / f"cam{c}.png"), plate)
    write_capture_info(path, CaptureInfo(name="test", fps=36.0, frames=(1, 8)))
    return Capture.open(path)


def test_a_preview_is_a_capture_of_fewer_and_smaller_frames(whole):
    preview = PreviewCapture.of(whole, longest=160)
    assert (preview.every, preview.fps, preview.n_frames) == (3, 12.0, 3)
    assert preview.first == 0 and preview.n_recorded == 3  # frames 1, 4 and 7 of those recorded
    for k in range(3):
        np.testing.assert_array_equal(preview.frame("cam1", k), small(picture(1, 1 + 3 * k)))
    full, half = whole.rig, preview.rig
    np.testing.assert_array_equal(half.sizes, full.sizes // 2)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    np.testing.assert_allclose(half.project(points), full.project(points) / 2, atol=1e-9)
    plate = preview.background("cam0")
    assert plate.shape == (120, 160, 4) and plate[5, 5, 3] == 0 and np.count_nonzero(plate[..., 3] == 0) == 1
    assert preview.without(["cam2"]).rig.names == ("cam0", "cam1")
    assert preview.fingerprint("images") != whole.fingerprint("images")
    again = pickle.loads(pickle.dumps(preview))
    np.testing.assert_array_equal(again.frame("cam0", 2), preview.frame("cam0", 2))


def test_frames_before_those_used_are_as_far_apart(whole):
    later = Capture(whole.path, whole.info.model_copy(update={"frames": (5, 8)}), whole.cameras, whole.sources)
    preview = PreviewCapture.of(later, every=3, longest=160)
    assert preview.first == 1 and preview.n_frames == 2 and preview.n_recorded == 3
    np.testing.assert_array_equal(preview.frame("cam0", 0), small(picture(0, 5)))
    np.testing.assert_array_equal(preview.sources["cam0"].read(0), small(picture(0, 2)))


def test_given_masks_are_reduced_and_stay_masks(tmp_path):
    path = make_capture(tmp_path, cameras=2)
    for c in range(2):
        folder = path / "masks" / f"cam{c}"
        folder.mkdir(parents=True)
        for k in range(4):
            mask = np.zeros((240, 320), np.uint8)
            mask[40 : 100 + 10 * k, 50:91] = 255
            cv2.imwrite(str(folder / f"{k:06d}.png"), mask)
    preview = PreviewCapture.of(Capture.open(path), every=2, longest=160)
    mask = preview.mask("cam1", 1)
    assert mask.shape == (120, 160) and set(np.unique(mask)) == {0, 255}
    assert np.count_nonzero(mask.any(axis=1)) == 40
    assert preview.mask_file("cam1", 1).name == "000002.png"
    assert preview.part(range(1, preview.n_frames)).mask_file("cam1", 0).name == "000002.png"


def test_a_video_is_decoded_in_order(tmp_path, monkeypatch):
    write_capture_info(tmp_path, CaptureInfo(name="test", fps=36.0))
    for c in range(2):
        write_video(tmp_path / "videos" / f"cam{c}.mp4")
    preview = PreviewCapture.of(Capture.open(tmp_path), longest=160)
    opened, open_file = [], Video._open
    monkeypatch.setattr(Video, "_open", lambda self: opened.append(self.path) or open_file(self))
    for k in (9, 3, 0, 9, 5):
        expected = small(picture(0, 3 * k)).astype(int)
        assert np.abs(preview.frame("cam0", k) - expected).mean() < 4
    assert len(opened) <= 2  # once for the times of its frames, once for these


def test_a_run_records_that_it_is_a_preview(whole, tmp_path):
    record = PreviewCapture.of(whole, longest=160).record
    again = preview_of(whole, record)
    assert isinstance(again, PreviewCapture) and (again.every, again.longest) == (3, 160)
    assert preview_of(whole, None) is whole
    for wrong in ("3", "{ every = 0, longest = 160 }", "{ every = 3 }", "{ every = true, longest = 160 }"):
        (tmp_path / "run.toml").write_text(f'[source]\nkind = "capture"\npreview = {wrong}\n')
        with pytest.raises(RunError, match=r"source\.preview"):
            read_run_record(tmp_path)


def test_a_preview_takes_fewer_patches_voxels_and_rounds_unless_they_are_set(tmp_path):
    (tmp_path / "mine.toml").write_text("[tracking]\nn_patches = 3000\nradius_px = 4\n")
    config = preview_config(load_config(tmp_path / "mine.toml", {"carving": {"resolution": 200}}))
    assert (config.carving.resolution, config.tracking.n_patches, config.tracking.radius_px) == (200, 3000, 4)
    assert config.motion_bodies.depth_rounds < Config().motion_bodies.depth_rounds
    assert config.cloud == Config().cloud
    plain = preview_config(Config())
    assert plain.windows.frames * plain.tracking.n_patches == Config().windows.frames * Config().tracking.n_patches
    for name, values in PREVIEW.items():
        whole, quick = getattr(Config(), name), getattr(plain, name)
        assert type(quick)(**quick.model_dump()) == quick  # within the settings' own ranges
        if name != "windows":
            assert all(getattr(quick, k) < getattr(whole, k) for k in values)
