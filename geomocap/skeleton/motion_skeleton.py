"""The skeleton of bodies found from motion paths: joints, hierarchy, and bones that keep their length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from geomocap.bodies.body_settings import FOLLOWED
from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.errors import GeometryError
from geomocap.model.skeleton import Skeleton, bone_fixed_skeleton
from geomocap.skeleton.articulated_adjustment import adjust
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.borders import Border, contacts, find_borders
from geomocap.skeleton.common_points import INDEPENDENT, CommonPoint, common_point
from geomocap.skeleton.kinematics import BodyMotion, Linkage, joint_motion
from geomocap.skeleton.motion_skeleton_settings import MotionSkeletonSettings
from geomocap.skeleton.spanning_tree import Connection, connect_by_cost, connection_cost


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
    borders : tuple of Border
        Where the two bodies of each joint touch.
    """

    skeleton: Skeleton
    joints: tuple[CommonPoint, ...]
    costs: np.ndarray
    borders: tuple[Border, ...]


def find_motion_skeleton(
    bodies: MotionBodies, fps: float, settings: MotionSkeletonSettings | None = None, depths_found: bool = False
) -> MotionSkeleton:
    """Find the joints, connect the bodies, and let bones keep their length.

    Parameters
    ----------
    bodies : MotionBodies
    fps : float
        Frames per second.
    settings : MotionSkeletonSettings, optional
    depths_found : bool
        Bodies follow what single cameras see, whose depths are found from the motion. A sample that lies too deep does
        so in all frames: motions err alike in them, however many there are, and a joint is the more where bodies touch.

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
    connections = possible_connections(bodies, settings, 0.0 if depths_found else INDEPENDENT)
    # The tree
    hierarchy, chosen = connect_by_cost(connections, count, sizes)
    joints = np.array([c.joint.point for c in chosen]).reshape(-1, 3)
    # Bodies that hang on each other
    middle = np.stack([bodies.rest[bodies.label == b].mean(axis=0) for b in range(count)])
    axes = np.array([c.joint.axis for c in chosen]).reshape(-1, 3)
    linkage = Linkage(hierarchy, joints, axes, np.zeros(len(joints), bool), middle[hierarchy.root])
    motion = _connected_motion(linkage, bodies, middle)
    centers = np.einsum("tbij,bj->tbi", motion.rotations, middle) + motion.translations
    places = linkage.joint_positions(motion)
    skeleton = bone_fixed_skeleton(hierarchy, joints, motion.rotations, places, centers, middle, fps)
    costs = np.array([c.cost for c in chosen])
    return MotionSkeleton(skeleton, tuple(c.joint for c in chosen), costs, tuple(c.border for c in chosen))


def joined_apart(found: MotionSkeleton, diagonal: float, settings: MotionSkeletonSettings) -> tuple[str, ...]:
    """Say which bodies were connected although they are farther apart than bodies that touch somewhere."""
    limit = settings.largest_gap * diagonal
    names = found.skeleton.body_names
    apart = [
        f"{names[a]} and {names[b]} ({border.gap:.2g} m)"
        for (a, b), border in zip(found.skeleton.joint_bodies, found.borders, strict=True)
        if border.gap > limit
    ]
    if not apart:
        return ()
    return (
        f"bodies are connected that are farther apart than {limit:.2g} m (motion_skeleton.largest_gap): "
        f"{', '.join(apart)}; if they are things of their own, the joint between them is there for the motion files "
        "only, which take one tree",
    )


def _connected_motion(linkage: Linkage, bodies: MotionBodies, middle: np.ndarray) -> BodyMotion:
    """Motion of connected bodies nearest to what each does by itself, as if each were six of its points."""
    count = bodies.body_count
    members = [bodies.rest[bodies.label == b] for b in range(count)]
    radii = np.array([np.sqrt(((m - c) ** 2).sum(axis=1).mean()) for m, c in zip(members, middle, strict=True)])
    ends = np.concatenate([np.eye(3), -np.eye(3)])
    rest = (middle[:, None] + radii[:, None, None] * ends).reshape(-1, 3)
    own = np.repeat(np.arange(count), len(ends))
    points = SkinPoints.of_weights(rest, np.eye(count)[own])
    targets = BodyMotion(bodies.rotations, bodies.translations).carry(rest, points.bodies, points.fractions)
    weights = bodies.reliability * [len(m) for m in members] + 1e-3
    sigma = bodies.diagonal / np.sqrt(weights)  # far above all misses: plain least squares
    observations = Observations.of_paths(targets.swapaxes(0, 1), sigma.T[own])
    start = joint_motion(linkage, bodies.rotations, bodies.centers[:, linkage.hierarchy.root])
    return adjust(linkage, start, points, observations).bodies


def possible_connections(
    bodies: MotionBodies, settings: MotionSkeletonSettings, independence: float = INDEPENDENT
) -> list[Connection]:
    """Joints between all bodies that come near each other, and more until every body can be reached.

    Motion files take one tree of bodies; see `joined_apart`.
    """
    count = bodies.body_count
    limit = settings.largest_gap * bodies.diagonal
    borders = find_borders(bodies, limit)
    while connected_components(_reached(borders, count))[0] > 1:
        limit *= 2.0
        borders = find_borders(bodies, limit)
    contact = contacts(bodies)
    whole = np.maximum(contact.sum(axis=1), 1)
    weights = (settings.interface_weight, settings.gap_weight, settings.contact_weight * bodies.diagonal)
    noise = FOLLOWED * bodies.diagonal
    result = []
    for (a, b), border in borders.items():
        motions = (
            (bodies.rotations[:, a], bodies.rotations[:, b]),
            (bodies.translations[:, a], bodies.translations[:, b]),
        )
        reliability = np.minimum(bodies.reliability[:, a], bodies.reliability[:, b]) + 1e-3
        prior = settings.interface_prior
        joint = common_point(*motions, reliability, border.middle, prior, border.spread, noise, independence)
        off = float(np.linalg.norm(joint.point - border.middle))
        fraction = float(contact[a, b] / min(whole[a], whole[b]))
        cost = connection_cost(joint.miss, off, border.gap, fraction, weights)
        result.append(Connection((a, b), joint, border, cost))
    return result


def _reached(borders: dict[tuple[int, int], Border], count: int) -> csr_matrix:
    rows, columns = np.array(list(borders), int).reshape(-1, 2).T
    return csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
