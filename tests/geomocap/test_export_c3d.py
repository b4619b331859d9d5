import numpy as np
import pytest

from geomocap.export.c3d import read_c3d, write_c3d
from geomocap.export.export_errors import MotionError
from geomocap.export.markers import Markers, markers_from_run
from geomocap.export.skeleton_motion import motion_from_skeleton
from tests.geomocap.articulated import articulated_skeleton, skeleton_arrays, skeleton_of

ezc3d = pytest.importorskip("ezc3d")


def with_gap(markers):
    positions = markers.positions.copy()
    positions[3:6, 1] = np.nan
    residuals = np.full(positions.shape[:2], 0.0042)
    residuals[0, 0] = np.nan
    return Markers(markers.names, positions, markers.fps, markers.up, residuals, markers.descriptions)


def test_points_read_back_by_ezc3d(tmp_path):
    arrays = skeleton_arrays()
    markers = with_gap(markers_from_run(skeleton_of(arrays)))
    write_c3d(tmp_path / "m.c3d", markers, motion_from_skeleton(skeleton_of(arrays)))
    file = ezc3d.c3d(str(tmp_path / "m.c3d"))
    point = file["parameters"]["POINT"]
    assert point["LABELS"]["value"] == list(arrays["joint_names"])
    assert point["DESCRIPTIONS"]["value"][0] == "joint between body00 and body01"
    assert point["UNITS"]["value"] == ["mm"]
    assert (point["X_SCREEN"]["value"], point["Y_SCREEN"]["value"]) == (["+X"], ["+Z"])
    assert point["RATE"]["value"][0] == 15
    np.testing.assert_allclose(file["data"]["points"][:3].transpose(2, 1, 0) / 1000, markers.positions, atol=1e-6)
    residuals = file["data"]["meta_points"]["residuals"][0].T
    assert (residuals[3:6, 1] == -1).all()
    assert residuals[0, 0] == 0
    assert residuals[10, 2] == pytest.approx(4.2, abs=0.02)


def test_rotations_of_bodies_read_back(tmp_path):
    arrays = skeleton_arrays()
    motion = motion_from_skeleton(skeleton_of(arrays))
    write_c3d(tmp_path / "m.c3d", markers_from_run(skeleton_of(arrays)), motion)
    file = ezc3d.c3d(str(tmp_path / "m.c3d"))
    assert file["parameters"]["ROTATION"]["LABELS"]["value"] == list(motion.names)
    assert file["parameters"]["ROTATION"]["RATE"]["value"][0] == 15
    transforms = file["data"]["rotations"].transpose(3, 2, 0, 1)
    np.testing.assert_allclose(transforms[..., :3, :3], arrays["body_rotations"][:, motion.bodies], atol=1e-6)
    np.testing.assert_allclose(transforms[..., :3, 3] / 1000, motion.forward_kinematics()[1], atol=1e-6)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_there_and_back(tmp_path, up):
    markers = with_gap(markers_from_run(articulated_skeleton(), up=up))
    write_c3d(tmp_path / "m.c3d", markers)
    back = read_c3d(tmp_path / "m.c3d")
    assert back.up == "z"
    height = markers.positions[..., "xyz".index(up)]
    np.testing.assert_allclose(back.positions[..., 2], height, atol=1e-6)
    assert back.residuals[3, 0] == pytest.approx(0.0042, abs=2e-5)
    assert np.isnan(back.residuals[4, 1])


def test_more_labels_than_a_parameter_holds(tmp_path):
    names = tuple(f"ellipsoid{k:03d}" for k in range(300))
    positions = np.random.default_rng(0).normal(size=(4, 300, 3))
    write_c3d(tmp_path / "m.c3d", Markers(names, positions, 15.0))
    back = read_c3d(tmp_path / "m.c3d")
    assert back.names == names
    np.testing.assert_allclose(back.positions, positions, atol=1e-6)


def test_fractional_rates_are_kept(tmp_path):
    write_c3d(tmp_path / "m.c3d", Markers(("a",), np.zeros((3, 1, 3)), 29.97))
    assert read_c3d(tmp_path / "m.c3d").fps == pytest.approx(29.97)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "no C3D file"),
        (b"hello", "no C3D file"),
        (b"\x02\x50" + bytes(600), "no readable C3D file|UNITS|no markers"),
    ],
)
def test_broken_files(tmp_path, content, says):
    (tmp_path / "m.c3d").write_bytes(content)
    with pytest.raises(MotionError, match=says) as caught:
        read_c3d(tmp_path / "m.c3d")
    assert "m.c3d" in str(caught.value)


def test_unknown_units_repeated_names_and_no_points(tmp_path):
    def write(**change):
        file = ezc3d.c3d()
        labels = change.get("labels", ("a", "b"))
        file["parameters"]["POINT"]["RATE"]["value"] = [change.get("rate", 15)]
        file["parameters"]["POINT"]["LABELS"]["value"] = labels
        file["parameters"]["POINT"]["UNITS"]["value"] = [change.get("unit", "mm")]
        file["data"]["points"] = np.ones((4, len(labels), change.get("frames", 4)))
        file.write(str(tmp_path / "m.c3d"))
        return read_c3d(tmp_path / "m.c3d")

    assert write().names == ("a", "b")
    with pytest.raises(MotionError, match="UNITS is 'furlong'"):
        write(unit="furlong")
    with pytest.raises(MotionError, match="two are called a"):
        write(labels=("a", "a"))


def test_missing_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ezc3d", None)
    with pytest.raises(MotionError, match=r'need the package ezc3d; install it with: pip install "geomocap\[c3d\]"'):
        write_c3d(tmp_path / "m.c3d", markers_from_run(articulated_skeleton()))
