import csv

import numpy as np
import pytest

from geomocap.export.export_errors import MotionError
from geomocap.export.markers import Markers, markers_from_run
from geomocap.export.trc import read_trc, write_trc
from geomocap.model.keypoint_paths import KeyPointPaths, KeyPoints
from tests.geomocap.articulated import articulated_skeleton, shells_at, skeleton_arrays, skeleton_of


def markers_with_a_gap():
    markers = markers_from_run(articulated_skeleton())
    positions = markers.positions.copy()
    positions[3:6, 1] = np.nan
    return Markers(markers.names, positions, markers.fps)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_there_and_back_with_gaps(tmp_path, unit):
    markers = markers_with_a_gap()
    write_trc(tmp_path / "m.trc", markers, unit=unit)
    back = read_trc(tmp_path / "m.trc")
    assert back.names == markers.names
    assert back.fps == markers.fps
    y_up = markers.positions[..., [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(back.positions, y_up, atol=1e-6)  # NaN equals NaN here


def test_read_by_pandas(tmp_path):
    """Pandas knows nothing of TRC, only of columns and tabs."""
    pandas = pytest.importorskip("pandas")
    markers = markers_with_a_gap()
    write_trc(tmp_path / "m.trc", markers)
    table = pandas.read_csv(tmp_path / "m.trc", sep="\t", skiprows=6, header=None).to_numpy()
    values = table[:, 2:].reshape(20, 6, 3) / 1000
    np.testing.assert_allclose(values[..., [0, 2, 1]] * [1, -1, 1], markers.positions, atol=1e-6)
    np.testing.assert_allclose(table[:, 1], np.arange(20) / 15, atol=1e-6)


def test_header_says_units_rate_and_names(tmp_path):
    write_trc(tmp_path / "walk.trc", markers_with_a_gap())
    rows = list(csv.reader((tmp_path / "walk.trc").read_text().splitlines(), delimiter="\t"))
    header = dict(zip(rows[1], rows[2], strict=True))
    assert rows[0] == ["PathFileType", "4", "(X/Y/Z)", "walk.trc"]
    assert header["Units"] == "mm"
    assert (float(header["DataRate"]), int(header["NumFrames"]), int(header["NumMarkers"])) == (15, 20, 6)
    assert rows[3][2::3] == list(skeleton_arrays()["joint_names"])
    assert len(rows[3]) == len(rows[4]) == len(rows[6]) == 2 + 3 * 6


def test_markers_of_a_run_name_what_they_are():
    arrays = skeleton_arrays()
    none = np.zeros((20, 1))
    paths = KeyPointPaths(np.zeros((20, 1, 3)), none > 0, none.astype(int), none)
    keypoints = KeyPoints(("hat",), np.array([0.05]), paths, np.zeros((0, 2), int))
    ellipsoids = shells_at(np.ones((20, 2, 3)), [4, -1])
    markers = markers_from_run(skeleton_of(arrays), ellipsoids=ellipsoids, keypoints=keypoints)
    assert markers.names[-3:] == ("hat", "ellipsoid000", "ellipsoid001")
    assert markers.descriptions[-3:] == (
        "key-point, radius 50 mm",
        "centre of an ellipsoid of body04",
        "centre of an ellipsoid of no body",
    )
    with pytest.raises(MotionError, match="have \\[19, 20\\] frames"):
        markers_from_run(skeleton_of(arrays), ellipsoids=shells_at(np.ones((19, 2, 3)), [4, -1]))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda s: "", "no TRC"),
        (lambda s: s.replace("\tmm\t", "\tinch\t"), "Units is 'inch'"),
        (lambda s: s[: len(s) * 2 // 3], "the header says 20 frames"),
        (lambda s: s.replace("\n15\t15", "\n30\t15"), "DataRate says 30 frames per second, the Time column 15"),
        (lambda s: s.replace("\n15\t15", "\nfast\t15"), "lacks a number for DataRate"),
        (lambda s: s.replace("joint_body00_body01", "joint_body00_body02"), "two are called joint_body00_body02"),
        (lambda s: s.replace("\n4\t0.2", "\n4\t0.2x"), "row 4 holds something that is no number"),
    ],
)
def test_broken_files(tmp_path, change, says):
    arrays = skeleton_arrays()
    arrays["joint_names"] = np.array([f"joint_body00_body{b:02d}" for b in range(1, 7)])
    write_trc(tmp_path / "m.trc", markers_from_run(skeleton_of(arrays)))
    (tmp_path / "m.trc").write_text(change((tmp_path / "m.trc").read_text()))
    with pytest.raises(MotionError, match=says) as caught:
        read_trc(tmp_path / "m.trc")
    assert "m.trc" in str(caught.value)
