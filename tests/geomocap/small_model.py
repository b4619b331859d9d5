"""A subject's model of two bodies, as small as one can be."""

from __future__ import annotations

import numpy as np

from geomocap.subject.subject_model import SubjectModel


def small_model() -> SubjectModel:
    """Two boxes end to end with a hinge between them."""
    points = np.random.default_rng(0).uniform([-0.4, -0.05, -0.05], [0.4, 0.05, 0.05], (60, 3))
    second = (points[:, 0] > 0).astype(np.int32)
    one = np.eye(4)[0]
    return SubjectModel(
        points=points,
        normals=np.tile([0.0, 0, 1], (60, 1)),
        colors=np.full((60, 3), 128, np.uint8),
        skin_bodies=np.stack([second, 1 - second, second, second], axis=1),
        skin_weights=np.tile(one, (60, 1)),
        joints=np.zeros((1, 3)),
        joint_bodies=np.array([[0, 1]], np.int32),
        joint_axes=np.array([[0.0, 1, 0]]),
        joint_hinge=np.array([True]),
        joint_limits=np.array([[[-1.0, -0.1, -0.1], [1.0, 0.1, 0.1]]]),
        joint_names=np.array(["joint_body00_body01"]),
        body_names=np.array(["body00", "body01"]),
        root=0,
        origin=np.zeros(3),
        body_extents=np.full((2, 3), 0.2),
        poses=np.tile(np.eye(3), (2, 2, 1, 1)),
        diagonal=float(np.linalg.norm(np.ptp(points, axis=0))),
        spacing=0.02,
    )
