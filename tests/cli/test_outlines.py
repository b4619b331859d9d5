"""Silhouettes of a run in one array, as depths are taken from them."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from geomocap.carving import sequence_outlines
from geomocap.config import Config
from geomocap.errors import GeometryError
from geomocap.files.capture import open_capture
from geomocap.files.run import Run
from geomocap.pipeline import outline_reading
from geomocap.pipeline.job import Job
from tests.cli.conftest import CAMERAS, FRAMES


@pytest.fixture
def seen(small_capture, monkeypatch):
    """A capture whose silhouettes are squares round one point, where the cameras see that, (C,) each."""
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
    return capture, point, silhouette


def test_outlines_are_the_silhouettes_reduced(seen, tmp_path, monkeypatch):
    capture, point, _ = seen
    monkeypatch.setattr(sequence_outlines, "LONGEST_SIDE", 80)
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


def test_points_of_outlines_are_found_in_all_frames(seen, tmp_path):
    capture, point, silhouette = seen
    found = outline_reading.outline_points_of(Job(Run(tmp_path / "run"), Config(), None, capture=capture, fps=10.0))
    assert found is not None and found.frames == FRAMES and len(found.points[0]) == CAMERAS
    assert not len(found.points[2][1])  # an empty silhouette has no outline
    pixel = found.projections @ np.append(point, 1.0)
    for (u, v, w), outline in zip(pixel, found.points[0], strict=True):
        away = outline[:, :2] - [u / w, v / w]
        assert len(outline) > 12 and np.abs(away).max(axis=1).min() > 7 and np.abs(away).max() < 12
        assert ((away * outline[:, 2:]).sum(axis=1) > 0).all()
    given = [[silhouette(None, c, t) for c in capture.cameras] for t in range(FRAMES)]
    again = sequence_outlines.find_outlines(given, capture.rig)
    assert_array_equal(again.projections, found.projections)
    for mine, theirs in zip(again.points, found.points, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            assert_array_equal(a, b)
    with pytest.raises(GeometryError, match=f"outlines: frame 1 has {CAMERAS - 1} silhouettes"):
        sequence_outlines.find_outlines([given[0], given[1][1:]], capture.rig)


def test_without_a_capture_there_are_none(tmp_path):
    job = Job(Run(tmp_path / "run"), Config(), None)
    assert outline_reading.outlines_of(job) is None and outline_reading.outline_points_of(job) is None
