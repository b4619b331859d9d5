"""Silhouettes of a run in one array, as depths are taken from them."""

import numpy as np
from numpy.testing import assert_array_equal

from geomocap.config import Config
from geomocap.files.capture import open_capture
from geomocap.files.run import Run
from geomocap.pipeline import outline_reading
from geomocap.pipeline.job import Job
from tests.cli.conftest import CAMERAS, FRAMES


def test_outlines_are_the_silhouettes_reduced(small_capture, tmp_path, monkeypatch):
    capture = open_capture(small_capture)
    monkeypatch.setattr(outline_reading, "_LONGEST_SIDE", 80)
    point = np.array([0.0, 0.0, 1.0])
    x, y = np.moveaxis(capture.rig.project(point[None])[:, 0], 1, 0)

    def silhouette(run, camera, frame):
        c = capture.cameras.index(camera)
        mask = np.zeros((120, 160), np.uint8)
        if not (c == 1 and frame == 2):
            mask[int(y[c]) - 9 : int(y[c]) + 10, int(x[c]) - 9 : int(x[c]) + 10] = 255
        return mask

    monkeypatch.setattr(outline_reading, "read_silhouette", silhouette)
    found = outline_reading.outlines_of(Job(Run(tmp_path / "run"), Config(), None, capture=capture, fps=10.0))
    assert found is not None
    assert_array_equal(found.frames, np.arange(FRAMES))
    assert (
        found.empty.shape[:2] == (FRAMES, CAMERAS) and 75 <= found.empty.shape[3] <= 90
    )  # undistorted: a little wider
    pixel = found.projections @ np.append(point, 1.0)
    at = np.rint(pixel[:, :2] / pixel[:, 2:]).astype(int)
    assert not found.empty[:, np.arange(CAMERAS), at[:, 1], at[:, 0]].any()
    assert not found.empty[2, 1].any()  # an empty silhouette has no say
    far = found.empty[0, 0]
    assert 0.9 < far.mean() < 1.0


def test_points_of_outlines_are_found_in_all_frames(small_capture, tmp_path, monkeypatch):
    capture = open_capture(small_capture)
    point = np.array([0.0, 0.0, 1.0])
    x, y = np.moveaxis(capture.rig.project(point[None])[:, 0], 1, 0)

    def silhouette(run, camera, frame):
        c = capture.cameras.index(camera)
        mask = np.zeros((120, 160), np.uint8)
        if not (c == 1 and frame == 2):
            mask[int(y[c]) - 9 : int(y[c]) + 10, int(x[c]) - 9 : int(x[c]) + 10] = 255
        return mask

    monkeypatch.setattr(outline_reading, "read_silhouette", silhouette)
    found = outline_reading.outline_points_of(Job(Run(tmp_path / "run"), Config(), None, capture=capture, fps=10.0))
    assert found is not None and found.frames == FRAMES and len(found.points[0]) == CAMERAS
    assert not len(found.points[2][1])  # an empty silhouette has no outline
    pixel = found.projections @ np.append(point, 1.0)
    for (u, v, w), outline in zip(pixel, found.points[0], strict=True):
        away = outline[:, :2] - [u / w, v / w]
        assert len(outline) > 12 and np.abs(away).max(axis=1).min() > 7 and np.abs(away).max() < 12
        assert ((away * outline[:, 2:]).sum(axis=1) > 0).all()


def test_without_a_capture_there_are_none(tmp_path):
    job = Job(Run(tmp_path / "run"), Config(), None)
    assert outline_reading.outlines_of(job) is None and outline_reading.outline_points_of(job) is None
