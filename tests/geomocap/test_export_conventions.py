import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.export import conventions
from geomocap.export.conventions import Convention, file_from_world

AXES = "xyz"


@pytest.mark.parametrize(("world", "file"), list(itertools.product(AXES, AXES)))
def test_up_goes_up_and_left_stays_left(world, file):
    turn = file_from_world(world, file)
    np.testing.assert_allclose(turn @ np.eye(3)[AXES.index(world)], np.eye(3)[AXES.index(file)])
    assert np.linalg.det(turn) == pytest.approx(1)  # a mirrored world has -1
    np.testing.assert_allclose(turn @ turn.T, np.eye(3))


def test_z_up_becomes_y_up_as_gltf_exporters_do():
    np.testing.assert_allclose(conventions.GLB.points(np.array([1.0, 2, 3]), "z"), [1, 3, -2])


@pytest.mark.parametrize(("unit", "expected"), [("m", 1.5), ("cm", 150), ("mm", 1500)])
def test_units(unit, expected):
    np.testing.assert_allclose(Convention("z", unit).points(np.array([1.5, 0, 0]), "z"), [expected, 0, 0])


@pytest.mark.parametrize(("up", "file"), list(itertools.product(AXES, AXES)))
def test_there_and_back_and_rotations_go_with_points(up, file):
    rng = np.random.default_rng(1)
    points, turns = rng.normal(size=(5, 3)), Rotation.random(5, rng=rng).as_matrix()
    convention = Convention(file, "mm")
    np.testing.assert_allclose(convention.world_points(convention.points(points, up), up), points)
    turned_then_converted = convention.points(np.einsum("nij,nj->ni", turns, points), up)
    converted_then_turned = np.einsum("nij,nj->ni", convention.rotations(turns, up), convention.points(points, up))
    np.testing.assert_allclose(turned_then_converted, converted_then_turned)
