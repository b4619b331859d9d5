"""The surface that tracks start on."""

import importlib

import numpy as np
from numpy.testing import assert_allclose

stage = importlib.import_module("geomocap.pipeline.tracks")


def test_a_cloud_becomes_the_voxels_that_hold_its_points():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [1, 1, 0.01]
    voxels = stage.surface_voxels(points, 0.1)
    away = np.abs(points[:, None] - voxels.points[None]).max(axis=2)
    assert (away.min(axis=1) <= 0.05 + 1e-12).all()  # each point lies in one
    assert (away.min(axis=0) <= 0.05 + 1e-12).all()  # and none is empty
    assert len(np.unique(voxels.indices, axis=0)) == len(voxels.indices)
    assert_allclose(voxels.voxel_size, 0.1)
    assert len(stage.surface_voxels(np.zeros((0, 3)), 0.1).indices) == 0
