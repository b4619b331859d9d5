"""Nodes in images: a limb that was lost is found again, and followed back to where it went."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.spatial import cKDTree

from geomocap.nodes.anchors import Anchors
from geomocap.nodes.correspondences import Target
from geomocap.nodes.image_pull import FrameImages
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_tracking import NodeModel
from geomocap.nodes.surface_points import point_set
from tests.geomocap.test_nodes_tracking import bend, capsule

SMALL = NodeTrackingSettings(nodes=150, coarse_nodes=60, points=1200, coarse_points=800)
ANGLES = np.deg2rad([0.0, 0.0, 90.0, 90.0, 90.0, 90.0])
REGAINED = 4
"""Frame from which the geometry has the limb."""


def even(frame: int) -> FrameImages:
    """Images of one camera in which nothing can be told."""
    return FrameImages.of(
        SimpleNamespace(
            levels=np.zeros((2, 1, 16, 16), np.float32),
            masks=np.ones((1, 16, 16), np.uint8),
            depth=np.full((1, 16, 16), 5.0, np.float32),
            projections=np.array([[[8.0, 0, 8, 40], [0, 8, 8, 40], [0, 0, 1, 5]]]),
            voxel_size=0.01,
        )
    )


def test_a_lost_limb_is_found_again_and_followed_back():
    frames = [point_set(bend(capsule(1200, seed=k), a), 1200, 12) for k, a in enumerate(ANGLES)]
    model = NodeModel(frames[0], SMALL)
    at_rest, still = model.graph.nodes, np.tile(np.eye(3), (len(model.graph.nodes), 1, 1))
    truth = [bend(at_rest, a) for a in ANGLES]
    geometric = [(truth[k] if k >= REGAINED else at_rest, still) for k in range(len(frames))]
    targets = [Target(frame, np.zeros(0)) for frame in frames]

    states = model.image_motion().follow(targets, even, geometric, 0, 1, Anchors.none(len(frames)))

    limb = at_rest[:, 0] > 0.65
    far = [float(np.median(np.linalg.norm(x - y, axis=1)[limb])) for (x, _), y in zip(states, truth, strict=True)]
    spacing = model.graph.spacing
    assert max(far) < spacing, far  # without, three spacings or more in frames 2 and 3
    where = cKDTree(frames[2].positions).query(model.graph.deform(*states[2])[0])[0]
    assert np.median(where) < 0.3 * spacing
