"""COLMAP models, read as COLMAP reads them, but with their length in mind."""

from __future__ import annotations

import struct

import numpy as np
import pycolmap
import pytest

from geomocap.errors import CalibrationError
from geomocap.files.colmap_model import read_colmap_model
from geomocap.files.rigs import colmap_model, read_rig
from geomocap.model.rig import Rig
from tests.small_files import rig


@pytest.fixture(scope="module")
def reconstruction():
    """A model with points, as structure from motion makes it."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 3, 40
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_models_are_read_as_colmap_reads_them(reconstruction, tmp_path, kind):
    getattr(reconstruction, f"write_{kind}")(str(tmp_path))
    found = read_colmap_model(tmp_path)
    assert set(found.cameras) == set(reconstruction.cameras.keys())
    for key, camera in reconstruction.cameras.items():
        mine = found.cameras[key]
        assert (mine.model, mine.width, mine.height) == (camera.model, camera.width, camera.height)
        np.testing.assert_allclose(mine.params, camera.params, rtol=1e-12)
    by_name = {image.name: image for image in found.images}
    assert len(by_name) == len(reconstruction.images)
    for image in reconstruction.images.values():
        assert by_name[image.name].camera == image.camera_id
        np.testing.assert_allclose(by_name[image.name].pose, image.cam_from_world().matrix(), atol=1e-12)


def test_files_that_claim_more_than_they_hold_are_refused(tmp_path):
    colmap_model(rig()).write_binary(str(tmp_path))
    for name in ("cameras", "images"):
        file = tmp_path / f"{name}.bin"
        whole = file.read_bytes()
        file.write_bytes(struct.pack("<Q", 1 << 60) + whole[8:])
        with pytest.raises(CalibrationError, match=rf"{name}\.bin: claims 1,152,921,504,606,846,976 {name}"):
            read_rig(tmp_path)
        file.write_bytes(whole[: len(whole) * 2 // 3])
        with pytest.raises(CalibrationError, match=rf"{name}\.bin: (ends too early|claims)"):
            read_rig(tmp_path)
        file.write_bytes(whole)
    (tmp_path / "points3D.bin").write_bytes(b"\xff" * 9)  # points, rigs and frames aren't needed
    assert read_rig(tmp_path).names == ("cam0", "cam1", "cam2")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (" OPENCV ", " WIDEEYE ", "line 4: camera 1 has a lens model that isn't known, 'WIDEEYE'"),
        (" 320 ", " -320 ", "can't be"),
        (" 320 ", " 1000000000000 ", "can't be"),
        (" 300 ", " nan ", "cam0: its interior orientation holds numbers that are not finite"),
        (" 300 ", " 0 ", "focal lengths 0, 302 must be positive"),
        (" 300 ", " 1e-9 ", "focal lengths"),
        (" 161 ", " 99999 ", "principal point"),
        (" -0.1", " -99.1", "its distortion can't be removed"),
        (" 161 119 ", " 161 ", "7 numbers for the lens model OPENCV, expected 8"),
        ("1 OPENCV", "x OPENCV", "expected a whole number, got 'x'"),
    ],
)
def test_cameras_that_cant_be(tmp_path, old, new, said):
    colmap_model(rig()).write_text(str(tmp_path))
    file = tmp_path / "cameras.txt"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=said):
        read_rig(tmp_path)


def posed(turned: np.ndarray) -> Rig:
    whole = rig()
    return Rig(whole.names, whole.cameras, np.concatenate([turned, whole.cam_from_world[:, :, 3:]], axis=2))


@pytest.mark.parametrize(("digits", "noted"), [(6, False), (4, True), (3, True)])
def test_published_rotations_of_few_digits_are_taken(digits, noted):
    exact = rig().cam_from_world[:, :, :3]
    found = posed(np.round(exact, digits))
    R = found.cam_from_world[:, :, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-14)
    assert np.abs(R - exact).max() <= 10.0**-digits
    assert bool(found.notes) is noted
    assert found.select(["cam1"]).notes == found.notes


def test_exact_rotations_stay_as_they_are():
    exact = rig()
    np.testing.assert_array_equal(posed(exact.cam_from_world[:, :, :3]).cam_from_world, exact.cam_from_world)
    assert exact.notes == ()


def test_what_is_no_rotation_is_refused():
    exact = rig().cam_from_world[:, :, :3]
    for wrong, said in ((exact * 1.01, "not orthonormal"), (exact * -1, "mirrors"), (exact * np.nan, "finite")):
        with pytest.raises(CalibrationError, match=f"camera cam0: .*{said}"):
            posed(wrong)


def test_a_camera_beyond_the_world_is_refused():
    whole = rig()
    poses = np.array(whole.cam_from_world)
    poses[1, 0, 3] = 1e30
    with pytest.raises(CalibrationError, match=r"camera cam1: its translation .* can't be metres"):
        Rig(whole.names, whole.cameras, poses)
    with pytest.raises(CalibrationError, match=r"a\.toml: .*name of camera '\.\./x'"):
        Rig.of_file("a.toml", ("../x", "b", "c"), whole.cameras, whole.cam_from_world)
