"""Pictures of single files of geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from PIL import Image

from geomocap.errors import GeometryError, RunError
from geomocap.files.frame_files import read_points
from tests.viz.conftest import Made
from viz import render_file


def test_any_geometry_file_gets_a_picture(made: Made, tmp_path: Path) -> None:
    box = o3d.geometry.TriangleMesh.create_box(1, 2, 3)
    o3d.io.write_triangle_mesh(str(tmp_path / "box.ply"), box)
    files = [tmp_path / "box.ply", made.run.frame_file("voxels", 0), made.run.frame_file("bodies", 0)]
    for k, file in enumerate(files):
        target = render_file(file, tmp_path / f"{k}.png")
        with Image.open(target) as image:
            assert np.asarray(image).std() > 5
    assert render_file(tmp_path / "box.ply") == tmp_path / "box.png"
    for name, content, words in (
        ("no.ply", None, "no such file"),
        ("a.txt", "x", "can't be shown"),
        ("b.stl", "solid", "header can't be read .it ends too early"),
    ):
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(GeometryError, match=words):
            render_file(tmp_path / name)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no PLY file"),
        (b"garbage", "no PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "neither triangles nor points"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n", "1 lines are missing"),
        (b"ply\nformat ascii 1.0\ncomment voxel_size\nelement vertex 0\nend_header\n", "holds no voxels"),
    ],
)
def test_bad_ply_is_told_in_one_line(tmp_path: Path, capfd, content: bytes, said: str) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(GeometryError, match=rf"a\.ply: .*{said}"):
        render_file(tmp_path / "a.ply")
    assert "".join(capfd.readouterr()) == ""


@pytest.mark.parametrize("name", ["p8.txt", "p8", "scan.obj"])
def test_picture_of_no_picture_name_is_refused_before_any_work(tmp_path: Path, name: str) -> None:
    (tmp_path / "scan.obj").touch()
    with pytest.raises(RunError, match=rf"{name}: no name of a picture; expected .*\.png"):
        render_file(tmp_path / "scan.obj", tmp_path / name)


def test_clouds_are_drawn_without_a_word(tmp_path: Path, capfd) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.io.write_point_cloud(str(tmp_path / "a.ply"), cloud)
    render_file(tmp_path / "a.ply")
    assert "".join(capfd.readouterr()) == ""


def test_points_without_colours_or_bodies(tmp_path: Path) -> None:
    positions = np.array([[0, 0, 0], [1, 2, 3], [np.nan, 0, 0]], np.float32)
    o3d.t.io.write_point_cloud(str(tmp_path / "a.ply"), o3d.t.geometry.PointCloud(o3d.core.Tensor(positions)))
    points = read_points(tmp_path / "a.ply").finite
    assert len(points.positions) == 2 and points.shown_colors.shape == (2, 3)
    assert set(points.body) == {-1} and points.normals is None
