"""A motion that a single camera measured, off along its rays, is put right by the silhouettes of the others."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import geomocap
from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.errors import GeometryError
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.outline_points import OutlinePoints, outline_points
from geomocap.model.ray_casting import TriangleScene
from geomocap.skeleton.body_observations import SkinPoints
from geomocap.skeleton.kinematics import BodyMotion
from geomocap.skeleton.motion_skeleton import find_motion_skeleton
from geomocap.skeleton.motion_skeleton_settings import RefinementSettings
from geomocap.skeleton.refinement import refine_skeleton
from geomocap.subject.model_building import BodyCloud, build_model
from geomocap.subject.model_mesh import model_mesh
from geomocap.subject.outline_fit import OutlineFit
from geomocap.subject.outline_matching import match_outlines
from tests.geomocap.moving_chains import chain
from tests.geomocap.test_subject_model import SPACING, box_shell

SIZE, AWAY, OFF = 240, 4.0, 0.06


def cameras():
    result = []
    for angle in np.deg2rad([0, 80, 170, 260]):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.3])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[380.0, 0, SIZE / 2], [0, 380.0, SIZE / 2], [0, 0, 1]])
        result.append(K @ np.concatenate([R, (R @ forward * AWAY)[:, None]], axis=1))
    return np.array(result)


def drawn(mesh, motion, P):
    """Outlines of a mesh in all frames of a motion."""
    center = OutlinePoints(P, []).centers
    y, x = np.mgrid[:SIZE, :SIZE]
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    frames = []
    for places in motion.carry(mesh.skin.rest, mesh.skin.bodies, mesh.skin.fractions):
        scene, found = TriangleScene(places, mesh.surface.triangles), []
        for c, projection in enumerate(P):
            rays = pixels @ np.linalg.inv(projection[:, :3]).T
            hit = scene.occluded(np.hstack([np.broadcast_to(center[c], rays.shape), rays])).reshape(SIZE, SIZE)
            found.append(outline_points(hit.astype(np.float32), np.ones((SIZE, SIZE), np.float32), 3))
        frames.append(found)
    return OutlinePoints(P, frames)


def distance(mesh, points):
    """Median distance of points from a surface."""
    closest = TriangleScene(mesh.skin.rest, mesh.surface.triangles).closest(points)[0]
    return np.median(np.linalg.norm(closest - points, axis=1))


@pytest.fixture(scope="module")
def scene():
    """True motion, mesh and outlines of two boxes; and what a single camera made of it, off in depth by up to `OFF`."""
    true = chain(2, samples=120)
    P = cameras()
    motion = BodyMotion(true.rotations, true.translations)
    shell = box_shell([0.0, -0.06, -0.05], [0.8, 0.06, 0.05])
    nearest = cKDTree(true.positions[:, 0]).query(shell)[1]
    label = true.body[nearest]
    settings = MotionBodiesSettings(bodies=2)
    found = find_motion_bodies(MotionPaths(true.positions), settings)

    def read(frame):
        carried = motion.part(slice(frame, frame + 1)).carry(shell, label[:, None], np.ones((len(shell), 1)))[0]
        return BodyCloud(carried, label)

    mesh = model_mesh(build_model(find_motion_skeleton(found, 30.0), found, read, SPACING))
    outlines = drawn(mesh, motion, P)
    ray = outlines.centers[0] - true.positions
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    depth = OFF * np.sin(np.linspace(0, 3, true.positions.shape[1]))[None, :, None]
    paths = MotionPaths(true.positions + depth * ray, ray=ray)
    return true, motion, mesh, outlines, paths, read


def test_edges_of_the_true_surface_are_on_the_outlines(scene):
    _, motion, mesh, outlines, *_ = scene
    pairs = match_outlines(mesh, motion, outlines)
    assert len(pairs.start) == outlines.frames + 1 and pairs.start[-1] == len(pairs.vertex) > 5_000
    assert np.median(np.abs(pairs.away)) < 0.006  # half a pixel
    observed = pairs.observations(mesh.skin, motion)
    frame = observed.frame
    places = motion.carry(mesh.skin.rest, mesh.skin.bodies, mesh.skin.fractions)[frame, observed.point]
    off = ((observed.target - places) * observed.normal).sum(axis=1)
    np.testing.assert_allclose(off, -pairs.away, atol=1e-9)


def test_motion_is_put_right(scene):
    true, _, _, outlines, paths, read = scene
    bodies = find_motion_bodies(paths, MotionBodiesSettings(bodies=2))
    found = find_motion_skeleton(bodies, 30.0, depths_found=True)
    found, bodies = refine_skeleton(found, bodies, paths)
    fit = OutlineFit(model_mesh(build_model(found, bodies, read, SPACING)), outlines)
    _, moved = refine_skeleton(found, bodies, paths, RefinementSettings(rounds=4), fit)

    def errors(result):
        """Distances of the samples from where they truly are, mean of each frame."""
        skin = SkinPoints.of_weights(result.rest, result.weights)
        carried = BodyMotion(result.rotations, result.translations).carry(skin.rest, skin.bodies, skin.fractions)
        start = true.positions[:, 0] - carried[0]
        return np.linalg.norm(carried + start - true.positions.swapaxes(0, 1), axis=2).mean(axis=1)

    assert errors(moved).mean() < 0.6 * errors(bodies).mean()


def test_shape_that_is_too_small_grows(scene):
    true, _, mesh, outlines, _, read = scene
    paths = MotionPaths(true.positions)
    bodies = find_motion_bodies(paths, MotionBodiesSettings(bodies=2))
    found = find_motion_skeleton(bodies, 30.0)
    model = build_model(found, bodies, read, SPACING)
    small = replace(model, points=model.points - 0.012 * model.normals)
    fit = OutlineFit(model_mesh(small), outlines)
    after, _ = refine_skeleton(found, bodies, paths, RefinementSettings(rounds=3), fit)
    rebuilt = fit.model(small, after)
    assert rebuilt.body_count == 2 and len(rebuilt.points) == len(small.points)
    assert distance(mesh, rebuilt.points) < 0.4 * distance(mesh, small.points)


def test_public_function_refines_motion_and_model(scene):
    true, _, mesh, outlines, _, read = scene
    motion = geomocap.find_motion(true.positions, fps=30, bodies=2)
    model = geomocap.build_model(motion.connected, motion.bodies, read, SPACING)
    refined, fitted = geomocap.fit_to_outlines(motion, model, outlines, tracks=true.positions)
    assert refined.body_count == 2 and (refined.labels == motion.labels).mean() > 0.98
    assert distance(mesh, fitted.points) < 0.004
    again, _ = geomocap.fit_to_outlines(motion, model, outlines)
    np.testing.assert_array_equal(again.bodies.rotations, refined.bodies.rotations)
    none = RefinementSettings(outline_rounds=0)
    assert geomocap.fit_to_outlines(motion, model, outlines, settings=none) == (motion, model)
    short = OutlinePoints(outlines.projections, outlines.points[1:])
    with pytest.raises(GeometryError, match="expected as many"):
        geomocap.fit_to_outlines(motion, model, short)


def test_silhouettes_that_are_missing_say_nothing(scene):
    _, motion, mesh, outlines, *_ = scene
    none = [[np.zeros((0, 4), np.float32)] * 4] * outlines.frames
    pairs = match_outlines(mesh, motion, OutlinePoints(outlines.projections, none))
    assert not len(pairs.vertex) and len(pairs.observations(mesh.skin, motion).point) == 0
