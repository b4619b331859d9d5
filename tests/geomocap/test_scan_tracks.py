"""Whether scans have points in common, and where these are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from geomocap.config import load_config
from geomocap.errors import GeometryError
from geomocap.files.run import Run
from geomocap.files.scan_geometry import ScanSurface, places_on
from geomocap.files.scan_settings import ScanSettings
from geomocap.files.scan_tracks import scan_tracks
from geomocap.files.scans import Scans, open_scans
from geomocap.pipeline import Job, segment
from geomocap.scheduling import threads

T = 5
BALL = trimesh.creation.icosphere(3)


def moved(points: np.ndarray, frame: int) -> np.ndarray:
    """Turn points (N, 3), move them, and bend them a little."""
    turn = Rotation.from_rotvec([0.0, 0.2 * frame, 0.1 * frame])
    return turn.apply(points * [1.0, 1.0, 1.0 + 0.05 * frame]) + np.array([0.3 * frame, 0.0, 0.0])


def scans_of(points: list[np.ndarray], folder: Path) -> Scans:
    for k, some in enumerate(points):
        np.savez(folder / f"{k:03d}.npz", points=some)
    return open_scans(folder, ScanSettings())


@pytest.mark.parametrize("ending", ["ply", "obj", "stl", "glb"])
def test_places_on_meshes_of_one_topology_are_followed(tmp_path, ending):
    for k in range(T):
        mesh = trimesh.Trimesh(moved(BALL.vertices, k), BALL.faces, process=False)
        mesh.export(tmp_path / f"{k:03d}.{ending}")
    tracks = scan_tracks(open_scans(tmp_path, ScanSettings(samples=700, scale=0.01)))
    assert tracks.shape == (700, T, 3)
    assert_allclose(tracks, np.stack([0.01 * moved(100 * tracks[:, 0], k) for k in range(T)], axis=1), atol=1e-7)
    assert np.abs(np.linalg.norm(tracks[:, 0], axis=1) - 0.01).max() < 2e-4


def test_meshes_of_other_triangles_have_nothing_in_common(tmp_path):
    for k in range(T):
        ball = trimesh.creation.icosphere(2 + k % 2)
        trimesh.Trimesh(moved(ball.vertices, k), ball.faces, process=False).export(tmp_path / f"{k}.ply")
    scans = open_scans(tmp_path, ScanSettings())
    assert scan_tracks(scans) is None
    with pytest.raises(GeometryError, match=r"1\.ply: other triangles or vertices.*segmentation\.paths = points"):
        scan_tracks(scans, certain=True)


def test_points_in_one_order_are_tracks_with_their_gaps(tmp_path):
    rng = np.random.default_rng(0)
    points = [moved(BALL.vertices, k) + 0.005 * rng.normal(size=BALL.vertices.shape) for k in range(T)]
    for some in points:
        some[rng.choice(len(some), 20)] = np.nan
    tracks = scan_tracks(scans_of(points, tmp_path))
    assert_allclose(tracks, np.stack(points, axis=1))


def test_trajectories_of_a_run_are_tracks_with_any_gaps(tmp_path):
    rng = np.random.default_rng(0)
    tracks = np.stack([moved(BALL.vertices, k) for k in range(T)], axis=1)
    tracks[rng.random(tracks.shape[:2]) < 0.5] = np.nan
    seen = np.isfinite(tracks[:, :, 0])
    np.savez(tmp_path / "tracks.npz", positions=tracks, start=seen.argmax(axis=1), end=np.full(len(tracks), T - 1))
    scans = open_scans(tmp_path / "tracks.npz", ScanSettings(scale=2.0))
    assert len(scans) == T and scans.tracked
    np.testing.assert_array_equal(scans.points(1), 2 * tracks[seen[:, 1], 1])
    np.testing.assert_array_equal(scan_tracks(scans, scans.tracked), 2 * tracks[seen.any(axis=1)])


def test_of_many_points_some_are_followed_the_same_each_time(tmp_path):
    ball = trimesh.creation.icosphere(5).vertices
    scans = scans_of([moved(ball, k) for k in range(3)], tmp_path)
    tracks = scan_tracks(scans)
    assert tracks.shape == (8000, 3, 3) and len(np.unique(tracks[:, 0], axis=0)) == 8000
    assert_allclose(tracks[:, 2], moved(tracks[:, 0], 2))
    np.testing.assert_array_equal(tracks, scan_tracks(scans))


def test_points_in_any_order_are_no_tracks_unless_they_are_said_to_be(tmp_path):
    rng = np.random.default_rng(0)
    points = [moved(rng.permutation(BALL.vertices), k) for k in range(T)]
    scans = scans_of(points, tmp_path)
    assert scan_tracks(scans) is None
    assert_allclose(scan_tracks(scans, certain=True), np.stack(points, axis=1))


def test_a_surface_sampled_anew_in_the_order_of_its_triangles_gives_no_tracks(tmp_path):
    ball = ScanSurface(np.array(BALL.vertices), np.array(BALL.faces))
    points = [moved(places_on(ball, 2000, seed=k).of(ball.points), k) for k in range(T)]
    assert scan_tracks(scans_of(points, tmp_path)) is None


def test_pixels_of_a_depth_image_are_no_tracks(tmp_path):
    x, z = (c.ravel() for c in np.meshgrid(np.linspace(-1, 3, 80), np.linspace(-1, 1, 40)))
    points = []
    for k in range(T):
        deep = 1 - (x - 0.2 * k) ** 2 - z**2
        points.append(np.stack([x, np.where(deep > 0, -np.sqrt(np.maximum(deep, 0)), np.nan), z], axis=1))
    assert scan_tracks(scans_of(points, tmp_path)) is None


def test_scans_with_other_numbers_of_points_are_named(tmp_path):
    scans = scans_of([BALL.vertices, BALL.vertices[1:]], tmp_path)
    assert scan_tracks(scans) is None
    with pytest.raises(GeometryError, match=r"001\.npz: 641 points, expected 642"):
        scan_tracks(scans, certain=True)


def test_too_few_points_to_tell_bodies_by(tmp_path):
    (tmp_path / "scans").mkdir()
    scans = scans_of([BALL.vertices[:5]] * 2, tmp_path / "scans")
    assert scan_tracks(scans) is None, "too few to tell"
    with threads(1) as executor:
        config = load_config(overrides={"segmentation": {"paths": "points"}})
        job = Job(Run(tmp_path / "run"), config, executor, scans=scans)
        with pytest.raises(GeometryError, match="motion paths: 5 samples; at least 20 are needed"):
            segment(job, "scans")


def test_tracks_one_after_the_other_are_read_as_scans(tmp_path):
    file = tmp_path / "tracks.npz"
    points = np.arange(15.0).reshape(5, 3)
    layout = {"first": np.array([0, 3, 5]), "start": np.array([0, 2]), "end": np.array([3, 4]), "n_frames": 4}
    np.savez(file, layout="ragged", positions=points, **layout)
    scans = open_scans(file, ScanSettings(spacing=0.1))
    assert len(scans) == 4 and scans.tracked
    np.testing.assert_array_equal(scans.surface(2).points, [points[2], points[3]])
    np.testing.assert_array_equal(scans.points(3), [points[4]])
