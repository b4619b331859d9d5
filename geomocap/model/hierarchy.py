"""Which bodies are connected: a tree, and how its parts carry each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.errors import GeometryError


@dataclass(frozen=True)
class Hierarchy:
    """A tree of bodies; every joint connects a child body to its parent.

    Attributes
    ----------
    root : int
        Body without a parent.
    joint_bodies : (B - 1, 2) int32
        Parent and child body of each joint; a parent's own joint comes before its children's.
    """

    root: int
    joint_bodies: np.ndarray

    def __post_init__(self) -> None:
        wrong = _out_of_order(self.root, self.joint_bodies)
        if wrong is not None:
            raise GeometryError(f"hierarchy: joint {wrong[0]}-{wrong[1]} makes no tree with parents before children")

    @property
    def body_joints(self) -> np.ndarray:
        """Joint that connects each body to its parent, (B,) int32; -1 for the root."""
        joints = np.full(len(self.joint_bodies) + 1, -1, np.int32)
        joints[self.joint_bodies[:, 1]] = np.arange(len(self.joint_bodies))
        return joints

    @property
    def parents(self) -> np.ndarray:
        """Parent of each body, (B,) int32; -1 for the root."""
        parents = np.full(len(self.joint_bodies) + 1, -1, np.int32)
        parents[self.joint_bodies[:, 1]] = self.joint_bodies[:, 0]
        return parents

    @property
    def order(self) -> list[int]:
        """Bodies, parents before children, depth first."""
        children: dict[int, list[int]] = {}
        for parent, child in sorted(self.joint_bodies.tolist(), key=lambda joint: joint[1]):
            children.setdefault(parent, []).append(child)
        order, stack = [], [self.root]
        while stack:
            order.append(stack.pop())
            stack.extend(reversed(children.get(order[-1], [])))
        return order

    def grown_from(self, root: int) -> tuple[Hierarchy, np.ndarray]:
        """Return the same tree with another body as root, and the number that each of its joints has here, (J,) int."""
        pairs: list[tuple[int, int]] = []
        numbers: list[int] = []
        reached = [root]
        for body in reached:
            for j, (a, b) in enumerate(self.joint_bodies.tolist()):
                if body in (a, b) and a + b - body not in reached:
                    reached.append(a + b - body)
                    pairs.append((body, a + b - body))
                    numbers.append(j)
        return Hierarchy(root, np.array(pairs, np.int32).reshape(-1, 2)), np.array(numbers, int)

    def local_rotations(self, rotations: np.ndarray) -> np.ndarray:
        """Rotation of each body relative to its parent's frame; the root's relative to the world.

        Parameters
        ----------
        rotations : (T, B, 3, 3) float
            Since frame 0, world axes.

        Returns
        -------
        (T, B, 3, 3) float
            parent from child; the identity in frame 0.
        """
        result = rotations.copy()
        for parent, child in self.joint_bodies:
            result[:, child] = np.einsum("tji,tjk->tik", rotations[:, parent], rotations[:, child])
        return result

    def forward_kinematics(self, rotations: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations and origins of all bodies in the world.

        Parameters
        ----------
        rotations : (T, B, 3, 3) float
            Parent from child; of the root, world from root.
        offsets : (B, 3) or (T, B, 3) float, metres
            Origin of each body in its parent's axes, from the parent's origin; of the root, in the world.

        Returns
        -------
        rotations : (T, B, 3, 3) float
            World from body.
        origins : (T, B, 3) float, metres, world
        """
        world = rotations.copy()
        origins = np.broadcast_to(offsets, rotations.shape[:3]).copy()
        for parent, child in self.joint_bodies:
            world[:, child] = world[:, parent] @ rotations[:, child]
            origins[:, child] = origins[:, parent] + (world[:, parent] @ origins[:, child, :, None])[..., 0]
        return world, origins


def parents_first(joint_bodies: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    """Root of a tree of bodies, and the order of its joints in which parents come before children.

    Parameters
    ----------
    joint_bodies : (J, 2) int
        Parent and child body, in any order of joints.
    count : int
        Number of bodies B.

    Returns
    -------
    root : int
    order : (J,) int

    Raises
    ------
    GeometryError
        If a joint names a body that isn't there, or the joints make no tree of all bodies.
    """
    pairs = np.asarray(joint_bodies, int).reshape(-1, 2)
    for j, (a, b) in enumerate(pairs.tolist()):
        if not (0 <= a < count and 0 <= b < count):
            raise GeometryError(f"joint {j} joins bodies {a} and {b}, but there are {count} bodies (0 to {count - 1})")
        if a == b:
            raise GeometryError(f"joint {j} joins body {a} with itself")
    roots = np.setdiff1d(np.arange(count), pairs[:, 1])
    placed, order = roots[:1].tolist(), list[int]()
    for body in placed:
        own = [j for j in np.flatnonzero(pairs[:, 0] == body).tolist() if pairs[j, 1] not in placed]
        order += own
        placed += pairs[own, 1].tolist()
    if len(pairs) != count - 1 or sorted(placed) != list(range(count)):
        raise GeometryError(
            f"{len(pairs)} joints between {count} bodies make no tree: each body but one hangs on one parent"
        )
    as_given = _out_of_order(int(roots[0]), pairs) is None
    return int(roots[0]), np.arange(len(pairs)) if as_given else np.array(order, int)


def _out_of_order(root: int, joint_bodies: np.ndarray) -> tuple[int, int] | None:
    """First joint whose parent has no place yet, or whose child has one; None: there is none."""
    placed = {root}
    for parent, child in joint_bodies.tolist():
        if parent not in placed or child in placed:
            return parent, child
        placed.add(child)
    return None
