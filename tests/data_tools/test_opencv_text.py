"""OpenCV's files, read as OpenCV reads them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from data_tools.calibration_files.opencv_text import read_opencv_file
from geomocap.errors import CalibrationError

FLOATS = arrays(float, st.tuples(st.integers(1, 4), st.integers(1, 5)), elements=st.floats(-1e9, 1e9))


@given(FLOATS, st.sampled_from(["yml", "xml", "json"]))
@settings(deadline=None)
def test_matrices_come_back_in_all_three_formats(tmp_path_factory, matrix, ending):
    file = tmp_path_factory.mktemp("cv") / f"a.{ending}"
    storage = cv2.FileStorage(str(file), cv2.FileStorage_WRITE)
    storage.write("K", matrix)
    storage.write("image_width", 640)
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    for name in ("01", "cam b"):
        storage.write("", name)
    storage.endWriteStruct()
    storage.write("name", 'quo"ted: # [x]')
    storage.write("after", 3)
    storage.release()
    found = read_opencv_file(file)
    np.testing.assert_array_equal(found.matrix("K"), matrix)
    assert found.number("image_width") == 640 and found.number("after") == 3 and found.number("none") == 0
    assert found.texts("names") == ["01", "cam b"] and found.matrix("none") is None


HAND_WRITTEN = """%YAML:1.0
---
# made by hand
names:
- "1"
- 2
K_1: !!opencv-matrix
   rows: 2
   cols: 2
   dt: d
   data: [ 1., .5,   # a comment
      -3e+00, 4 ]
T_1: [1, 2, 3]
R_1: { rows: 1, cols: 1, data: 3 }
nested:
   deeper:
      - { a: 1, b: [1, 2] }
      - x
"""


def test_what_people_write(tmp_path):
    (tmp_path / "a.yml").write_text(HAND_WRITTEN)
    found = read_opencv_file(tmp_path / "a.yml")
    assert found.texts("names") == ["1", "2"]
    np.testing.assert_array_equal(found.matrix("K_1"), [[1, 0.5], [-3, 4]])
    np.testing.assert_array_equal(found.matrix("T_1"), [1, 2, 3])
    np.testing.assert_array_equal(found.matrix("R_1"), [[3]])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rows: 2", "rows: 1000000000", "K_1 has 4 numbers for 1000000000×2"),
        ("-3e+00", "abc", "K_1 is no matrix of numbers"),
        ("-3e+00, 4 ]", "-3e+00, 4", "isn't closed|no readable"),
        ("names:", "x: " + "[" * 100000 + "\nnames:", "nested too deeply|closed"),
        ("names:", "  names:", "indentation"),
        ("names:", "{{{{", "no readable OpenCV file"),
        (
            "   deeper:",
            "".join(f"{' ' * (3 + k)}k{k}:\n" for k in range(40)) + " " * 50 + "deeper:",
            "nested too deeply",
        ),
    ],
)
def test_damaged_ones_are_refused(tmp_path, old, new, said):
    (tmp_path / "a.yml").write_text(HAND_WRITTEN.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=r"a\.yml: .*" + f"(?:{said})"):
        read_opencv_file(tmp_path / "a.yml").matrix("K_1")


def test_xml_with_entities_is_refused(tmp_path):
    (tmp_path / "a.xml").write_text('<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b">]><opencv_storage/>')
    with pytest.raises(CalibrationError, match="document type"):
        read_opencv_file(tmp_path / "a.xml")
