"""The command `calibrate`: from points to a model and a report; what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from geomocap.cli.calibrate_command import calibrate
from geomocap.errors import GeomocapError
from geomocap.files.rigs import read_rig, write_rig
from tests.geomocap.bar_scenes import three_cameras

app = typer.Typer()
app.command()(calibrate)


def run(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def points(tmp_path: Path) -> Path:
    scene = three_cameras(1, 40)
    write_rig(tmp_path / "true", scene.rig)
    pixels = scene.points(np.random.default_rng(0), 0.05)
    lines = ["frame,camera,point,x,y,sigma"]
    for c, t, e in np.ndindex(*pixels.shape[:3]):
        if np.isfinite(pixels[c, t, e, 0]):
            lines.append(f"{t},{'abc'[c]},{e},{pixels[c, t, e, 0]},{pixels[c, t, e, 1]},0.05")
    (tmp_path / "points.csv").write_text("\n".join(lines))
    return tmp_path / "points.csv"


def test_points_to_model_and_report(points: Path, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    capture.mkdir()
    common = (capture, "--points", points, "--distance", "0.5", "--align", tmp_path / "true")
    words = run(*common)
    assert "calibration of 3 cameras" in words and "report.html" in words
    true, ours = read_rig(tmp_path / "true"), read_rig(capture / "sparse")
    np.testing.assert_allclose(ours.centers, true.centers, atol=0.01)
    assert (capture / "calibration" / "report.html").stat().st_size > 50_000
    run(*common, "--no-report")  # our own calibration may be replaced
    write_rig(capture / "sparse", true)
    (capture / "sparse" / "calibration.json").unlink()
    with pytest.raises(GeomocapError, match="--force"):
        run(*common)
    run(*common, "--force", "--no-report")


def test_options_that_are_refused(points: Path, tmp_path: Path) -> None:
    for options, words in (
        (("--points", points), "needs --distance"),
        (("--points", points, "--distance", "0.5", "--floor", "a-b"), "expected frame numbers"),
        (("--points", points, "--distance", "0.5", "--ends", "0"), "two point names"),
        (("--points", points, "--distance", "0.5", "--gravity", "a:1,2"), "CAMERA:X,Y,Z"),
        (("--points", points, "--distance", "500"), r"--distance 500: .* in metres, 0\.001 to 20"),
        (("--distance", "500"), r"--distance 500: .* in metres, 0\.001 to 20"),
        ((), "no bar recording"),
    ):
        with pytest.raises(GeomocapError, match=words):
            run(tmp_path, *options)
    assert not (tmp_path / "sparse").exists()
