"""`geomocap view` and `info` take motion files and calibrations of other programs."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
import tomli_w

from data_tools import calibration_files as formats
from geomocap.cli.view_command import _content
from geomocap.errors import GeomocapError
from geomocap.files.images import write_image
from geomocap.files.rigs import write_rig
from tests.small_files import mesh, rig

WRITERS = {
    "aniposelib.toml": formats.write_aniposelib,
    "caliscope.toml": formats.write_caliscope,
    "pose2sim.toml": formats.write_pose2sim,
    "opencv": formats.write_opencv,
    "easymocap": formats.write_easymocap,
    "colmap": formats.write_colmap,
}


@pytest.mark.parametrize("name", WRITERS)
def test_calibrations_of_all_tools_are_shown(name, tmp_path, geomocap):
    expected = rig(4)
    WRITERS[name](expected, tmp_path / name)
    content = _content(tmp_path / name)
    assert content.rig is not None and content.rig.names == expected.names
    np.testing.assert_allclose(content.rig.centers, expected.centers, atol=1e-6)
    assert len(content.stage.points) and content.stage.diagonal > 0
    files = [f for f in (tmp_path / name).glob("*.yml")] if name in ("opencv", "easymocap") else []
    for file in files:  # one file of several
        assert _content(file).rig.names == expected.names
    assert geomocap("info", tmp_path / name).returncode == 0


def test_calibrations_of_qualisys_and_one_camera_are_shown(data, tmp_path):
    file = data / "captures" / "pose2sim_single" / "calibration" / "Calib.qca.txt"
    assert len(_content(file).rig) == 4
    formats.write_aniposelib(rig(3).select(["cam1"]), tmp_path / "one.toml")
    alone = _content(tmp_path / "one.toml")
    assert len(alone.rig) == 1 and alone.stage.diagonal > 0
    assert len(_content(data / "captures" / "caliscope_charuco" / "config.toml").stage.points)  # poses not known yet


def test_a_calibration_in_millimetres_is_shown_when_that_is_said(tmp_path):
    formats.write_aniposelib(rig(3), tmp_path / "c.toml")
    content = tomllib.loads((tmp_path / "c.toml").read_text())
    for table in content.values():
        if "translation" in table:
            table["translation"] = [1000 * value for value in table["translation"]]
    (tmp_path / "c.toml").write_text(tomli_w.dumps(content))
    with pytest.raises(GeomocapError, match="millimetres"):
        _content(tmp_path / "c.toml")
    np.testing.assert_allclose(_content(tmp_path / "c.toml", 0.001).rig.centers, rig(3).centers, atol=1e-6)


def test_animated_files_and_still_meshes_are_shown(tmp_path):
    for ending in ("glb", "gltf"):
        still = _content(mesh(f"a.{ending}")(tmp_path))
        assert still.n_frames == 1 and len(still.surface.faces) == 80


@pytest.mark.parametrize("name", ["settings.toml", "a.json", "a.yml", "empty", "none.toml", "a.glb"])
def test_what_is_no_calibration_is_told_in_one_line(name, tmp_path):
    (tmp_path / "empty").mkdir()
    if name not in ("empty", "none.toml"):
        (tmp_path / name).write_text('{"a": 1}' if name == "a.json" else "")
    with pytest.raises(GeomocapError, match=name) as told:
        _content(tmp_path / name)
    assert "\n" not in str(told.value)


def test_what_is_not_shown_is_told_with_what_is(tmp_path):
    (tmp_path / "motion.urdf").write_text("<robot/>")
    with pytest.raises(GeomocapError, match=r"motion\.urdf: no kind of file that is shown; these are: .*\.bvh.*\.ply"):
        _content(tmp_path / "motion.urdf")
    (tmp_path / "take" / "run").mkdir(parents=True)
    (tmp_path / "take" / "run" / "run.toml").write_text("")
    with pytest.raises(GeomocapError, match=r"take: neither a run, .* nor scans; look into run"):
        _content(tmp_path / "take")


def test_a_capture_is_shown_by_its_file_too(tmp_path):
    write_rig(tmp_path / "sparse", rig(2))
    (tmp_path / "capture.toml").write_text('name = "x"\nfps = 10.0\nup = "z"\n')
    for camera in rig(2).names:
        write_image(tmp_path / "images" / camera / "000000.png", np.zeros((240, 320, 3), np.uint8))
    content = _content(tmp_path / "capture.toml")
    assert content.rig is not None and content.rig.names == rig(2).names
