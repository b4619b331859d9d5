"""From a skeleton to a motion that files can hold.

Every body becomes a node at the joint to its parent body. Where joints are fixed in their bodies, constant offsets
reproduce them exactly; where they move (joints that were found frame by frame), the node gets a translation of its own
in every frame, so that the skeleton's joints are always met.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from geomocap.export.conventions import Axis
from geomocap.export.motion_tree import MotionTree
from geomocap.export.names import Names
from geomocap.model.hierarchy import Hierarchy
from geomocap.model.rotations import fill_rotations
from geomocap.model.skeleton import Skeleton

JointMode = Literal["auto", "fixed", "moving"]
FIXED_WITHIN = 1e-5  # m: a joint that stays this near its mean place in the parent body is fixed; ten add up to 0.1 mm
SHORTEST_TIP, END_BONE = 0.0005, 0.03  # fractions of the skeleton's diagonal: shorter tips are replaced by end bones
UNKNOWN_RADIUS = 0.05  # m


def motion_from_skeleton(
    skeleton: Skeleton,
    *,
    up: Axis = "z",
    names: Names | None = None,
    joints: JointMode = "auto",
    radius: float = UNKNOWN_RADIUS,
    root: int | None = None,
) -> MotionTree:
    """Make a motion of a skeleton.

    Gaps (NaN) are filled: rotations and positions between their neighbours in time, fixed joints by their offset.

    Parameters
    ----------
    skeleton : Skeleton
    up : "x", "y" or "z"
        World axis that points up.
    names : Names, optional
        The user's names.
    joints : "auto", "fixed" or "moving"
        fixed: constant offsets, the mean of where a joint lies in its parent body. moving: every node gets its
        translation in every frame. auto: only those nodes get it that no constant offset reproduces within 0.01 mm.
    radius : float, metres
        Size of a single body, which a skeleton without joints can't tell; its bone is as long.
    root : int, optional
        Body that the tree grows from; by default the skeleton's.

    Raises
    ------
    MotionError
        If the names don't fit.
    """
    body_names = (names or Names()).body_names(skeleton.body_count, skeleton.body_names)
    rotations = np.stack([fill_rotations(r) for r in skeleton.body_rotations.swapaxes(0, 1)], axis=1)
    tree, numbers = skeleton.hierarchy, np.arange(skeleton.joint_count)
    if root is not None and root != tree.root:
        tree, numbers = tree.grown_from(root)
    joint_positions = skeleton.joint_positions[:, numbers]
    chain = _Chain(tree, rotations, joint_positions, skeleton.body_positions, joints, up, radius)
    chain.add_root(body_names[tree.root], tree.root)
    for body in tree.order[1:]:
        chain.add_joint(body_names[body], int(tree.parents[body]), body, int(tree.body_joints[body]))
    motion = chain.motion(skeleton.fps)
    return replace(motion, joints=np.array([numbers[j] if j >= 0 else -1 for j in motion.joints.tolist()]))


@dataclass(frozen=True)
class _Node:
    """One node while the tree is being made; `world_*` are what forward kinematics will give."""

    name: str
    parent: int
    body: int
    joint: int
    moving: bool
    local: np.ndarray  # (T, 3)
    turn: np.ndarray  # (T, 3, 3), parent from node
    world_origin: np.ndarray  # (T, 3)
    world_rotation: np.ndarray  # (T, 3, 3)


@dataclass
class _Chain:
    """Nodes, added one by one from the root outwards."""

    tree: Hierarchy
    rotations: np.ndarray
    joint_positions: np.ndarray
    body_positions: np.ndarray
    mode: JointMode
    up: Axis
    radius: float
    nodes: list[_Node] = field(default_factory=list)
    node_of_body: dict[int, int] = field(default_factory=dict)

    def add_root(self, name: str, body: int) -> None:
        """Add the body without a parent; it has a translation in every frame."""
        origin, R = self._root_origin(body), self.rotations[:, body]
        self.node_of_body[body] = len(self.nodes)
        self.nodes.append(_Node(name, -1, body, -1, True, origin, R, origin, R))

    def _root_origin(self, body: int) -> np.ndarray:
        """Origin (T, 3) of a root: its centre, corrected so that its joints are fixed in it if that can be had.

        A body's centre may wander in the body where its joints don't. With d the mean places of the joints relative to
        the centre, the mean over the joints of p_j(t) - R(t) d_j moves rigidly with them.
        """
        R, centre = self.rotations[:, body], fill_positions(self.body_positions[:, body])
        joints = self.tree.body_joints[np.flatnonzero(self.tree.parents == body)]
        p = self.joint_positions[:, joints]
        if self.mode == "moving" or not len(joints) or not np.isfinite(p).all():
            return centre
        d = np.einsum("tji,tkj->tki", R, p - centre[:, None]).mean(axis=0)
        return (p - np.einsum("tij,kj->tki", R, d)).mean(axis=1)

    def add_joint(self, name: str, parent_body: int, body: int, joint: int) -> None:
        """Add a node at a joint, fixed in the parent body if a constant offset reproduces it."""
        parent = self.nodes[self.node_of_body[parent_body]]
        R_parent, origin = parent.world_rotation, parent.world_origin
        local = np.einsum("tji,tj->ti", R_parent, self.joint_positions[:, joint] - origin)
        good = np.isfinite(local).all(axis=1)
        offset = local[good].mean(axis=0) if good.any() else np.zeros(3)
        spread = np.linalg.norm(local[good] - offset, axis=1).max(initial=0.0)
        moving = bool(self.mode == "moving" or (self.mode == "auto" and spread > FIXED_WITHIN))
        local = fill_positions(local) if moving else np.tile(offset, (len(local), 1))
        R = self.rotations[:, body]
        turn = np.einsum("tji,tjk->tik", R_parent, R)
        world = origin + np.einsum("tij,tj->ti", R_parent, local)
        index = self.node_of_body[parent_body]
        self.node_of_body[body] = len(self.nodes)
        self.nodes.append(_Node(name, index, body, joint, moving, local, turn, world, R))

    def motion(self, fps: float) -> MotionTree:
        """Return the finished motion."""
        nodes = self.nodes
        return MotionTree(
            names=tuple(n.name for n in nodes),
            parents=np.array([n.parent for n in nodes]),
            offsets=np.stack([n.local[0] for n in nodes]),
            rotations=np.stack([n.turn for n in nodes], axis=1),
            translations=np.stack([n.local for n in nodes], axis=1),
            moving=np.array([n.moving for n in nodes]),
            tips=self._tips(),
            bodies=np.array([n.body for n in nodes]),
            joints=np.array([n.joint for n in nodes]),
            fps=fps,
            up=self.up,
        )

    def _tips(self) -> np.ndarray:
        """End of each node without children: its joint mirrored at the body's centre, mean over time.

        A bone needs some length to be seen: where joint and centre coincide it points up.
        """
        diagonal = self._diagonal()
        end = (END_BONE * diagonal or self.radius) * np.eye(3)["xyz".index(self.up)]
        parents = {n.parent for n in self.nodes}
        tips = np.full((len(self.nodes), 3), np.nan)
        for i, node in enumerate(self.nodes):
            if i in parents:
                continue
            to_centre = self.body_positions[:, node.body] - node.world_origin
            local = np.einsum("tji,tj->ti", node.world_rotation, to_centre)
            good = np.isfinite(local).all(axis=1)
            tips[i] = 2 * local[good].mean(axis=0) if good.any() else 0.0
            if np.linalg.norm(tips[i]) <= SHORTEST_TIP * diagonal:
                tips[i] = end
        return tips

    def _diagonal(self) -> float:
        """Diagonal of the box around joints and bodies' centres in the first frame, metres; 0 of a single body."""
        centers = [fill_positions(p)[0] for p in self.body_positions.swapaxes(0, 1)]
        places = [node.world_origin[0] for node in self.nodes]
        return float(np.linalg.norm(np.ptp([*centers, *places], axis=0)))


def fill_positions(positions: np.ndarray) -> np.ndarray:
    """Fill frames without a position (NaN) linearly between their neighbours; ends are held.

    Parameters
    ----------
    positions : (T, 3) float
        If no frame has a position, the result is zero.
    """
    good = np.isfinite(positions).all(axis=1)
    if good.all():
        return np.asarray(positions, float)
    frames = np.flatnonzero(good)
    if len(frames) == 0:
        return np.zeros(positions.shape)
    every = np.arange(len(positions))
    return np.stack([np.interp(every, frames, positions[frames, i]) for i in range(3)], axis=1)
