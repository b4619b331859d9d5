"""Files that Open3D reads: PLY refused if not whole, and nothing on the screen."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
import trimesh

from geomocap.errors import GeometryError
from geomocap.files.frame_files import write_points, write_voxels
from geomocap.files.open3d_geometry import check_ply, read_by_open3d
from geomocap.model.frame_geometry import BodyPoints, Voxels

HEADER = b"ply\nformat ascii 1.0\nelement vertex"


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_truncated_meshes_are_refused(tmp_path, encoding):
    file = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=1).export(file, encoding=encoding)
    check_ply(file)
    whole = file.read_bytes()
    for cut in (40, len(whole) // 2):
        file.write_bytes(whole[:-cut])
        with pytest.raises(GeometryError, match=r"ball\.ply: PLY ends too early, at least \d+ (lines|bytes)"):
            check_ply(file)


def test_polygons_of_several_lengths_are_counted_one_by_one(tmp_path):
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\n"
    header += b"element face 3\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
    faces = [bytes([n]) + bytes(4 * n + 1) for n in (3, 4, 3)]
    (tmp_path / "a.ply").write_bytes(header + b"".join(faces))
    check_ply(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes(header + b"".join(faces)[:-1])
    with pytest.raises(GeometryError, match="at least 1 bytes are missing"):
        check_ply(tmp_path / "a.ply")


def test_files_of_a_run_are_whole(tmp_path):
    points = np.random.default_rng(0).normal(size=(20, 3))
    write_points(tmp_path / "bodies.ply", BodyPoints(points, np.zeros(20, int)))
    voxels = Voxels(np.eye(3, dtype=np.int32), np.zeros((3, 3), np.uint8), np.zeros(3), 0.1)
    write_voxels(tmp_path / "voxels.ply", voxels)
    for name in ("bodies.ply", "voxels.ply"):
        file = tmp_path / name
        check_ply(file)
        file.write_bytes(file.read_bytes()[:-1])
        with pytest.raises(GeometryError, match="at least 1 bytes are missing"):
            check_ply(file)


def test_points_with_bodies_are_written_as_open3d_does(tmp_path):
    rng = np.random.default_rng(0)
    points = BodyPoints(rng.normal(size=(300, 3)), rng.integers(-1, 60, 300))
    write_points(tmp_path / "bodies.ply", points)
    o3d.t.io.write_point_cloud(tmp_path / "open3d.ply", points.to_open3d())
    assert (tmp_path / "bodies.ply").read_bytes() == (tmp_path / "open3d.ply").read_bytes()


@pytest.mark.parametrize("span", [3, 1000, 1 << 20])
def test_voxels_are_sorted_by_index_and_equal_ones_keep_their_order(span):
    rng = np.random.default_rng(span)
    indices, colors = rng.integers(-span, span, (500, 3)).astype(np.int32), rng.integers(0, 255, (500, 3))
    order = np.lexsort(indices.T[::-1])
    found = Voxels.sorted(indices, colors.astype(np.uint8), np.zeros(3), 0.1)
    assert np.array_equal(found.indices, indices[order])
    assert np.array_equal(found.colors, colors[order])


@pytest.mark.parametrize("word", [b"inf", b"1,5", b"x"])
def test_words_in_place_of_numbers_are_told(tmp_path, word, capfd):
    (tmp_path / "a.ply").write_bytes(HEADER + b" 2\nproperty double x\nend_header\n1.5e-3\n" + word + b"\n")
    with pytest.raises(GeometryError, match="where finite numbers are expected"):
        read_by_open3d(o3d.io.read_point_cloud, tmp_path / "a.ply")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "content",
    [b"", b"garbage", HEADER + b" 1\n", HEADER + b" x\nend_header\n"],
)
def test_what_is_no_ply_is_named(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(GeometryError, match=r"a\.ply: no PLY file"):
        check_ply(tmp_path / "a.ply")


def test_reading_prints_nothing_and_leaves_the_verbosity(tmp_path, capfd):
    before = o3d.utility.get_verbosity_level()
    (tmp_path / "a.pcd").write_text("nonsense")
    assert not read_by_open3d(o3d.io.read_point_cloud, tmp_path / "a.pcd").has_points()
    assert "".join(capfd.readouterr()) == "" and o3d.utility.get_verbosity_level() == before


def test_open3d_reads_voxels_as_it_does_its_own(tmp_path):
    rng = np.random.default_rng(0)
    indices = np.unique(rng.integers(0, 40, (300, 3)), axis=0).astype(np.int32)
    colors = rng.integers(0, 256, indices.shape).astype(np.uint8)
    voxels = Voxels(indices, colors, np.array([-0.3, 2.0, 1e-7]), 0.0123)
    write_voxels(tmp_path / "voxels.ply", voxels)
    o3d.io.write_voxel_grid(str(tmp_path / "open3d.ply"), voxels.to_open3d())
    ours, theirs = (
        Voxels.from_open3d(o3d.io.read_voxel_grid(str(tmp_path / name))) for name in ("voxels.ply", "open3d.ply")
    )
    assert np.array_equal(ours.indices, theirs.indices)
    assert np.array_equal(ours.colors, theirs.colors)
    assert np.array_equal(ours.origin, theirs.origin)
    assert ours.voxel_size == theirs.voxel_size
    ours, theirs = ((tmp_path / name).read_bytes() for name in ("voxels.ply", "open3d.ply"))
    start = len(ours) - 27 * len(indices)
    assert ours[:start] == theirs[:start]  # headers; voxels follow in another order
