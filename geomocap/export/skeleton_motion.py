"""From the arrays of `skeleton.npz` to a motion that files can hold.

Every body becomes a node at the joint to its parent body. Where joints are fixed in their bodies, constant offsets
reproduce them exactly; where they move (joints that were found frame by frame), the node gets a translation of its own
in every frame, so that the joints of `skeleton.npz` are always met.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from geomocap.export.body_tree import BodyTree, body_tree
from geomocap.export.conventions import Axis
from geomocap.export.export_errors import MotionError
from geomocap.export.motion_tree import MotionTree
from geomocap.export.names import Names
from geomocap.model.rotations import fill_rotations

JointMode = Literal["auto", "fixed", "moving"]
FIXED_WITHIN = 1e-5  # m: a joint that stays this near its mean place in the parent body is fixed; ten add up to 0.1 mm
SHORTEST_TIP, END_BONE = 0.0005, 0.03  # fractions of the skeleton's diagonal: shorter tips are replaced by end bones
UNKNOWN_RADIUS = 0.05  # m
ORIGIN = "origin"


def motion_from_skeleton(
    arrays: Mapping[str, np.ndarray],
    *,
    up: Axis = "z",
    names: Names | None = None,
    joints: JointMode = "auto",
    source: str = "skeleton.npz",
    radius: float = UNKNOWN_RADIUS,
) -> MotionTree:
    """Make a motion of the arrays of `skeleton.npz`.

    Gaps (NaN) are filled: rotations and positions between their neighbours in time, fixed joints by their offset.

    Parameters
    ----------
    arrays : mapping
        joint_positions (T, J, 3) m · joint_bodies (J, 2) · body_rotations (T, B, 3, 3) since frame 0, world axes ·
        body_positions (T, B, 3) m · fps · optional: joint_names (J,), body_names (B,), root.
    up : "x", "y" or "z"
        World axis that points up.
    names : Names, optional
        The user's names.
    joints : "auto", "fixed" or "moving"
        fixed: constant offsets, the mean of where a joint lies in its parent body. moving: every node gets its
        translation in every frame. auto: only those nodes get it that no constant offset reproduces within 0.01 mm.
    source : str
        Name of the file, for messages.
    radius : float, metres
        Size of a single body, which a skeleton without joints can't tell; its bone is as long.

    Raises
    ------
    MotionError
        If arrays are missing, of other shapes, empty, or joints name bodies that aren't there.
    """
    skeleton = _checked(arrays, source)
    joint_bodies = skeleton["joint_bodies"].astype(int)
    n_bodies = skeleton["body_rotations"].shape[1]
    root = int(arrays["root"]) if "root" in arrays and np.ndim(arrays["root"]) == 0 else None
    names = names or Names()
    body_names = names.body_names(n_bodies, _texts(arrays.get("body_names")))
    joint_names = names.joint_names(joint_bodies, body_names, _texts(arrays.get("joint_names")))
    try:
        tree = body_tree(joint_bodies, n_bodies, root)
    except MotionError as error:
        raise MotionError(f"{source}: {error}") from None

    rotations = np.stack([fill_rotations(r) for r in skeleton["body_rotations"].swapaxes(0, 1)], axis=1)
    chain = _Chain(tree, rotations, skeleton["joint_positions"], skeleton["body_positions"], joints, up, radius)
    if len(tree.roots) > 1:
        chain.add_origin()
    for body in tree.order.tolist():
        if tree.parent[body] < 0:
            chain.add_root(body_names[body], body)
        else:
            chain.add_joint(body_names[body], int(tree.parent[body]), body, int(tree.joint[body]))
    for joint, body in tree.extra:
        chain.add_joint(joint_names[joint], body, -1, joint)
    return chain.motion(float(skeleton["fps"]))


def _texts(array: np.ndarray | None) -> list[str] | None:
    return None if array is None else [str(x) for x in np.asarray(array)]


def _checked(arrays: Mapping[str, np.ndarray], source: str) -> dict[str, np.ndarray]:
    """Return the arrays as floats, after checking that they are there and fit together."""
    needed = ("joint_positions", "joint_bodies", "body_rotations", "body_positions", "fps")
    missing = [k for k in needed if k not in arrays]
    if missing:
        raise MotionError(f"{source}: has no array {', '.join(missing)}; it is no skeleton")
    values = {k: np.asarray(arrays[k], float) for k in needed}
    if values["body_rotations"].ndim != 4 or 0 in values["body_rotations"].shape:
        raise MotionError(
            f"{source}: body_rotations has shape {values['body_rotations'].shape}; there is no motion in it"
        )
    t, b = values["body_rotations"].shape[:2]
    if values["joint_bodies"].size == 0:
        values["joint_bodies"], values["joint_positions"] = np.zeros((0, 2)), np.zeros((t, 0, 3))
    j = len(values["joint_bodies"])
    expected: dict[str, tuple[int, ...]] = {
        "joint_bodies": (j, 2),
        "joint_positions": (t, j, 3),
        "body_rotations": (t, b, 3, 3),
        "body_positions": (t, b, 3),
        "fps": (),
    }
    for key, shape in expected.items():
        if values[key].shape != shape:
            raise MotionError(f"{source}: {key} has shape {values[key].shape}, expected {shape}")
    return values


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

    tree: BodyTree
    rotations: np.ndarray
    joint_positions: np.ndarray
    body_positions: np.ndarray
    mode: JointMode
    up: Axis
    radius: float
    nodes: list[_Node] = field(default_factory=list)
    node_of_body: dict[int, int] = field(default_factory=dict)

    def add_origin(self) -> None:
        """Add a node at the world's origin, on which several roots hang."""
        T = len(self.rotations)
        still, none = np.tile(np.eye(3), (T, 1, 1)), np.zeros((T, 3))
        self.nodes.append(_Node(ORIGIN, -1, -1, -1, False, none, still, none, still))

    def add_root(self, name: str, body: int) -> None:
        """Add a body without a parent; it has a translation in every frame."""
        parent = 0 if self.nodes else -1
        if self.nodes and self.nodes[0].name != ORIGIN:
            raise MotionError(f"{name}: a second root needs an origin to hang on")
        origin, R = self._root_origin(body), self.rotations[:, body]
        self.node_of_body[body] = len(self.nodes)
        self.nodes.append(_Node(name, parent, body, -1, True, origin, R, origin, R))

    def _root_origin(self, body: int) -> np.ndarray:
        """Origin (T, 3) of a root: its centre, corrected so that its joints are fixed in it if that can be had.

        A body's centre may wander in the body where its joints don't. With d the mean places of the joints relative to
        the centre, the mean over the joints of p_j(t) - R(t) d_j moves rigidly with them.
        """
        R, centre = self.rotations[:, body], fill_positions(self.body_positions[:, body])
        joints = self.tree.joint[np.flatnonzero(self.tree.parent == body)]
        p = self.joint_positions[:, joints]
        if self.mode == "moving" or not len(joints) or not np.isfinite(p).all():
            return centre
        d = np.einsum("tji,tkj->tki", R, p - centre[:, None]).mean(axis=0)
        return (p - np.einsum("tij,kj->tki", R, d)).mean(axis=1)

    def add_joint(self, name: str, parent_body: int, body: int, joint: int) -> None:
        """Add a node at a joint, fixed in the parent body if a constant offset reproduces it.

        With `body` -1 it is a joint that closes a loop; it turns with its parent body.
        """
        parent = self.nodes[self.node_of_body[parent_body]]
        R_parent, origin = parent.world_rotation, parent.world_origin
        local = np.einsum("tji,tj->ti", R_parent, self.joint_positions[:, joint] - origin)
        good = np.isfinite(local).all(axis=1)
        offset = local[good].mean(axis=0) if good.any() else np.zeros(3)
        spread = np.linalg.norm(local[good] - offset, axis=1).max(initial=0.0)
        moving = bool(self.mode == "moving" or (self.mode == "auto" and spread > FIXED_WITHIN))
        local = fill_positions(local) if moving else np.tile(offset, (len(local), 1))
        R = self.rotations[:, body] if body >= 0 else R_parent
        turn = np.einsum("tji,tjk->tik", R_parent, R)
        world = origin + np.einsum("tij,tj->ti", R_parent, local)
        index = self.node_of_body[parent_body]
        if body >= 0:
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
            tips[i] = 0.0
            if node.body >= 0:
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
        places = [node.world_origin[0] for node in self.nodes if node.body >= 0 or node.joint >= 0]
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
