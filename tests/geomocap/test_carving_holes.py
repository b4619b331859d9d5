"""Holes that the other cameras contradict are filled, gaps in the subject are not."""

from __future__ import annotations

import cv2
import numpy as np
import open3d as o3d
import pycolmap
import pytest

from geomocap.carving.holes import enclosed_holes, fill_false_holes
from geomocap.carving.silhouette_views import Undistortion
from geomocap.model.rig import Rig

SIZE = 120


def ring_rig(count: int) -> Rig:
    poses = []
    for i in range(count):
        angle = 2 * np.pi * i / count + 0.3
        center = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), 0.3])
        z = -center / np.linalg.norm(center)
        x = np.cross([0.0, 0.0, -1.0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        poses.append(np.column_stack([R, -R @ center]))
    camera = pycolmap.Camera(model="OPENCV", width=SIZE, height=SIZE, params=[150, 150, 60, 60, -0.05, 0.01, 0, 0])
    return Rig(tuple(f"cam{i}" for i in range(count)), (camera,) * count, np.array(poses))


def render(rig: Rig, *meshes: o3d.geometry.TriangleMesh) -> list[np.ndarray]:
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    v, u = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    masks = []
    for c in range(len(rig)):
        origin, directions = rig.rays(c, np.column_stack([u.ravel(), v.ravel()]))
        rays = np.column_stack([np.broadcast_to(origin, directions.shape), directions]).astype(np.float32)
        hit = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().reshape(SIZE, SIZE)
        masks.append(np.where(np.isfinite(hit), 255, 0).astype(np.uint8))
    return masks


@pytest.fixture(scope="module")
def torso_and_ring():
    """A solid trunk, and beside it a ring with a real gap."""
    rig = ring_rig(6)
    trunk = o3d.geometry.TriangleMesh.create_sphere(0.3, 40).translate((-0.3, 0, 0))
    ring = o3d.geometry.TriangleMesh.create_torus(0.22, 0.05, 60, 30).translate((0.35, 0, 0))
    ring.rotate(o3d.geometry.get_rotation_matrix_from_xyz((np.pi / 2, 0, 0.3)), (0.35, 0, 0))
    return rig, render(rig, trunk, ring)


def test_false_hole_is_filled_and_a_real_gap_kept(torso_and_ring):
    rig, masks = torso_and_ring
    damaged = [m.copy() for m in masks]
    u, v = rig.project(np.array([[-0.3, 0.0, 0.0]]))[1, 0]
    cv2.circle(damaged[1], (int(u), int(v)), 5, 0, -1)
    assert (damaged[1] != masks[1]).sum() > 50
    repaired = fill_false_holes(rig, Undistortion.of(rig).views(damaged), damaged)
    for c in range(len(rig)):
        np.testing.assert_array_equal(repaired[c], masks[c], err_msg=f"camera {c}")
    assert any(enclosed_holes(m) for m in masks), "no camera sees through the ring: the test shows nothing"


def test_cameras_that_see_nothing_or_a_part_bear_no_witness(torso_and_ring):
    """An empty silhouette, and one of an image that ends in the middle of the subject, contradict nothing."""
    rig, masks = torso_and_ring
    damaged = [m.copy() for m in masks]
    damaged[3][:] = 0
    u, v = rig.project(np.array([[-0.3, 0.0, 0.0]]))[1, 0]
    cv2.circle(damaged[1], (int(u), int(v)), 5, 0, -1)
    views = Undistortion.of(rig).views(damaged)
    views.valid[4, : SIZE // 2] = 0
    views.masks[4, : SIZE // 2] = 0
    repaired = fill_false_holes(rig, views, damaged)
    np.testing.assert_array_equal(repaired[1], masks[1])


def test_too_few_cameras_fill_nothing(torso_and_ring):
    rig, masks = torso_and_ring
    some = rig.select(rig.names[:3])
    damaged = [m.copy() for m in masks[:3]]
    u, v = rig.project(np.array([[-0.3, 0.0, 0.0]]))[1, 0]
    cv2.circle(damaged[1], (int(u), int(v)), 5, 0, -1)
    repaired = fill_false_holes(some, Undistortion.of(some).views(damaged), damaged)
    np.testing.assert_array_equal(repaired[1], damaged[1])


def test_holes_are_enclosed_background_with_their_rims():
    mask = np.zeros((40, 60), np.uint8)
    mask[5:35, 5:55] = 255
    mask[10:14, 10:15] = 0  # a hole
    mask[20:35, 40:44] = 0  # a bay
    mask[30:32, 12:13] = 0  # too small
    ((inside, rim),) = enclosed_holes(mask)
    assert {tuple(p) for p in inside} == {(x, y) for x in range(10, 15) for y in range(10, 14)}
    assert all(mask[y, x] for x, y in rim) and len(rim) == 11 * 10 - 20
