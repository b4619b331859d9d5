"""What a joint of a tree of bodies can be told by: what lies beyond it, how far it reaches, where it is.

Every joint parts the bodies in two sides. One of them is *beyond* the joint, that which doesn't hold the trunk; which
one comes out of matching, so a found joint is looked at both ways.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geomocap.model.hierarchy import Hierarchy


@dataclass(frozen=True)
class PosedTree:
    """B bodies of a tree in one posture.

    Attributes
    ----------
    hierarchy : Hierarchy
    joints : (B - 1, 3) float
    centers : (B, 3) float
    lengths : (B, B - 1) float
        From each joint to the farthest point of each of its two bodies; NaN for bodies that are not at the joint.
    surfaces : (B,) float
        Shares of the surface.
    """

    hierarchy: Hierarchy
    joints: np.ndarray
    centers: np.ndarray
    lengths: np.ndarray
    surfaces: np.ndarray


@dataclass(frozen=True)
class JointFeatures:
    """Features of V ways to look at joints. Lengths are in fractions of the longest way through the tree.

    Attributes
    ----------
    joint : (V,) int
    beyond : (V, B) bool
        Bodies beyond the joint.
    surface, reach : (V,) float
        Logarithms of the fraction of the surface beyond, and of the longest way from the joint through the tree there.
    place, center : (V, 3) float
        Of the joint, from the centre of the surface; of what is beyond, from the joint.
    diameter : float
        The longest way.
    """

    joint: np.ndarray
    beyond: np.ndarray
    surface: np.ndarray
    reach: np.ndarray
    place: np.ndarray
    center: np.ndarray
    diameter: float

    @cached_property
    def nesting(self) -> np.ndarray:
        """How what is beyond lies to each other, (V, V), see `nesting`."""
        return nesting(self.beyond, self.beyond)


def joint_features(tree: PosedTree, *, both_ways: bool) -> JointFeatures:
    """Return the features of all joints, looked at from the root, or both ways: first all from the root."""
    pairs = tree.hierarchy.joint_bodies
    outward = _outward(tree.hierarchy)
    reach = _reaches(tree)
    diameter = max(float(reach.sum(axis=1).max()), 1e-9)
    beyond = np.concatenate([outward, ~outward]) if both_ways else outward
    joint = np.tile(np.arange(len(pairs)), 2 if both_ways else 1)
    reach = np.concatenate([reach[:, 0], reach[:, 1]]) if both_ways else reach[:, 0]
    weights = beyond * tree.surfaces
    fraction = weights.sum(axis=1)
    middle = tree.surfaces @ tree.centers / tree.surfaces.sum()
    center = (weights @ tree.centers) / np.maximum(fraction, 1e-12)[:, None] - tree.joints[joint]
    return JointFeatures(
        joint,
        beyond,
        np.log(np.maximum(fraction, 1e-6)),
        np.log(np.maximum(reach / diameter, 1e-6)),
        (tree.joints[joint] - middle) / diameter,
        center / diameter,
        diameter,
    )


def nesting(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """How sets lie to each other, (V, W) int: 0 apart, 1 the first in the second, 2 the second in the first, 3 else.

    Parameters
    ----------
    first, second : (V, B), (W, B) bool
    """
    common = first.astype(int) @ second.T.astype(int)
    inside = common == first.sum(axis=1)[:, None]
    around = common == second.sum(axis=1)[None]
    return np.where(common == 0, 0, np.where(inside, 1, np.where(around, 2, 3)))


def _outward(hierarchy: Hierarchy) -> np.ndarray:
    """Bodies on the child's side of each joint, (J, B) bool."""
    pairs = hierarchy.joint_bodies
    beyond = np.zeros((len(pairs), len(pairs) + 1), bool)
    for j in range(len(pairs) - 1, -1, -1):
        child = int(pairs[j, 1])
        beyond[j, child] = True
        beyond[j] |= beyond[np.flatnonzero(pairs[:, 0] == child)].any(axis=0)
    return beyond


def _reaches(tree: PosedTree) -> np.ndarray:
    """Longest way from each joint on the child's and on the parent's side, (J, 2)."""
    pairs = tree.hierarchy.joint_bodies
    at_body: list[list[int]] = [np.flatnonzero((pairs == b).any(axis=1)).tolist() for b in range(len(pairs) + 1)]
    known: dict[tuple[int, int], float] = {}

    def reach(joint: int, body: int) -> float:
        if (joint, body) not in known:
            own = float(tree.lengths[body, joint])
            ways = [own]
            for other in at_body[body]:
                if other != joint:
                    beyond = int(pairs[other].sum()) - body
                    step = float(np.linalg.norm(tree.joints[other] - tree.joints[joint]))
                    ways.append(step + reach(other, beyond))
            known[joint, body] = max(ways)
        return known[joint, body]

    return np.array([[reach(j, int(child)), reach(j, int(parent))] for j, (parent, child) in enumerate(pairs)])
