"""The skeleton of bodies found from motion paths: joints, hierarchy, and bones that keep their length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.errors import GeometryError
from geomocap.model.skeleton import Skeleton, bone_fixed_skeleton
from geomocap.skeleton.articulated_motion import fit_articulated, prior_moments
from geomocap.skeleton.borders import Border, contacts, find_borders
from geomocap.skeleton.common_points import CommonPoint, common_point
from geomocap.skeleton.motion_skeleton_settings import MotionSkeletonSettings
from geomocap.skeleton.spanning_tree import Connection, connect_by_cost, connection_cost
from geomocap.skeleton.temporal_smoothing import smooth_positions, smooth_rotations

_UNSEEN = 0.05
_BRIDGE = 1e-3
_LEAST_MISS = 5e-4  # diagonals


@dataclass(frozen=True)
class MotionSkeleton:
    """A skeleton and what is known of its joints.

    Attributes
    ----------
    skeleton : Skeleton
    joints : tuple of CommonPoint
        In the order of the skeleton's joints.
    costs : (J,) float, metres
        What each connection cost.
    """

    skeleton: Skeleton
    joints: tuple[CommonPoint, ...]
    costs: np.ndarray


def find_motion_skeleton(
    bodies: MotionBodies, fps: float, settings: MotionSkeletonSettings | None = None
) -> MotionSkeleton:
    """Find the joints, connect the bodies, and let bones keep their length.

    Parameters
    ----------
    bodies : MotionBodies
    fps : float
        Frames per second.
    settings : MotionSkeletonSettings, optional

    Raises
    ------
    GeometryError
        If there are no bodies.
    """
    settings = settings or MotionSkeletonSettings()
    count = bodies.body_count
    if count == 0:
        raise GeometryError("no rigid bodies to connect: at least two frames with motion are needed")
    sizes = np.bincount(bodies.label[bodies.label >= 0], minlength=count) / len(bodies.label)
    # A joint between any two bodies that come near each other
    connections = possible_connections(bodies, settings)
    # The tree
    hierarchy, chosen = connect_by_cost(connections, count, sizes)
    joints = np.array([c.joint.point for c in chosen]).reshape(-1, 3)
    # Bones that keep their length
    middle = np.stack([bodies.rest[bodies.label == b].mean(axis=0) for b in range(count)])
    spread = [np.sqrt(((bodies.rest[bodies.label == b] - middle[b]) ** 2).sum(axis=1).mean()) for b in range(count)]
    weights = bodies.reliability * sizes * len(bodies.label) + 1e-3
    turned, moved = _smooth_motion(bodies, middle, settings.smoothing)
    moments = prior_moments(turned, moved, middle, np.array(spread), weights)
    motion = fit_articulated(moments, hierarchy, joints, turned, settings.rounds)
    centers = np.einsum("tbij,bj->tbi", motion.rotations, middle) + motion.translations
    skeleton = bone_fixed_skeleton(hierarchy, joints, motion.rotations, motion.joint_positions, centers, middle, fps)
    return MotionSkeleton(skeleton, tuple(c.joint for c in chosen), np.array([c.cost for c in chosen]))


def _smooth_motion(bodies: MotionBodies, middle: np.ndarray, strength: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations of all bodies, smooth in time; frames without samples are bridged."""
    rotations, translations = bodies.rotations.copy(), bodies.translations.copy()
    for b in range(bodies.body_count):
        weights = bodies.reliability[:, b] / max(float(bodies.reliability[:, b].max()), 1e-9)
        # where nothing is seen the motion is bridged in any case
        bridged = strength if strength > 0 else (_BRIDGE if (weights < _UNSEEN).any() else 0.0)
        weights = np.where(weights < _UNSEEN, 0.0, weights)
        rotations[:, b] = smooth_rotations(bodies.rotations[:, b], weights, bridged)
        path = smooth_positions(bodies.centers[:, b], weights, bridged, _LEAST_MISS * bodies.diagonal)
        translations[:, b] = path - rotations[:, b] @ middle[b]
    return rotations, translations


def possible_connections(bodies: MotionBodies, settings: MotionSkeletonSettings) -> list[Connection]:
    """Joints between all bodies that come near each other, and more until every body can be reached."""
    count = bodies.body_count
    limit = settings.largest_gap * bodies.diagonal
    borders = find_borders(bodies, limit)
    while connected_components(_reached(borders, count))[0] > 1:
        limit *= 2.0
        borders = find_borders(bodies, limit)
    contact = contacts(bodies)
    whole = np.maximum(contact.sum(axis=1), 1)
    weights = (settings.interface_weight, settings.gap_weight, settings.contact_weight * bodies.diagonal)
    noise = 2e-4 * bodies.diagonal
    result = []
    for (a, b), border in borders.items():
        motions = (
            (bodies.rotations[:, a], bodies.rotations[:, b]),
            (bodies.translations[:, a], bodies.translations[:, b]),
        )
        reliability = np.minimum(bodies.reliability[:, a], bodies.reliability[:, b]) + 1e-3
        interface = border.middle
        certainty = (settings.interface_prior, border.spread, noise, settings.hinge_fraction)
        joint = common_point(*motions, reliability, interface, *certainty)
        if joint.hinge:
            # every point of its axis is common: the joint is in the middle of what the bodies share of it
            interface = border.middle_along(joint.point, joint.axis)
            joint = common_point(*motions, reliability, interface, *certainty)
        off = float(np.linalg.norm(joint.point - interface))
        fraction = float(contact[a, b] / min(whole[a], whole[b]))
        cost = connection_cost(joint.miss, off, border.gap, fraction, weights)
        result.append(Connection((a, b), joint, interface, border.gap, cost))
    return result


def _reached(borders: dict[tuple[int, int], Border], count: int) -> csr_matrix:
    rows, columns = np.array(list(borders), int).reshape(-1, 2).T
    return csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
