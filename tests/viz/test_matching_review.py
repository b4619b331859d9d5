"""Pictures of surface measurement: what is drawn is where and in the colour it should be."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from geomocap.config import load_config
from geomocap.dense.dense_frame import CloudFrame, cloud_of_frame
from geomocap.dense.dense_settings import CloudSettings
from geomocap.dense.match_groups import match_groups
from geomocap.dense.matching_images import undistorted_color
from geomocap.files.run import Run
from geomocap.pipeline import Job, clouds
from geomocap.pipeline.cloud_stage import measure_again
from geomocap.scheduling import threads
from tests.geomocap.ball import RADIUS, Texture, photograph, ring
from tests.geomocap.test_pipeline_clouds import COARSE, make_capture
from viz.body_colors import ACCENT
from viz.matching_review import (
    cloud_picture,
    cloud_sheet,
    error_sheet,
    frame_sheet,
    matched_picture,
    scale_colors,
    surface_errors,
    template_sheet,
)
from viz.review import review


@pytest.fixture(scope="module")
def measured() -> tuple[CloudFrame, np.ndarray]:
    """A measured ball and its template image."""
    rig = ring(3, 40)
    images, masks = photograph(rig, Texture.random())
    settings = CloudSettings.model_validate({"growing": {"step": 5.0, "radius": 4}})
    groups = match_groups(rig)
    return cloud_of_frame(images, masks, None, rig, groups, settings), undistorted_color(images[1], groups, 1)


def test_matched_points_are_drawn_where_they_are(measured) -> None:
    frame, image = measured
    surface = frame.templates[0].surface
    picture = matched_picture(image, surface, 600)
    blue = (np.abs(picture.astype(int) - ACCENT).sum(axis=2) < 40).sum()
    assert picture.shape[1] == 600
    assert blue > 4 * surface.seen.all(axis=1).sum()
    # The ball's outside stays a pale photograph
    assert picture[5, 5].min() > 100


def test_template_sheet_shows_three_pictures(measured) -> None:
    frame, image = measured
    picture = template_sheet(image, frame.templates[0], 300)
    assert picture.dtype == np.uint8 and picture.shape[1] > 900
    # Regions differ in colour
    assert len(np.unique(picture[:, 330:600].reshape(-1, 4), axis=0)) > 100


def test_cloud_is_drawn_from_its_side() -> None:
    points = np.array([[0.0, -1, 0], [0, 1, 0], [0.5, 0, 0.5], [-0.5, 0, -0.5]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [9, 9, 9], [9, 9, 9]], np.uint8)
    front, back = (cloud_picture(points, colors, a, 0.0) for a in (0, 180))
    middle = front.shape[0] // 2, front.shape[1] // 2
    assert front[middle].tolist() == [255, 0, 0]
    assert back[middle].tolist() == [0, 255, 0]
    # Up is up
    grey = np.argwhere((front == 9).all(axis=2))
    assert grey[:, 0].min() < middle[0] < grey[:, 0].max()
    assert (cloud_picture(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0) == 255).all()
    assert cloud_sheet(points, colors, (0, 90)).shape[1] > 600


def test_errors_have_sign_and_colour(measured) -> None:
    sphere = o3d.geometry.TriangleMesh.create_sphere(RADIUS, 60)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.triangles)
    errors = surface_errors(np.array([[0, 0, RADIUS + 0.01], [RADIUS - 0.02, 0, 0]]), vertices, faces)
    np.testing.assert_allclose(errors, [0.01, -0.02], atol=1e-3)
    assert scale_colors(np.array([0.0, 1.0]))[:, 0].tolist() == [34, 178]
    points = measured[0].points.positions
    assert error_sheet(points, surface_errors(points, vertices, faces), 0.002, (0,)).ndim == 3
    assert len(surface_errors(np.zeros((0, 3)), vertices, faces)) == 0


def test_frame_sheet_of_an_empty_and_a_full_cloud(measured) -> None:
    frame, _ = measured
    assert frame_sheet(frame, (0, 45)).shape[1] > 600
    empty = CloudFrame(frame.points.select(np.zeros(len(frame.points), bool)), (), {})
    assert frame_sheet(empty, (0,)).ndim == 3


def test_the_report_of_a_run_shows_its_matching(tmp_path: Path) -> None:
    capture, run = make_capture(tmp_path / "capture"), Run(tmp_path / "run")
    with threads(1) as executor:
        job = Job(run, load_config(overrides=COARSE), executor, capture=capture, fps=capture.fps)
        job.write_record()
        clouds(job)
    written = {path.name for path in review(run, capture, measured=partial(measure_again, run, capture))}
    assert {"matching.png", "cloud_sides.png", "report.html"} <= written
    page = (run.path / "review" / "report.html").read_text()
    assert "Surface measurement" in page and "matched in one search image only" in page
