"""The world's frame: from floor, points, L-shape, gravity, an existing calibration, or nothing but the cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geomocap.calibration import datum as d
from geomocap.calibration.from_capture import with_points
from geomocap.calibration.network import Network, rotated
from geomocap.calibration.observed_points import read_observed
from geomocap.calibration.world import WorldKnowledge
from geomocap.errors import CalibrationError
from geomocap.model.rig import Rig
from tests.geomocap.bar_scenes import eight_cameras, true_network

SCENE = eight_cameras(6, 20)
TRUE = true_network(SCENE, 1e-3, 0)
TURN = rotated(np.eye(3)[None], np.array([[0.7, -0.4, 1.1]]))[0]
LOST = TRUE.transformed(TURN, np.array([0.3, 2.0, -1.0]))
"""The same network in some other world."""


def project(points: np.ndarray) -> np.ndarray:
    return SCENE.rig.project(points)


def assert_world(network: Network, atol: float = 1e-3) -> None:
    np.testing.assert_allclose(network.bars, TRUE.bars, atol=atol)
    np.testing.assert_allclose(network.rig().centers, SCENE.rig.centers, atol=atol)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_worlds_are_right_handed_with_up_where_it_belongs(up: str) -> None:
    datum = d.datum_from_cameras(LOST, up)
    assert np.linalg.det(datum.rotation) == pytest.approx(1)
    moved = datum.apply(LOST)
    k = "xyz".index(up)
    heights = moved.bars[..., k]
    assert heights.min() == pytest.approx(0, abs=1e-12)
    true = TRUE.bars[..., 2] - TRUE.bars[..., 2].min()
    np.testing.assert_allclose(heights, true, atol=0.35)  # the cameras' mean is a few degrees off
    assert "nothing fixes the world" in datum.warnings[0]


def test_floor_bars() -> None:
    bars = TRUE.bars.copy()
    bars[:3, :, 2] = 0.03  # balls of 3 cm on the floor
    floor = replace(TRUE, bars=bars)
    assert WorldKnowledge(floor=(0, 1, 2)).doubts(np.arange(20)) == ()
    (told,) = WorldKnowledge(floor=tuple(range(101))).doubts(np.arange(20))
    assert "81 of the 101 frames named, 20 to 100, are not in the recording, which has 20 frames, 0 to 19" in told
    lost = floor.transformed(TURN, np.array([0.3, 2.0, -1.0]))
    found = d.datum_from_floor(lost, (0, 1, 2), "z", 0.03)
    moved = found.apply(lost)
    np.testing.assert_allclose(moved.bars[..., 2], bars[..., 2], atol=1e-9)
    assert not found.warnings and "3 bars on the floor" in found.source
    bars[1, 1, 2] = 0.2
    tilted = replace(TRUE, bars=bars)
    assert "off their plane" in d.datum_from_floor(tilted, (0, 1, 2), "z", 0.03).warnings[0]
    with pytest.raises(CalibrationError, match="two different places"):
        d.datum_from_floor(lost, (0, 99), "z")
    line = bars.copy()
    line[1] = line[0] + (line[0, 1] - line[0, 0])
    with pytest.raises(CalibrationError, match="one line"):
        d.datum_from_floor(replace(TRUE, bars=line), (0, 1), "z")


def test_known_points() -> None:
    world = np.array([[0, 0, 0], [0.8, 0, 0], [0, 0.6, 0], [0.1, 0.2, 0.7]])
    found = d.datum_from_points(LOST, project(world), world)
    assert_world(found.apply(LOST))
    with pytest.raises(CalibrationError, match="millimetres"):
        d.datum_from_points(LOST, project(world), 1000 * world)
    with pytest.raises(CalibrationError, match="one line"):
        line = world * [1, 0, 0] + [[0, 0, 0], [0, 0, 0], [0.3, 0, 0], [0.5, 0, 0]]
        d.datum_from_points(LOST, project(line), line)
    few = project(world)
    few[1:] = np.nan
    with pytest.raises(CalibrationError, match="only 0 of 4"):
        d.datum_from_points(LOST, few, world)


def test_points_from_tables(tmp_path: Path) -> None:
    world = {"a": np.array([0.0, 0, 0]), "b": np.array([0.8, 0, 0]), "c": np.array([0, 0.6, 0.0])}
    lines = ["frame,camera,point,x,y"]
    for name, X in world.items():
        for camera, (x, y) in zip(SCENE.rig.names, project(X[None])[:, 0], strict=True):
            lines.append(f"0,{camera},{name},{x},{y}")
    (tmp_path / "seen.csv").write_text("\n".join(lines))
    filled = with_points(WorldKnowledge(), read_observed(tmp_path / "seen.csv"), world, SCENE.rig.names)
    assert filled.points_pixels is not None and filled.points_world is not None
    assert_world(d.datum_from_points(LOST, filled.points_pixels, filled.points_world).apply(LOST))


def test_l_shape() -> None:
    corner, long, short = np.array([[0.1, 0.2, 0.05], [0.9, 0.2, 0.05], [0.1, 0.65, 0.05]])
    rng = np.random.default_rng(0)
    pixels = project(np.array([corner, long, short]))
    shuffled = np.array([rng.permutation(p) for p in pixels])
    found = d.datum_from_l_shape(LOST, shuffled, 0.8, 0.45, "z")
    assert_world(found.apply(LOST).transformed(np.eye(3), corner))
    assert not found.warnings
    with pytest.raises(CalibrationError, match="no assignment"):
        d.datum_from_l_shape(LOST, shuffled, 1.3, 0.45, "z")
    mixed = d.datum_from_l_shape(LOST, project(np.array([corner, short, long]) * [1, 1, -1]), 0.8, 0.45, "z")
    assert np.linalg.det(mixed.rotation) == pytest.approx(1)


def test_gravity_of_a_camera() -> None:
    down = SCENE.rig.cam_from_world[3, :, :3] @ [0, 0, -9.81]
    found = d.datum_from_gravity(LOST, "cam3", down, "z")
    moved = found.apply(LOST)
    np.testing.assert_allclose(moved.bars[..., 2], TRUE.bars[..., 2] - TRUE.bars[..., 2].min(), atol=1e-9)
    with pytest.raises(CalibrationError, match="no camera nobody"):
        d.datum_from_gravity(LOST, "nobody", down, "z")
    with pytest.raises(CalibrationError, match="not all zero"):
        d.datum_from_gravity(LOST, "cam3", np.zeros(3), "z")


def test_alignment_with_an_existing_calibration() -> None:
    assert_world(d.datum_from_rig(LOST, SCENE.rig).apply(LOST))
    two = SCENE.rig.select(["cam5", "cam1"])
    assert_world(d.datum_from_rig(LOST, two).apply(LOST))
    poses = np.array(SCENE.rig.cam_from_world)
    poses[:, :, 3] *= 1000
    found = d.datum_from_rig(LOST, Rig(SCENE.rig.names, SCENE.rig.cameras, poses))
    assert "millimetres" in found.warnings[0]
    assert_world(found.apply(LOST))
    with pytest.raises(CalibrationError, match="fewer than two"):
        d.datum_from_rig(LOST, SCENE.rig.select(["cam0"]))


def test_rigid_alignment_never_mirrors() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3))
    R, _, scale = d.rigid_alignment(points, points * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1)
    R, _, scale = d.rigid_alignment(points, 2.5 * points @ TURN.T + [1, 2, 3])
    np.testing.assert_allclose(R, TURN, atol=1e-12)
    assert scale == pytest.approx(2.5)
