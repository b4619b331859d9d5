"""The calibration report: every camera and warning is on the page, and the pictures show something."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from geomocap.calibration.bar_calibration import Calibration, calibrate_bar
from geomocap.calibration.calibration_settings import BarSettings
from tests.geomocap.bar_scenes import eight_cameras, joined, knocked, seen, three_cameras
from viz.calibration_report import write_calibration_report


@pytest.fixture(scope="module")
def calibrations() -> list[Calibration]:
    out = []
    for scene in (three_cameras(4, 40), eight_cameras(4, 40)):
        rng = np.random.default_rng(0)
        observations = seen(scene, rng, 0.05)
        if len(scene.rig) == 3:
            observations = joined(observations, seen(knocked(scene, 1, 2.0, 0.01), rng, 0.05), 20)
        out.append(calibrate_bar(observations, scene.length, BarSettings()))
    return out


@pytest.mark.parametrize("which", [0, 1])
def test_page_and_pictures(calibrations: list[Calibration], which: int, tmp_path: Path) -> None:
    calibration = calibrations[which]
    page = write_calibration_report(calibration, tmp_path / "calibration")
    words = page.read_text()
    assert calibration.verdict.grade in words
    for name in calibration.rig.names:
        assert f"{name}</td>" in words
    assert ("was moved between frames" in words) == (which == 0)
    assert 'src="http' not in words and words.count("data:image/webp") == 4
    for name in ("layout", "residuals", "coverage", "lengths"):
        picture = cv2.imread(str(page.parent / f"{name}.png"))
        assert picture is not None and min(picture.shape[:2]) > 300
        assert 0.01 < (picture.min(axis=2) < 240).mean() < 0.9
    assert sorted(p.name for p in page.parent.iterdir()) == [
        "coverage.png",
        "layout.png",
        "lengths.png",
        "report.html",
        "residuals.png",
    ]
