"""A motion as all hierarchical formats hold it: a tree of nodes with rest offsets, turning over time.

Every body is one node. Its origin is the joint to its parent body, its axes are the world's in the first frame. Where
joints are fixed in their bodies, constant offsets reproduce them exactly; where they move (the joints that were found
frame by frame), the node gets a translation of its own in every frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomocap.export.conventions import Axis, Convention
from geomocap.export.export_errors import MotionError
from geomocap.model.hierarchy import Hierarchy


@dataclass(frozen=True)
class MotionTree:
    """A tree of nodes in motion.

    Attributes
    ----------
    names : tuple of str
        Of the N nodes, parents before children; node 0 is the only root.
    parents : (N,) int
        Parent node, -1 for the root.
    offsets : (N, 3) float, metres
        Origin in the parent's axes at rest; for the root its position in the first frame.
    rotations : (T, N, 3, 3) float
        Parent from node.
    translations : (T, N, 3) float, metres
        Origin in the parent's axes; equal to `offsets` in every frame where the node isn't `moving`.
    moving : (N,) bool
        Nodes whose translation changes, the root among them.
    tips : (N, 3) float, metres
        End of nodes without children, in their own axes; NaN for the others.
    bodies, joints : (N,) int
        The body that a node is, and the joint that lies at its origin; -1 for none.
    fps : float
    up : "x", "y" or "z"
        World axis that points up.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    moving: np.ndarray
    tips: np.ndarray
    bodies: np.ndarray
    joints: np.ndarray
    fps: float
    up: Axis = "z"

    def __post_init__(self) -> None:
        t, n = self.rotations.shape[:2]
        if not (self.translations.shape == (t, n, 3) and self.offsets.shape == (n, 3) and len(self.names) == n):
            raise MotionError(
                f"motion: {len(self.names)} names, offsets {self.offsets.shape}, rotations {self.rotations.shape} and "
                f"translations {self.translations.shape} don't fit together"
            )
        if n == 0 or t == 0:
            raise MotionError("motion: holds no nodes or no frames")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise MotionError(f"motion: {self.fps} frames per second; expected a positive number")
        if self.parents[0] != -1 or (self.parents[1:] >= np.arange(1, n)).any() or (self.parents[1:] < 0).any():
            raise MotionError("motion: parents must stand before children, with one root in front")
        if len(set(self.names)) < n:
            twice = next(x for x in self.names if self.names.count(x) > 1)
            raise MotionError(f"motion: two nodes are called {twice}; give each its own name")
        if not (np.isfinite(self.rotations).all() and np.isfinite(self.translations).all()):
            raise MotionError("motion: rotations or translations hold NaN; fill gaps first")

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.rotations)

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.names)

    def children(self, node: int) -> list[int]:
        """Nodes whose parent is `node`."""
        return np.flatnonzero(self.parents == node).tolist()

    def forward_kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        """World rotations (T, N, 3, 3) and origins (T, N, 3), metres, of all nodes."""
        tree = Hierarchy(0, np.column_stack([self.parents[1:], np.arange(1, self.n_nodes)]))
        return tree.forward_kinematics(self.rotations, self.translations)

    def bind_pose(self, frame: int | None) -> tuple[np.ndarray, np.ndarray]:
        """World rotations (N, 3, 3) and origins (N, 3), metres, in a frame; None: at rest, where no node is turned."""
        if frame is not None:
            R, p = self.forward_kinematics()
            return R[frame], p[frame]
        still = replace(
            self,
            rotations=np.tile(np.eye(3), (1, self.n_nodes, 1, 1)),
            translations=self.offsets[None].copy(),
        )
        R, p = still.forward_kinematics()
        return R[0], p[0]

    def converted(self, convention: Convention) -> MotionTree:
        """Return the same motion in a file's axes and unit (lengths are no longer metres unless its unit is)."""
        return replace(
            self,
            offsets=convention.points(self.offsets, self.up),
            translations=convention.points(self.translations, self.up),
            rotations=convention.rotations(self.rotations, self.up),
            tips=convention.points(self.tips, self.up),
            up=convention.up,
        )

    def joint_positions(self, n_joints: int) -> np.ndarray:
        """Positions (T, n_joints, 3) of the joints that the nodes carry, metres, world; NaN for others."""
        _, p = self.forward_kinematics()
        positions = np.full((self.n_frames, n_joints, 3), np.nan)
        carried = self.joints >= 0
        positions[:, self.joints[carried]] = p[:, carried]
        return positions

    def largest_deviation_mm(self, joint_positions: np.ndarray) -> float:
        """Largest distance of the nodes from measured joint positions (T, J, 3) metres, in mm; gaps don't count."""
        distance = np.linalg.norm(self.joint_positions(joint_positions.shape[1]) - joint_positions, axis=-1)
        distance = distance[np.isfinite(distance)]
        return float(distance.max() * 1000) if len(distance) else 0.0
