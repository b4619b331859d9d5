"""Each mistake ends with one clear line and a status that is not zero, and nothing finished is lost."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pycolmap
import pytest

from geomocap.files.capture import Capture
from geomocap.files.rigs import read_rig, write_rig
from geomocap.model.rig import Rig
from tests.cli.conftest import SETTINGS, last_line


def refused(result) -> str:
    assert result.returncode == 1
    return last_line(result)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "a", "b", "--fpx", "3"], "no such option: --fpx; try `geomocap run --help`"),
        (["run", "a"], "missing argument 'RUN'; try `geomocap run --help`"),
        (["run", "a", "b", "--workers"], "option '--workers' requires an argument; try `geomocap run --help`"),
        (
            ["segment", "a", "b", "--fps", "0"],
            "'--fps': must be greater than or equal to 0.001; try `geomocap segment --h",
        ),
        (
            ["run", "a", "b", "--source", "clouds"],
            "'clouds' is not one of 'voxels', 'cloud'; try `geomocap run --help`",
        ),
        (["walk"], "no such command 'walk'; try `geomocap --help`"),
        (["--walk"], "no such option: --walk; try `geomocap --help`"),
    ],
)
def test_wrong_usage_is_said_in_one_line(geomocap, arguments, said):
    result = geomocap(*arguments, check=False)
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith("geomocap: ") and said in line


def test_help_and_version_are_no_mistakes(geomocap):
    for arguments in (["--version"], ["--help"], ["run", "--help"]):
        assert geomocap(*arguments).stderr == ""
    assert geomocap(check=False).returncode == 2  # no command: the help is told


def test_missing_capture(geomocap, tmp_path):
    assert "no such capture folder" in refused(geomocap("run", tmp_path / "none", tmp_path / "run", check=False))


def test_missing_camera_folder(capture, geomocap, tmp_path):
    shutil.rmtree(next((capture / "images").iterdir()))
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert "has no folder images/" in said


def test_unequal_frame_counts(capture, geomocap, tmp_path):
    folder = sorted((capture / "images").iterdir())[1]
    (folder / "000005.png").unlink()
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert "unequal numbers of frames" in said and f"{folder.name}: 5" in said


def test_image_size_against_calibration(capture, geomocap, tmp_path):
    folder = sorted((capture / "images").iterdir())[1]
    for file in folder.iterdir():
        cv2.imwrite(str(file), cv2.imread(str(file))[:100])
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert f"camera {folder.name} are 160×100, but it is calibrated for 160×120" in said


def test_truncated_png(capture, geomocap, tmp_path):
    file = sorted((capture / "images").iterdir())[1] / "000003.png"
    file.write_bytes(file.read_bytes()[:5000])
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert f"{file}: damaged or truncated" in said


def jfif_of_another_revision(image):
    """A JPEG that libjpeg reads, with a line about its marker on the error stream."""
    data = bytearray(cv2.imencode(".jpg", image)[1].tobytes())
    data[data.index(b"JFIF\0") + 5] = 9
    return bytes(data)


def no_pixels(image):
    """A PNG whose parts have right checksums, but no picture in them: libpng says so by itself, too."""
    png = cv2.imencode(".png", image)[1].tobytes()
    begin, end = png.index(b"IDAT"), png.index(b"IEND") - 4
    part = b"IDAT" + bytes(20)
    return png[: begin - 4] + struct.pack(">I", 20) + part + struct.pack(">I", zlib.crc32(part)) + png[end:]


def huge_bitmap(image):
    """Claims a hundred million pixels, of which Pillow warns."""
    bitmap = bytearray(cv2.imencode(".bmp", image)[1].tobytes())
    bitmap[18:26] = struct.pack("<ii", 10_000, 10_000)
    return bytes(bitmap)


@pytest.mark.parametrize(
    ("made", "said"),
    [(jfif_of_another_revision, 0), (no_pixels, 1), (huge_bitmap, 1)],
    ids=["jfif", "png", "bitmap"],
)
def test_libraries_say_nothing_beside_the_one_line(capture, tmp_path, made, said):
    folder = sorted((capture / "images").iterdir())[1]
    for file in folder.iterdir():
        file.write_bytes(made(cv2.imread(str(file))))
    command = [sys.executable, "-m", "geomocap", "silhouettes", str(capture), str(tmp_path / "run")]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == said
    beside = [line for line in result.stderr.splitlines() if line.strip() and "━" not in line]
    assert [line for line in beside if not line.startswith(("geomocap: ", "warning: ", "note: "))] == []
    assert sum(line.startswith("geomocap: ") for line in beside) == said


def test_truncated_video(capture, geomocap, tmp_path):
    folder = sorted((capture / "images").iterdir())[1]
    shutil.rmtree(folder)
    (capture / "videos").mkdir()
    file = capture / "videos" / f"{folder.name}.mp4"
    file.write_bytes(b"\0\0\0\x18ftypmp42" + bytes(500))
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert f"{file}: no readable video" in said


@pytest.mark.parametrize("frames", [[3], range(6)], ids=["in a frame", "in a camera"])
def test_empty_silhouettes(capture, small_capture, geomocap, tmp_path, frames):
    shutil.copytree(small_capture.parent / "truth" / "masks", capture / "masks")
    folder = sorted((capture / "masks").iterdir())[2]
    for k in frames:
        cv2.imwrite(str(folder / f"{k:06d}.png"), np.zeros((120, 160), np.uint8))
    strict = ["--carving.hull.outside", "empty"]
    said = refused(geomocap("voxels", capture, tmp_path / "run", *SETTINGS, *strict, check=False))
    assert f"frame {next(iter(frames))}: the silhouette of camera {folder.name} is empty" in said
    assert f"check {folder / f'{next(iter(frames)):06d}.png'} (expected: 255" in said
    ended = geomocap("voxels", capture, tmp_path / "run", *SETTINGS, check=False)
    assert ended.returncode == (0 if len(frames) == 1 else 1)
    if ended.returncode:
        assert f"camera {folder.name}: its silhouettes are empty, or nearly so, in all 6 frames" in last_line(ended)


def test_missing_given_mask(capture, small_capture, geomocap, tmp_path):
    shutil.copytree(small_capture.parent / "truth" / "masks", capture / "masks")
    file = sorted((capture / "masks").iterdir())[2] / "000002.png"
    file.unlink()
    assert str(file) in refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))


def test_camera_looking_away(capture, geomocap, tmp_path):
    rig = read_rig(capture / "sparse")
    poses = np.array(rig.cam_from_world)
    poses[1] = np.diag([1.0, -1.0, -1.0]) @ poses[1]  # turned by 180° about its x axis
    shutil.rmtree(capture / "sparse")
    write_rig(capture / "sparse", Rig(rig.names, rig.cameras, poses))
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    # nobody confirms what it sees, so nothing is left of it; where the others still agree with it they say so
    assert f"camera {rig.names[1]}" in said and "its pose" in said


def test_subject_outside_the_volume(capture, geomocap, tmp_path):
    said = refused(
        geomocap("voxels", capture, tmp_path / "run", "--carving.volume", "[[0, 0, 0], [1, 1, 1]]", check=False)
    )
    assert "volume" in said and "frame" in said


def test_no_calibration(capture, geomocap, tmp_path):
    shutil.rmtree(capture / "sparse")
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert "not calibrated" in said and "geomocap calibrate" in said


def test_damaged_calibration(capture, geomocap, tmp_path):
    (capture / "sparse" / "images.txt").write_text("nonsense\n")
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert "sparse" in said


def test_calibration_that_lacks_a_camera(capture, geomocap, tmp_path):
    rig = read_rig(capture / "sparse")
    shutil.rmtree(capture / "sparse")
    write_rig(capture / "sparse", rig.select(rig.names[:-1]))
    said = refused(geomocap("run", capture, tmp_path / "run", *SETTINGS, check=False))
    assert f"no posed image of camera {rig.names[-1]}" in said


def test_unknown_setting(capture, geomocap, tmp_path):
    (tmp_path / "a.toml").write_text("[carving]\nresolutoin = 64\n")
    result = geomocap("run", capture, tmp_path / "run", "--config", tmp_path / "a.toml", check=False)
    assert "unknown setting carving.resolutoin" in refused(result)


def test_settings_file_of_a_command_with_settings_of_its_own(geomocap, tmp_path):
    (tmp_path / "a.toml").write_text("frames = 1\ncameras = 2\nwidth = 64\nheight = 48\n")
    geomocap("synthesize", "figure", tmp_path / "made", "--config", tmp_path / "a.toml", "--cameras", 3)
    made = Capture.open(tmp_path / "made")
    assert (made.n_frames, len(made.cameras)) == (1, 3)  # a flag goes before the file
    (tmp_path / "a.toml").write_text("[carving]\nresolution = 64\n")
    result = geomocap("synthesize", "figure", tmp_path / "other", "--config", tmp_path / "a.toml", check=False)
    assert "a.toml: unknown setting carving" in refused(result)


def test_run_folder_that_can_not_be_written(capture, geomocap, tmp_path):
    (tmp_path / "file").write_text("in the way")
    said = refused(geomocap("run", capture, tmp_path / "file" / "run", *SETTINGS, check=False))
    assert "can't be written" in said


def test_run_folder_must_not_hold_the_capture(capture, geomocap):
    assert "choose another folder" in refused(geomocap("run", capture, capture.parent, check=False))


def test_no_dask_scheduler(capture, geomocap, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("geomocap.cli.execution._PATIENCE", "1s")
    said = refused(geomocap("run", capture, tmp_path / "run", "--scheduler", "tcp://127.0.0.1:1", check=False))
    assert "no Dask scheduler answers" in said


def test_pycolmap_is_the_tested_version():
    """Models of another version may read differently; the bounds of pyproject.toml keep to this one."""
    assert pycolmap.__version__.startswith("4.2")


@pytest.mark.parametrize("name", ["missing.npz", "damaged.npz"])
def test_bad_model(capture, geomocap, tmp_path, name):
    (tmp_path / "damaged.npz").write_bytes(b"no model at all")
    line = refused(geomocap("run", capture, tmp_path / "run", "--model", tmp_path / name, check=False))
    assert name in line and "model" in line


def test_model_of_the_run_itself(capture, geomocap, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    monkeypatch.setattr("geomocap.cli.jobs.read_model", lambda path: None)
    model = tmp_path / "run" / "model.npz"
    assert "another folder" in refused(geomocap("run", capture, tmp_path / "run", "--model", model, check=False))
