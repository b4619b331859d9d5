"""A tree of bodies from the list of joints, whatever the order in which it names them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.export.export_errors import MotionError


@dataclass(frozen=True)
class BodyTree:
    """Bodies as a forest: each has one parent or is a root.

    Attributes
    ----------
    order : (B,) int
        Bodies, parents before children.
    parent : (B,) int
        Parent body of each body, -1 for roots.
    joint : (B,) int
        The joint between a body and its parent, -1 for roots.
    extra : tuple of (joint, body)
        Joints that close a loop: they hang on that body and carry nothing.
    """

    order: np.ndarray
    parent: np.ndarray
    joint: np.ndarray
    extra: tuple[tuple[int, int], ...]

    @property
    def roots(self) -> np.ndarray:
        """Bodies without a parent."""
        return np.flatnonzero(self.parent < 0)


def body_tree(joint_bodies: np.ndarray, n_bodies: int, root: int | None = None) -> BodyTree:
    """Build the tree of bodies.

    Where the joints' (parent, child) order already makes a forest it is kept; otherwise the tree is grown breadth first
    from `root`, or from the body with the most joints of each connected part.

    Parameters
    ----------
    joint_bodies : (J, 2) int
    n_bodies : int
    root : int, optional
        Body to start from where the order has to be made.

    Raises
    ------
    MotionError
        If a joint names a body that isn't there, or joins a body with itself.
    """
    joints = np.asarray(joint_bodies, int).reshape(-1, 2)
    for j, (a, b) in enumerate(joints.tolist()):
        if not (0 <= a < n_bodies and 0 <= b < n_bodies):
            raise MotionError(
                f"joint {j} joins bodies {a} and {b}, but there are {n_bodies} bodies (0 to {n_bodies - 1})"
            )
        if a == b:
            raise MotionError(f"joint {j} joins body {a} with itself")
    return _as_given(joints, n_bodies) or _breadth_first(joints, n_bodies, root)


def _as_given(joints: np.ndarray, n: int) -> BodyTree | None:
    """Keep the given order if every body is a child once at most and there is no loop."""
    parent, joint = np.full(n, -1), np.full(n, -1)
    for j, (a, b) in enumerate(joints.tolist()):
        if parent[b] >= 0:
            return None
        parent[b], joint[b] = a, j
    order = _parents_first(parent)
    return None if order is None else BodyTree(order, parent, joint, ())


def _parents_first(parent: np.ndarray) -> np.ndarray | None:
    """Order of bodies with parents before children, depth first; None if there is a loop."""
    children: dict[int, list[int]] = {}
    for b, p in enumerate(parent.tolist()):
        children.setdefault(p, []).append(b)
    order: list[int] = []
    stack = children.get(-1, [])[::-1]
    while stack:
        body = stack.pop()
        order.append(body)
        stack.extend(reversed(children.get(body, [])))
    return np.array(order, int) if len(order) == len(parent) else None


def _breadth_first(joints: np.ndarray, n: int, root: int | None) -> BodyTree:
    degree = np.bincount(joints.ravel(), minlength=n)
    starts = sorted(range(n), key=lambda b: (b != root, -degree[b], b))
    parent, joint = np.full(n, -1), np.full(n, -1)
    seen = np.zeros(n, bool)
    used = np.zeros(len(joints), bool)
    for start in starts:
        if seen[start]:
            continue
        seen[start] = True
        queue = [start]
        while queue:
            body = queue.pop(0)
            for j, (a, b) in enumerate(joints.tolist()):
                if used[j] or body not in (a, b):
                    continue
                other = b if body == a else a
                if not seen[other]:
                    seen[other] = used[j] = True
                    parent[other], joint[other] = body, j
                    queue.append(other)
    order = _parents_first(parent)
    assert order is not None  # breadth first makes no loops
    extra = tuple((int(j), int(joints[j, 0])) for j in np.flatnonzero(~used))
    return BodyTree(order, parent, joint, extra)
