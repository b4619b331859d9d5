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
        placed = {self.root}
        for parent, child in self.joint_bodies.tolist():
            if parent not in placed or child in placed:
                raise GeometryError(f"hierarchy: joint {parent}-{child} makes no tree with parents before children")
            placed.add(child)

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
