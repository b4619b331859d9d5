"""Other tools' calibrations in and out of captures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from data_tools.importing_calibrations import WRITERS, convert_calibration, import_calibration
from geomocap.errors import CalibrationError
from geomocap.files.capture import Capture
from geomocap.files.rigs import write_rig
from tests.geomocap.test_cameras import make_rig


@pytest.fixture
def capture(tmp_path):
    for name in make_rig().names:
        (tmp_path / "capture" / "images" / name).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "capture" / "images" / name / "000000.png"), np.zeros((240, 320, 3), np.uint8))
    return tmp_path / "capture"


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_converted_and_imported_cameras_are_the_same(capture, tmp_path, kind):
    rig = make_rig()
    write_rig(tmp_path / "model", rig)
    target = tmp_path / ("out" if kind in ("easymocap", "opencv", "colmap") else "out.toml")
    convert_calibration(tmp_path / "model", target, kind)
    import_calibration(target, capture, 25.0)
    opened = Capture.open(capture)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    np.testing.assert_allclose(opened.rig.project(points), rig.project(points), atol=1e-6)
    assert opened.fps == 25.0


def test_calibration_for_another_size_is_named(capture, tmp_path):
    write_rig(tmp_path / "model", make_rig())
    cv2.imwrite(str(capture / "images/cam1/000000.png"), np.zeros((200, 320, 3), np.uint8))
    with pytest.raises(CalibrationError, match="cam1 is calibrated for 320×240, but its images are 320×200"):
        import_calibration(tmp_path / "model", capture, 25.0)
    assert not (capture / "sparse").exists()


def test_calibration_is_not_overwritten(capture, tmp_path):
    write_rig(tmp_path / "model", make_rig())
    write_rig(capture / "sparse", make_rig(1))
    with pytest.raises(CalibrationError, match="has a calibration already"):
        import_calibration(tmp_path / "model", capture, 25.0)
