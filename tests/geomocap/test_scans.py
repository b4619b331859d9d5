"""Scans of all kinds as point sets."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from geomocap.config import load_config
from geomocap.errors import GeometryError
from geomocap.export.run_export import run_up
from geomocap.files.frame_files import write_voxels
from geomocap.files.run import Run
from geomocap.files.scan_geometry import read_mesh
from geomocap.files.scan_settings import ScanSettings
from geomocap.files.scans import open_scans
from geomocap.model.frame_geometry import Voxels
from geomocap.pipeline.job import Job
from geomocap.pipeline.sources import geometry_of
from geomocap.scheduling import threads
from tests.geomocap.moving_chains import chain


def test_triangles_given_several_times_are_taken_once(tmp_path):
    file = tmp_path / "a.obj"
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1", "f 1 2 3", "f 1 2 4", "f 3 1 2", "f 1 3 2"]
    file.write_text("\n".join(lines))
    mesh = read_mesh(file)
    assert mesh is not None and mesh.faces.tolist() == [[0, 1, 2], [0, 1, 3]]


@pytest.mark.parametrize("ending", ["ply", "obj", "stl", "glb"])
def test_mesh_is_sampled_on_its_surface_evenly(tmp_path, ending):
    trimesh.creation.box(extents=(2, 4, 6)).export(tmp_path / f"box.{ending}")
    scans = open_scans(tmp_path / f"box.{ending}", ScanSettings(samples=8800))
    points = scans.points(0)
    on_face = np.isclose(np.abs(points), [1, 2, 3], atol=1e-5)
    assert points.shape == (8800, 3) and on_face.any(axis=1).all()
    # areas of the faces: 2·24, 2·12, 2·8 of 88
    np.testing.assert_allclose(on_face.sum(axis=0) / 8800, [48 / 88, 24 / 88, 16 / 88], atol=0.01)
    np.testing.assert_array_equal(points, scans.points(0))


@pytest.mark.parametrize("ending", ["ply", "pcd"])
def test_cloud_is_read_as_it_is(tmp_path, ending):
    points = np.random.default_rng(0).normal(size=(100, 3))
    o3d.io.write_point_cloud(str(tmp_path / f"c.{ending}"), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    back = open_scans(tmp_path / f"c.{ending}", ScanSettings(scale=0.001)).points(0)
    np.testing.assert_allclose(back, points * 0.001, atol=1e-9)


def test_voxel_grid_gives_its_centres(tmp_path):
    indices = np.array([[0, 0, 0], [1, 2, 3]], np.int32)
    write_voxels(tmp_path / "v.ply", Voxels(indices, np.zeros((2, 3), np.uint8), np.array([1.0, 2, 3]), 0.1))
    np.testing.assert_allclose(
        open_scans(tmp_path / "v.ply", ScanSettings()).points(0), [[1.05, 2.05, 3.05], [1.15, 2.25, 3.35]]
    )


def test_sequences_are_ordered_by_number(tmp_path):
    for k in (10, 9, 11):
        np.savez(tmp_path / f"scan{k}.npz", points=np.arange(12.0).reshape(4, 3) + k)
    scans = open_scans(tmp_path, ScanSettings())
    assert [scans.points(k)[0, 0] for k in range(3)] == [9, 10, 11]
    np.savez(tmp_path / "all.npz", points=np.arange(24.0).reshape(2, 4, 3))
    both = open_scans(tmp_path / "all.npz", ScanSettings())
    assert len(both) == 2 and both.points(1)[0, 0] == 12


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["s_1.obj", "s_1.ply", "s_2.obj", "s_2.ply"], "several formats (obj, ply)"),
        (["000002.ply", "000004.ply"], None),  # every second frame
        (["0.ply", "1.ply", "2.ply", "4.ply", "5.ply"], "number 3 is missing between 2.ply and 4.ply"),
        (["v2_00.ply", "v2_05.ply", "v2_20.ply"], "number 10 is missing between v2_05.ply and v2_20.ply"),
        (["s_1.ply", "s_01.ply", "s_2.ply"], "s_01.ply and s_1.ply have the same number"),
        (["left_0.ply", "left_1.ply", "right_0.ply"], "left_0.ply and right_0.ply are of different sequences"),
        (["mean.ply", "s_0.ply", "s_1.ply"], "mean.ply and s_0.ply are of different sequences"),
        (["a.ply", "b.PLY", "d.ply"], None),
        (["0.ply", "._0.ply", "1.ply"], None),  # hidden files are none of the sequence
        (["20250101_235959.ply", "20250102_000000.ply"], None),
    ],
)
def test_a_folder_is_one_sequence_without_gaps(tmp_path, names, said):
    for name in names:
        (tmp_path / name).touch()
    if said is None:
        visible = [n for n in names if not n.startswith(".")]
        assert [Path(n).name for n in open_scans(tmp_path, ScanSettings()).names] == visible
        return
    with pytest.raises(GeometryError, match=re.escape(f"{tmp_path}: ") + ".*" + re.escape(said)):
        open_scans(tmp_path, ScanSettings())


def cloud_of(points: np.ndarray) -> o3d.geometry.PointCloud:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def test_nan_points_are_missing_in_every_format(tmp_path):
    points = np.arange(18.0).reshape(6, 3)
    points[2, 1] = np.nan
    expected = points[[0, 1, 3, 4, 5]]
    o3d.io.write_point_cloud(str(tmp_path / "a.ply"), cloud_of(points))
    np.savez(tmp_path / "b.npz", points=points)
    np.savez(tmp_path / "c.npz", points=[points, np.full((6, 3), np.nan)])
    for name in ("a.ply", "b.npz", "c.npz"):
        np.testing.assert_array_equal(open_scans(tmp_path / name, ScanSettings()).points(0), expected)
    with pytest.raises(GeometryError, match=r"c\.npz, frame 1: all 6 points are missing \(NaN\)"):
        open_scans(tmp_path / "c.npz", ScanSettings()).points(1)
    box = trimesh.creation.box(extents=(2, 4, 6))
    box.vertices[0] = np.nan
    box.export(tmp_path / "d.ply")
    assert np.isfinite(open_scans(tmp_path / "d.ply", ScanSettings()).points(0)).all()


def test_points_that_can_be_no_surface_are_refused(tmp_path):
    np.savez(tmp_path / "none.npz", points=np.zeros((0, 5, 3)))
    with pytest.raises(GeometryError, match=r"none\.npz: holds no frames.*\(0, 5, 3\)"):
        open_scans(tmp_path / "none.npz", ScanSettings())
    np.savez(tmp_path / "same.npz", points=np.ones((3, 50, 3)))
    with pytest.raises(GeometryError, match=r"same\.npz, frame 1: all 50 points coincide"):
        open_scans(tmp_path / "same.npz", ScanSettings()).points(1)
    np.save(tmp_path / "far.npy", [[0, 0, 0], [np.inf, 0, 0]])
    with pytest.raises(GeometryError, match=r"far\.npy, frame 0: 1 points are infinite"):
        open_scans(tmp_path / "far.npy", ScanSettings()).points(0)
    np.save(tmp_path / "away.npy", np.eye(3) + 1e7)
    with pytest.raises(GeometryError, match=r"away\.npy, frame 0: .* from the origin.*subtract the same offset"):
        open_scans(tmp_path / "away.npy", ScanSettings()).points(0)
    box = trimesh.creation.box(extents=(2, 4, 6))
    box.vertices[0] = np.inf
    box.export(tmp_path / "far.ply")
    with pytest.raises(GeometryError, match=r"far\.ply: .*infinite"):
        open_scans(tmp_path / "far.ply", ScanSettings()).points(0)


def test_arrays_whose_points_come_first_are_told(tmp_path):
    """As tracks (N, T, 3) they would be right; a scan of one point's path is small, which is no matter of its unit."""
    tracks = chain(3).positions[::3]
    tracks[40] = tracks[40, 0] + 1e-16 * np.arange(24)[:, None]  # rests
    np.save(tmp_path / "tracks.npy", tracks)
    np.save(tmp_path / "scans.npy", tracks.swapaxes(0, 1))
    swapped = open_scans(tmp_path / "tracks.npy", ScanSettings())
    with pytest.raises(
        GeometryError, match=r"swapped; expected \(T frames, N points, 3\).* 90 fr.*right: frame 40: .* m across"
    ):
        swapped.points(40)
    assert "frames and points seem to be swapped" in swapped.doubts[0]
    assert open_scans(tmp_path / "scans.npy", ScanSettings()).doubts == ()
    np.save(tmp_path / "one.npy", np.ones((90, 24, 3)))
    with pytest.raises(GeometryError, match=r"coincide; .*expected \(T frames, N points, 3\).* 90 frames of 24 points"):
        open_scans(tmp_path / "one.npy", ScanSettings()).points(1)
    mixed = [np.random.default_rng(t).permutation(points) for t, points in enumerate(tracks.swapaxes(0, 1))]
    np.save(tmp_path / "mixed.npy", mixed)
    assert open_scans(tmp_path / "mixed.npy", ScanSettings()).doubts == ()


def test_spacing_is_the_mean_distance_to_the_nearest_point(tmp_path):
    x = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3) * 0.02
    np.save(tmp_path / "g.npy", x)
    assert open_scans(tmp_path / "g.npy", ScanSettings()).spacing == pytest.approx(0.02)
    np.save(tmp_path / "mm.npy", 1000 * x)
    assert open_scans(tmp_path / "mm.npy", ScanSettings(spacing=5, scale=0.001)).spacing == pytest.approx(0.005)


def test_up_is_recorded_and_changes_no_points(tmp_path):
    np.save(tmp_path / "s.npy", np.random.default_rng(0).normal(size=(20, 3)))
    keys = set()
    with threads(1) as executor:
        for up in ("x", "y", "z"):
            config = load_config(overrides={"scans": {"up": up}})
            job = Job(Run(tmp_path / up), config, executor, scans=open_scans(tmp_path / "s.npy", config.scans))
            job.write_record()
            assert job.up == run_up(job.run) == up
            assert load_config(tmp_path / up / "run.toml").scans.up == up
            keys.add(geometry_of(job, "scans")[1])
    assert len(keys) == 1
    assert ScanSettings().up == "z"


def test_bad_scans_are_named(tmp_path):
    with pytest.raises(GeometryError, match="no such file"):
        open_scans(tmp_path / "no.ply", ScanSettings())
    with pytest.raises(GeometryError, match="holds no scans"):
        open_scans(tmp_path, ScanSettings())
    (tmp_path / "a.obj").write_text("nonsense")
    with pytest.raises(GeometryError, match=r"a\.obj: "):
        open_scans(tmp_path / "a.obj", ScanSettings()).points(0)
    np.savez(tmp_path / "b.npz", x=np.zeros((3, 3)))
    with pytest.raises(GeometryError, match="expected an array `points`"):
        open_scans(tmp_path / "b.npz", ScanSettings())
    np.savez(tmp_path / "c.npz", points=np.zeros((3, 2)))
    with pytest.raises(GeometryError, match="expected numbers of shape"):
        open_scans(tmp_path / "c.npz", ScanSettings())
    np.savez(tmp_path / "d.npz", points=np.array([{}], dtype=object))
    with pytest.raises(GeometryError, match="can't be read as plain arrays"):
        open_scans(tmp_path / "d.npz", ScanSettings())
    (tmp_path / "e").mkdir()
    np.savez(tmp_path / "e/0.npz", points=np.array([[0, 0, np.nan]]))
    with pytest.raises(GeometryError, match="all 1 points are missing"):
        open_scans(tmp_path / "e", ScanSettings()).points(0)


def test_a_single_point_beyond_all_measure_is_no_number_trouble(tmp_path):
    (tmp_path / "a.xyz").write_text("1e200 0 0\n")
    np.testing.assert_array_equal(open_scans(tmp_path / "a.xyz", ScanSettings()).points(0), [[1e200, 0, 0]])


def test_points_that_share_a_coordinate_beyond_all_measure_are_refused(tmp_path):
    (tmp_path / "a.xyz").write_text("1e200 0 0\n1e200 1 0\n1e200 0 1\n1e200 1 1\n")
    with pytest.raises(GeometryError, match=r"a\.xyz.*times their diagonal from the origin"):
        open_scans(tmp_path / "a.xyz", ScanSettings()).points(0)
