"""Meshes: closed, facing outwards, of the right size."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from geomocap.model.surface import vertex_normals
from viz.shapes import Mesh, ball, bone, ellipsoid, join, tube
from viz.volumes import cubes, gems, skin, spacing, surface_nets


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)


def test_ball_and_ellipsoid_have_their_volume_and_face_outwards() -> None:
    sphere = solid(ball([1, 2, 3], 0.5, (1, 2, 3), level=12))
    assert sphere.is_watertight
    assert sphere.volume == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.01)
    turned = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    for rotation in (turned, turned @ np.diag([1, 1, -1])):  # eigenvectors may be left-handed
        mesh = ellipsoid([0, 0, 0], [0.1, 0.2, 0.4], rotation, (1, 2, 3), level=12)
        assert solid(mesh).volume == pytest.approx(4 / 3 * np.pi * 0.008, rel=0.02)
        local = mesh.vertices @ rotation / [0.1, 0.2, 0.4]
        np.testing.assert_allclose(np.linalg.norm(local, axis=1), 1)


def test_tube_keeps_its_radius_and_leaves_gaps_out() -> None:
    t = np.linspace(0, 3, 40)
    path = np.column_stack([np.cos(t), np.sin(t), 0.2 * t])
    mesh = tube(path, 0.05, (1, 2, 3))
    distance = np.linalg.norm(mesh.vertices.reshape(40, -1, 3) - path[:, None], axis=2)
    np.testing.assert_allclose(distance, 0.05)
    path[5] = np.nan
    assert len(tube(path, 0.05, (1, 2, 3)).vertices) == 39 * 8
    assert len(tube(path[:1], 0.05, (1, 2, 3)).faces) == 0
    assert np.isfinite(tube(np.array([[0, 0, 0], [0, 0, 0], [0, 0, 1.0]]), 0.05, (1, 2, 3)).vertices).all()


def test_bone_reaches_from_joint_to_joint() -> None:
    mesh = bone(np.array([0, 0, 1.0]), np.array([0, 0, 3.0]), 0.1, (1, 2, 3))
    assert mesh.vertices[:, 2].min() == pytest.approx(1)
    assert mesh.vertices[:, 2].max() == pytest.approx(3)
    assert np.abs(mesh.vertices[:, :2]).max() <= 0.1 + 1e-9


def test_join_keeps_every_triangle() -> None:
    a, b = ball([0, 0, 0], 1, (255, 0, 0), level=2), ball([5, 0, 0], 1, (0, 255, 0), level=3)
    both = join([a, b])
    assert len(both.faces) == len(a.faces) + len(b.faces)
    assert solid(both).volume == pytest.approx(solid(a).volume + solid(b).volume)
    assert len(join([]).faces) == 0


def test_vertex_normals_of_a_sphere_point_outwards() -> None:
    sphere = trimesh.creation.icosphere(3)
    normals = vertex_normals(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    assert np.einsum("ij,ij->i", normals, sphere.vertices).min() > 0.99


def test_cubes_leave_out_shared_sides() -> None:
    block = np.argwhere(np.ones((2, 3, 4)))
    mesh = cubes(block, np.array([1.0, 0, 0]), 0.1, np.full((24, 3), 9, np.uint8))
    assert len(mesh.faces) == 2 * 2 * (2 * 3 + 3 * 4 + 2 * 4)
    joined = solid(mesh)
    assert joined.is_watertight
    assert joined.volume == pytest.approx(24 * 0.001)
    np.testing.assert_allclose(joined.bounds, [[1, 0, 0], [1.2, 0.3, 0.4]], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1)


def test_every_side_of_a_cube_has_the_colour_of_its_voxel() -> None:
    block = np.argwhere(np.ones((2, 3, 4)))
    mesh = cubes(block, np.zeros(3), 1.0, 10 * block.astype(np.uint8))
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    sides = np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2)))
    np.testing.assert_allclose(mesh.colors, 10 * np.floor(middles - 0.5 * sides) / 255)


def test_gems_stand_on_their_points() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    mesh = gems(points, np.zeros((50, 3), np.uint8), 0.02)
    np.testing.assert_allclose(mesh.vertices.reshape(50, 6, 3).mean(axis=1), points)
    assert len(gems(points[:2], np.zeros((2, 3), np.uint8), 0.02).faces) == 16
    assert len(gems(points[:0], np.zeros((0, 3), np.uint8), 0.02).faces) == 0


def test_surface_nets_of_a_ball() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij"), axis=-1) - [11.3, 12.1, 11.8]
    field = 8 - np.linalg.norm(grid, axis=-1)
    vertices, faces = surface_nets(field, 0.0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 8**3, rel=0.02)  # positive: the triangles face outwards
    np.testing.assert_allclose(np.linalg.norm(vertices - [11.3, 12.1, 11.8], axis=1), 8, atol=0.25)


def test_skin_encloses_a_hollow_ball_and_takes_the_nearest_colour() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(8000, 3))
    points *= 0.5 / np.linalg.norm(points, axis=1, keepdims=True)
    colors = np.where(points[:, 2:] > 0, [255, 0, 0], [0, 0, 255]).astype(np.uint8)
    mesh = skin(points, colors, cells=50)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert radii.min() > 0.46 and radii.max() < 0.56  # no second surface inside
    top = mesh.vertices[mesh.faces].mean(axis=1)[:, 2]
    assert (mesh.colors[top > 0.05, 0] == 1).all() and (mesh.colors[top < -0.05, 2] == 1).all()
    assert len(skin(points[:0], colors[:0]).faces) == 0


def test_spacing_of_a_grid() -> None:
    assert spacing(np.argwhere(np.ones((5, 5, 5))) * 0.02) == pytest.approx(0.02)
