"""Image files: damaged ones told, those of 16 bits scaled, sizes that can't be refused before anything is decoded."""

from __future__ import annotations

import io
import pickle
import re
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageFile

from geomocap.errors import CaptureError
from geomocap.files import jpeg_blocks
from geomocap.files.image_formats import image_header
from geomocap.files.images import ImageFolder, image_size, read_image
from geomocap.files.jpeg_blocks import jpeg_flaw


def picture(width=70, height=50, seed=0):
    y, x = np.mgrid[:height, :width]
    waves = np.stack([127 + 120 * np.sin(x / 7 + k) * np.cos(y / 9 - k) for k in range(3)], axis=-1)
    noise = np.random.default_rng(seed).normal(0, 20, waves.shape)
    return np.clip(waves + noise, 0, 255).astype(np.uint8)


def jpeg(image, mode="RGB", **options):
    stream = io.BytesIO()
    Image.fromarray(image).convert(mode).save(stream, "JPEG", **options)
    return stream.getvalue()


@pytest.mark.parametrize("size", [(1, 1), (17, 33), (96, 72)])
@pytest.mark.parametrize("mode", ["RGB", "L", "CMYK"])
@pytest.mark.parametrize(
    "options",
    [
        {"quality": 95},
        {"quality": 30, "subsampling": 2},
        {"quality": 90, "subsampling": 0, "optimize": True},
        {"quality": 75, "progressive": True},
        {"quality": 100, "progressive": True, "subsampling": 0, "restart_marker_blocks": 3},
        {"quality": 10, "progressive": True, "subsampling": 2, "restart_marker_rows": 1},
        {"quality": 75, "restart_marker_rows": 1},
        {"quality": 1},
    ],
)
def test_whole_jpegs_are_whole(size, mode, options, monkeypatch):
    monkeypatch.setattr(ImageFile, "MAXBLOCK", 1 << 20)
    assert jpeg_flaw(jpeg(picture(*size), mode, **options)) == ""


@pytest.mark.parametrize("quality", [1, 10, 50, 90, 100])
def test_black_and_white_pixels_are_within_8_bits(quality):
    for image in (np.indices((64, 64)).sum(axis=0) % 2 * 255, np.random.default_rng(0).integers(0, 2, (64, 64)) * 255):
        assert jpeg_flaw(cv2.imencode(".jpg", image.astype(np.uint8), [1, quality])[1].tobytes()) == ""


@pytest.mark.parametrize("progressive", [False, True])
def test_changed_bytes_of_a_jpeg_are_nearly_always_told(progressive):
    whole = jpeg(picture(), quality=90, progressive=progressive)
    rng, told = np.random.default_rng(0), 0
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(2, len(data), 4):
            data[at] ^= int(rng.integers(1, 256))
        told += bool(jpeg_flaw(bytes(data)))
    assert told > 285


@pytest.mark.parametrize(("progressive", "kernel"), [(False, "follow_codes"), (True, "follow_progressive")])
def test_compiled_and_plain_code_say_the_same(progressive, kernel, monkeypatch):
    whole, rng = jpeg(picture(24, 16), quality=80, progressive=progressive), np.random.default_rng(1)
    compiled = getattr(jpeg_blocks, kernel)
    for _ in range(12):
        data = bytearray(whole)
        data[int(rng.integers(300, len(data)))] ^= int(rng.integers(1, 256))
        said = jpeg_flaw(bytes(data))
        with monkeypatch.context() as patched:
            patched.setattr(jpeg_blocks, kernel, compiled.py_func)
            assert jpeg_flaw(bytes(data)) == said


def test_scans_of_a_progressive_jpeg_go_on_where_those_before_ended():
    whole = jpeg(picture(), quality=90, progressive=True)
    scans = list(re.finditer(rb"\xff\xda(?:[^\xff]|\xff[\x00\xd0-\xd7])+", whole))
    without = [jpeg_flaw(whole[: scan.start()] + whole[scan.end() :]) for scan in scans]
    refined = 6  # scans of all coefficients, or that later ones refine; without the others it is less sharp
    assert without == ["its markers are damaged"] * refined + [""] * (len(scans) - refined)
    assert jpeg_flaw(whole[: scans[0].start()] + b"\xff\xd9") == "no whole picture in it"


def test_jpegs_of_arithmetic_codes_are_no_frames():
    whole = jpeg(picture(), progressive=True)
    assert jpeg_flaw(whole.replace(b"\xff\xc2", b"\xff\xca")) == "of a kind that isn't read, SOF10"


def test_a_damaged_block_is_told_with_its_row(tmp_path):
    data = bytearray(jpeg(picture(160, 120), quality=90))
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    (tmp_path / "000000.jpg").write_bytes(data)
    with pytest.raises(CaptureError, match=r"000000\.jpg: damaged or truncated \(.* in row \d+ of 8 of its blocks\)"):
        read_image(tmp_path / "000000.jpg")


@given(st.integers(33, 2000), st.integers(1, 255))
@settings(deadline=None)
def test_any_changed_byte_of_a_png_is_told(tmp_path_factory, at, by):
    file = tmp_path_factory.mktemp("png") / "a.png"
    data = bytearray(cv2.imencode(".png", picture())[1].tobytes())
    data[at] ^= by
    file.write_bytes(data)
    with pytest.raises(CaptureError, match=r"a\.png: "):
        read_image(file)


def claiming(width, height):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("size", "said"), [((60000, 60000), "claims 60000×60000"), ((0, 72), "truncated or no image")])
def test_sizes_that_cant_be(tmp_path, size, said):
    (tmp_path / "a.png").write_bytes(claiming(*size))
    for read in (image_size, read_image):
        with pytest.raises(CaptureError, match=said):
            read(tmp_path / "a.png")


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_sizes_are_those_of_the_pictures_that_are_read(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(picture()).save(tmp_path / "a.jpg", exif=exif)
    height, width = read_image(tmp_path / "a.jpg").shape[:2]
    assert image_size(tmp_path / "a.jpg") == (width, height)


def test_headers_of_other_formats(tmp_path):
    for ending in ("bmp", "tif", "webp"):
        Image.fromarray(picture()).save(tmp_path / f"a.{ending}")
        assert read_image(tmp_path / f"a.{ending}").shape == (50, 70, 3)
    assert image_header(io.BytesIO(b"no picture at all, whatever it is called")) is None


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_deep_pictures_are_scaled_by_the_bits_that_the_camera_uses(tmp_path, bits):
    image = picture().astype(np.uint16)
    image[0, 0], image[0, 1] = 255, 0
    files = []
    for k, brightness in enumerate((1.0, 0.05)):  # of a dark frame the camera has no fewer bits
        deep = np.rint(image * brightness * ((1 << bits) - 1) / 255).astype(np.uint16)
        files.append(tmp_path / f"{k:06d}.png")
        cv2.imwrite(str(files[-1]), cv2.cvtColor(deep, cv2.COLOR_RGB2BGR))
    folder = ImageFolder(tuple(files))
    assert folder.bits == bits
    assert np.abs(folder.read(0).astype(int) - image).max() <= 1
    assert np.abs(folder.read(1) - 0.05 * image).max() <= 1
    with pytest.raises(CaptureError, match="save all alike"):
        read_image(files[0], bits=8)


def test_frames_of_a_short_recording_are_decoded_once(tmp_path, monkeypatch):
    files = tuple(tmp_path / f"{k:06d}.png" for k in range(3))
    for k, file in enumerate(files):
        Image.fromarray(np.roll(picture(), k, axis=0)).save(file)
    folder = ImageFolder(files)
    first = folder.read(2)
    first[:] = 0  # what a reader does to its frame nobody else sees
    files[2].unlink()
    np.testing.assert_array_equal(folder.read(2), np.roll(picture(), 2, axis=0))
    copied = pickle.loads(pickle.dumps(folder))  # files, no pictures, go to other processes
    assert copied == folder
    with pytest.raises(CaptureError, match="000002"):
        copied.read(2)
    monkeypatch.setattr("geomocap.files.kept_frames.KEPT", 2 * picture().nbytes)
    long = ImageFolder(files)
    long.read(1)
    files[1].unlink()
    with pytest.raises(CaptureError, match="000001"):
        long.read(1)


def test_pictures_of_real_numbers_are_refused(tmp_path):
    Image.fromarray(picture()[..., 0].astype(np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(CaptureError, match=r"a\.tif: "):
        read_image(tmp_path / "a.tif")
