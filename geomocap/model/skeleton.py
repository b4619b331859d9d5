"""The skeleton of a sequence: bodies, joints, and their motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.hierarchy import Hierarchy
from geomocap.model.rotations import relative_turns, rotation_vectors


@dataclass(frozen=True)
class Skeleton:
    """A tree of B rigid bodies with a joint between each body and its parent, J = B - 1, over T frames.

    There are two versions of the joints. Those *found* in each frame keep to the geometry but slide along the bones.
    The *bone-fixed* ones are the forward kinematics of `offsets`, `local_rotations` and `root_positions`; that is what
    BVH and glTF can hold. `joint_positions` are the bone-fixed ones if `fixed_joints`, and files agree exactly then.

    Attributes
    ----------
    joint_positions : (T, J, 3) float, metres, world
        NaN where a joint has no place.
    joint_bodies : (J, 2) int32
        Parent and child body; a parent's own joint comes before its children's.
    joint_names : (J,) str
        As `joint_body01_body03`, parent first.
    body_names : (B,) str
        As `body03`.
    body_rotations : (T, B, 3, 3) float
        Rotation since frame 0, world axes; the identity in frame 0.
    body_positions : (T, B, 3) float, metres, world
        Centres of the bodies.
    root : int
        Body without a parent.
    offsets : (J, 3) float, metres
        From the parent body's own joint (for the root: its position) to the joint, in the parent's frame. All frames
        have world axes in frame 0.
    body_offsets : (B, 3) float, metres
        From a body's own joint (for the root: its position) to its centre, in the body's frame; twice that is where the
        bone of a body without children ends.
    fixed_joints : bool
    fps : float
    """

    joint_positions: np.ndarray
    joint_bodies: np.ndarray
    joint_names: np.ndarray
    body_names: np.ndarray
    body_rotations: np.ndarray
    body_positions: np.ndarray
    root: int
    offsets: np.ndarray
    body_offsets: np.ndarray
    fixed_joints: bool
    fps: float

    def __post_init__(self) -> None:
        if self.body_rotations.ndim != 4 or 0 in self.body_rotations.shape:
            raise GeometryError(f"body_rotations has shape {self.body_rotations.shape}; there is no motion in it")
        frames, bodies = self.body_rotations.shape[:2]
        joints = bodies - 1
        expected = {
            "joint_bodies": (joints, 2),
            "joint_positions": (frames, joints, 3),
            "joint_names": (joints,),
            "body_names": (bodies,),
            "body_rotations": (frames, bodies, 3, 3),
            "body_positions": (frames, bodies, 3),
            "offsets": (joints, 3),
            "body_offsets": (bodies, 3),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise GeometryError(f"skeleton: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise GeometryError(f"skeleton: {self.fps} frames per second, expected a positive number")
        _ = self.hierarchy  # the tree is checked

    @cached_property
    def hierarchy(self) -> Hierarchy:
        """The tree of bodies."""
        return Hierarchy(self.root, self.joint_bodies)

    @property
    def frame_count(self) -> int:
        """Number of frames T."""
        return self.body_rotations.shape[0]

    @property
    def body_count(self) -> int:
        """Number of bodies B."""
        return self.body_rotations.shape[1]

    @property
    def joint_count(self) -> int:
        """Number of joints J."""
        return len(self.joint_bodies)

    @property
    def root_positions(self) -> np.ndarray:
        """Origin of the root body's frame, its centre: (T, 3) float, metres, world."""
        return self.body_positions[:, self.root]

    @property
    def local_rotations(self) -> np.ndarray:
        """Rotation relative to the parent, parent from child, (T, B, 3, 3); of the root, world from root."""
        return self.hierarchy.local_rotations(self.body_rotations)

    @cached_property
    def bones(self) -> list[tuple[int, int, int]]:
        """Pairs of joints on one body: (body, joint to its parent or -1 for the body's own place, joint to a child)."""
        own = self.hierarchy.body_joints
        return [(int(parent), int(own[parent]), j) for j, (parent, _) in enumerate(self.joint_bodies.tolist())]

    @cached_property
    def leaves(self) -> list[int]:
        """Bodies without children."""
        return sorted(set(range(self.body_count)) - set(self.joint_bodies[:, 0].tolist()))

    def place(self, frame: int, body: int, joint: int) -> np.ndarray:
        """Return a joint's position in a frame, or the body's where `joint` is -1: (3,) metres."""
        return self.body_positions[frame, body] if joint < 0 else self.joint_positions[frame, joint]

    def joint_rotations(self) -> np.ndarray:
        """Return each joint's rotation since frame 0 as rotation vectors (T, J, 3), radians, parent's axes.

        Of the vectors that mean the same rotation, that nearest to the frame before is taken: no jumps at half a turn.
        """
        parents, children = (self.body_rotations[:, b] for b in self.joint_bodies.T)
        relative = relative_turns(parents, children)
        return rotation_vectors(np.einsum("tjab,tjcb->tjac", relative, np.broadcast_to(relative[:1], relative.shape)))


def bone_fixed_skeleton(
    hierarchy: Hierarchy,
    joints: np.ndarray,
    rotations: np.ndarray,
    joint_positions: np.ndarray,
    centers: np.ndarray,
    middle: np.ndarray,
    fps: float,
) -> Skeleton:
    """Skeleton of a motion whose joints are fixed in both bodies.

    Parameters
    ----------
    hierarchy : Hierarchy
    joints : (J, 3) float, metres, world
        In frame 0.
    rotations : (T, B, 3, 3) float
        Since frame 0, world axes.
    joint_positions : (T, J, 3) float, metres, world
    centers : (T, B, 3) float, metres, world
        Of the bodies.
    middle : (B, 3) float, metres, world
        Of the bodies in frame 0.
    fps : float
    """
    own = hierarchy.body_joints
    anchors = np.where((own >= 0)[:, None], joints[own] if len(joints) else middle, middle)
    names = body_names(len(middle))
    return Skeleton(
        joint_positions,
        hierarchy.joint_bodies,
        joint_names(hierarchy.joint_bodies, names),
        names,
        rotations,
        centers,
        hierarchy.root,
        joints - anchors[hierarchy.joint_bodies[:, 0]],
        middle - anchors,
        True,
        float(fps),
    )


def body_names(count: int) -> np.ndarray:
    """Names of bodies by number, (B,) str: `body00` …"""
    return np.array([f"body{b:02d}" for b in range(count)], dtype=np.str_)


def joint_names(joint_bodies: np.ndarray, names: Sequence[str] | np.ndarray) -> np.ndarray:
    """Names of joints after the bodies that they join, (J,) str: `joint_body01_body03` …"""
    return np.array([f"joint_{names[p]}_{names[c]}" for p, c in joint_bodies], dtype=np.str_)
