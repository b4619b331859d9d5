"""The cloud stage: what bounds it, what it writes, what it says."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest

from geomocap.config import load_config
from geomocap.dense.dense_settings import CloudSettings
from geomocap.errors import GeometryError, RunError
from geomocap.files.capture import Capture, CaptureInfo, write_capture_info
from geomocap.files.rigs import write_rig
from geomocap.files.run import Run
from geomocap.pipeline import Job, clouds, read_cloud_record
from geomocap.pipeline.cloud_stage import bounds_of, measure_again
from geomocap.pipeline.segmentation_stage import segment
from geomocap.pipeline.sources import CloudFrames
from geomocap.scheduling import threads
from tests.geomocap.ball import Texture, off_surface, photograph, ring

BOX = ((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6))
COARSE = {"cloud": {"growing": {"step": 4.0, "radius": 4}}}


def make_capture(path: Path, frames: int = 1, masks: bool = False, cameras: int = 3, arc_deg: float = 40.0) -> Capture:
    rig = ring(cameras, arc_deg)
    write_capture_info(path, CaptureInfo(name="ball", fps=10.0, region_of_interest=BOX))
    write_rig(path / "sparse", rig)
    for k in range(frames):
        images, silhouettes = photograph(rig, Texture.random(), seed=k)
        for name, image, mask in zip(rig.names, images, silhouettes, strict=True):
            for folder, picture in (("images", image), ("masks", np.uint8(mask) * 255)):
                if folder == "images" or masks:
                    (path / folder / name).mkdir(parents=True, exist_ok=True)
                    cv2.imwrite(str(path / folder / name / f"{k:06d}.png"), picture)
    return Capture.open(path)


def measure(capture: Capture, run: Run, overrides: dict | None = None) -> None:
    with threads(1) as executor:
        clouds(Job(run, load_config(overrides=overrides or COARSE), executor, capture=capture, fps=capture.fps))


@pytest.mark.parametrize("masks", [False, True])
def test_one_frame_with_and_without_silhouettes(tmp_path: Path, masks: bool) -> None:
    capture, run = make_capture(tmp_path / "capture", masks=masks), Run(tmp_path / "run")
    measure(capture, run)
    assert (run.path / "silhouettes").exists() == masks
    frames = CloudFrames(run, 1)
    points, colors = frames.points(0), frames.features(0)
    assert len(points) > 1000 and colors.shape == points.shape and 0 < colors.mean() < 1
    assert np.mean(off_surface(points) < 5 * 2.0 / 2500) > 0.98
    normals = frames.normals(0)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    towards = capture.rig.centers[:, None] - points
    assert ((towards * normals).sum(axis=2) > 0).any(axis=0).all()
    record = read_cloud_record(run)
    assert record is not None and record.frames == 1 and record.points == len(points)
    assert record.reasons["matched"] == len(points) and not record.warnings
    # The same frame measured again is the same
    again = measure_again(run, capture, 0)
    assert again is not None
    again, _ = again
    np.testing.assert_allclose(again.points.positions, points, atol=1e-6)


def test_clouds_without_silhouettes_give_bodies(tmp_path: Path) -> None:
    capture, run = make_capture(tmp_path / "capture", frames=3), Run(tmp_path / "run")
    with threads(1) as executor:
        segment(Job(run, load_config(overrides=COARSE), executor, capture=capture, fps=capture.fps), "cloud")
    assert run.has("skeleton.npz") and not run.has("silhouettes")


def test_bounds_are_what_the_capture_allows(tmp_path: Path) -> None:
    settings = CloudSettings()
    assert bounds_of(make_capture(tmp_path / "bare"), settings) == "none"
    assert bounds_of(make_capture(tmp_path / "masks", masks=True), settings) == "silhouettes"
    assert bounds_of(make_capture(tmp_path / "four", masks=True, cameras=4), settings) == "hull"
    assert bounds_of(make_capture(tmp_path / "long", frames=10), settings) == "silhouettes"
    forced = settings.model_copy(update={"bounds": "none"})
    assert bounds_of(Capture.open(tmp_path / "four"), forced) == "none"


def test_what_is_wrong_with_a_camera_is_recorded(tmp_path: Path) -> None:
    capture, run = make_capture(tmp_path / "capture", frames=2), Run(tmp_path / "run")
    for k in range(2):
        file = tmp_path / "capture" / "images" / "cam2" / f"{k:06d}.png"
        cv2.imwrite(str(file), np.zeros((224, 288), np.uint8))
    measure(capture, run)
    record = read_cloud_record(run)
    assert record is not None and [(w[:4], n) for w, n in record.warnings.items()] == [("came", 2)]
    assert "cam2: nothing matches" in next(iter(record.warnings))


def test_warnings_that_differ_in_figures_are_one(tmp_path: Path) -> None:
    folder = tmp_path / "cloud"
    folder.mkdir()
    for k, px in enumerate((0.41, 0.52)):
        record = {"points": 3, "reasons": {"matched": 3}, "warnings": [f"leave their lines by {px} px"]}
        (folder / f"{k:06d}.json").write_text(json.dumps(record))
    found = read_cloud_record(Run(tmp_path))
    assert found is not None and found.warnings == {"leave their lines by 0.41 px": 2} and found.points == 6
    (folder / "000001.json").write_text("{")
    with pytest.raises(RunError, match=r"000001\.json"):
        read_cloud_record(Run(tmp_path))
    assert read_cloud_record(Run(tmp_path / "none")) is None


def test_a_frame_without_points_is_an_error_that_says_why(tmp_path: Path) -> None:
    capture, run = make_capture(tmp_path / "capture"), Run(tmp_path / "run")
    for name in capture.cameras:
        cv2.imwrite(str(tmp_path / "capture" / "images" / name / "000000.png"), np.zeros((224, 288), np.uint8))
    with pytest.raises(GeometryError, match="frame 0: no surface point"):
        measure(capture, run)
    assert not (run.path / "cloud" / "000000.ply").exists()


def test_clouds_without_colours_or_normals_say_so(tmp_path: Path) -> None:
    file = tmp_path / "cloud" / "000000.ply"
    file.parent.mkdir()
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.zeros((3, 3), np.float32)))
    o3d.t.io.write_point_cloud(str(file), cloud)
    with pytest.raises(GeometryError, match="no colours"):
        CloudFrames(Run(tmp_path), 1).features(0)
    with pytest.raises(GeometryError, match="no normals"):
        CloudFrames(Run(tmp_path), 1).normals(0)
