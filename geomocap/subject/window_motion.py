"""A model's motion through windows of a recording, joined into one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomocap.model.rotations import nearest_rotation
from geomocap.model.skeleton import Skeleton
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, joint_motion


def pose_of(linkage: Linkage, bodies: BodyMotion, frame: int) -> JointMotion:
    """Pose of a linkage in one frame of its bodies' motion."""
    return _joints(linkage, bodies.part(slice(frame, frame + 1)))


def motion_of(skeleton: Skeleton) -> BodyMotion:
    """Motion of a skeleton's bodies from the pose of frame 0."""
    start = skeleton.body_positions[0]
    shifts = skeleton.body_positions - np.einsum("tbij,bj->tbi", skeleton.body_rotations, start)
    return BodyMotion(skeleton.body_rotations, shifts)


def joined_motion(linkage: Linkage, windows: Sequence[range], motions: Sequence[BodyMotion]) -> BodyMotion:
    """Join the motions of windows that share frames: there one goes over evenly into the other.

    Parameters
    ----------
    linkage : Linkage
        Whose bodies turn about the joints that they hang on.
    windows : sequence of range
        Frames of each, in order; each shares some with the next only.
    motions : sequence of BodyMotion
        From one rest pose.
    """
    count = windows[-1].stop
    places = linkage.places
    rotations = np.zeros((count, linkage.body_count, 3, 3))
    carried = np.zeros((count, linkage.body_count, 3))
    weight = np.zeros(count)
    for k, (window, motion) in enumerate(zip(windows, motions, strict=True)):
        fraction = np.ones(len(window))
        if k > 0:
            shared = windows[k - 1].stop - window.start
            fraction[:shared] = np.arange(1, shared + 1) / (shared + 1)
        if k + 1 < len(windows):
            shared = window.stop - windows[k + 1].start
            fraction[len(fraction) - shared :] = np.arange(shared, 0, -1) / (shared + 1)
        frames = slice(window.start, window.stop)
        rotations[frames] += fraction[:, None, None, None] * motion.rotations
        moved = np.einsum("tbij,bj->tbi", motion.rotations, places) + motion.translations
        carried[frames] += fraction[:, None, None] * moved
        weight[frames] += fraction
    turned = nearest_rotation(rotations)
    carried /= weight[:, None, None]
    return BodyMotion(turned, carried - np.einsum("tbij,bj->tbi", turned, places))


def _joints(linkage: Linkage, bodies: BodyMotion) -> JointMotion:
    root = linkage.hierarchy.root
    path = bodies.rotations[:, root] @ linkage.origin + bodies.translations[:, root]
    return joint_motion(linkage, bodies.rotations, path)
