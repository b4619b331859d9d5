"""The skeleton of a sequence: bodies, joints, and their motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from geomocap.errors import GeometryError
from geomocap.model.hierarchy import Hierarchy
from geomocap.segmentation.axis_joints import grow_joints
from geomocap.segmentation.body_connections import connect_bodies
from geomocap.segmentation.m3_result import Segmentation
from geomocap.segmentation.skeleton_settings import SkeletonSettings
from geomocap.skeleton.bone_motion import fit_motion, forward_kinematics, local_rotations


@dataclass(frozen=True)
class Skeleton:
    """A tree of B rigid bodies with a joint between each body and its parent, J = B - 1, over T frames.

    There are two versions of the joints. Those *found* in each frame keep to the geometry but slide along the bones.
    The *bone-fixed* ones are the forward kinematics of `offsets`, `local_rotations` and `root_positions`; that is what
    BVH and glTF can hold. `joint_positions` are the bone-fixed ones if `fixed_joints`, and files agree exactly then.

    Attributes
    ----------
    joint_positions : (T, J, 3) float, metres, world
    joint_bodies : (J, 2) int32
        Parent and child body; a parent's own joint comes before its children's.
    joint_names : (J,) str
        As `joint_body01_body03`, parent first.
    body_names : (B,) str
        As `body03`.
    body_rotations : (T, B, 3, 3) float
        Rotation since frame 0, world axes; the identity in frame 0.
    body_positions : (T, B, 3) float, metres, world
        Centres of the bodies' ellipsoids.
    root : int
        Body without a parent.
    root_positions : (T, 3) float, metres, world
        Origin of the root body's frame: its centre.
    offsets : (J, 3) float, metres
        From the parent body's own joint (for the root: its position) to the joint, in the parent's frame. All frames
        have world axes in frame 0.
    body_offsets : (B, 3) float, metres
        From a body's own joint (for the root: its position) to its centre, in the body's frame; twice that is where the
        bone of a body without children ends.
    local_rotations : (T, B, 3, 3) float
        Rotation relative to the parent, parent from child; of the root, world from root.
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
    root_positions: np.ndarray
    offsets: np.ndarray
    body_offsets: np.ndarray
    local_rotations: np.ndarray
    fixed_joints: bool
    fps: float

    def __post_init__(self) -> None:
        frames, joints = self.joint_positions.shape[:2]
        bodies = joints + 1
        expected = {
            "joint_bodies": (joints, 2),
            "joint_names": (joints,),
            "body_names": (bodies,),
            "body_rotations": (frames, bodies, 3, 3),
            "body_positions": (frames, bodies, 3),
            "root_positions": (frames, 3),
            "offsets": (joints, 3),
            "body_offsets": (bodies, 3),
            "local_rotations": (frames, bodies, 3, 3),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise GeometryError(f"skeleton: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise GeometryError(f"skeleton: {self.fps} frames per second, expected a positive number")

    @property
    def hierarchy(self) -> Hierarchy:
        """The tree of bodies."""
        return Hierarchy(self.root, self.joint_bodies)

    @property
    def parents(self) -> np.ndarray:
        """Parent of each body, (B,) int32; -1 for the root."""
        return self.hierarchy.parents

    @property
    def body_joints(self) -> np.ndarray:
        """Joint that connects each body to its parent, (B,) int32; -1 for the root."""
        return self.hierarchy.body_joints

    def bone_fixed_positions(self) -> np.ndarray:
        """Joint positions of the forward kinematics, (T, J, 3), metres, world: those of BVH and glTF."""
        return forward_kinematics(self.hierarchy, self.offsets, self.local_rotations, self.root_positions)[0]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of `skeleton.npz`."""
        return {
            "joint_positions": self.joint_positions,
            "joint_bodies": self.joint_bodies,
            "joint_names": self.joint_names,
            "body_names": self.body_names,
            "body_rotations": self.body_rotations,
            "body_positions": self.body_positions,
            "root": np.array(self.root),
            "root_positions": self.root_positions,
            "offsets": self.offsets,
            "body_offsets": self.body_offsets,
            "local_rotations": self.local_rotations,
            "fixed_joints": np.array(self.fixed_joints),
            "fps": np.array(self.fps),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Skeleton:
        """Take over the arrays of `skeleton.npz`.

        Raises
        ------
        GeometryError
            If an array is missing or has another shape.
        """
        names = cls.__dataclass_fields__
        missing = [name for name in names if name not in arrays]
        if missing:
            raise GeometryError(f"skeleton.npz: no array '{missing[0]}'; run the skeleton stage again")
        values: dict[str, Any] = {name: np.asarray(arrays[name]) for name in names}
        for name, kind in (("root", int), ("fixed_joints", bool), ("fps", float)):
            values[name] = kind(values[name])
        return cls(**values)


def skeleton_m3(segmentation: Segmentation, fps: float, settings: SkeletonSettings | None = None) -> Skeleton:
    """Find the joints between the bodies, and the motion (section 8).

    Parameters
    ----------
    segmentation : Segmentation
    fps : float
        Frames per second.
    settings : SkeletonSettings, optional

    Raises
    ------
    GeometryError
        If the segmentation has no bodies, as that of a single scan.
    """
    settings = settings or SkeletonSettings()
    bodies = segmentation.bodies
    # Which adjacent bodies are connected
    hierarchy = connect_bodies(segmentation.contacts, segmentation.touching, bodies.centers, settings.min_touching)
    # Joints, frame by frame
    step = settings.sample_step * segmentation.spacing
    found, _ = grow_joints(bodies.centers, bodies.radii, bodies.rotations, hierarchy.joint_bodies, step)
    # Motion
    root_positions = bodies.centers[:, hierarchy.root]
    turned, offsets, body_offsets = fit_motion(
        hierarchy, segmentation.body_rotations, root_positions, found, bodies.centers
    )
    relative = local_rotations(turned, hierarchy)
    fixed = forward_kinematics(hierarchy, offsets, relative, root_positions)[0]
    names = np.array([f"body{b:02d}" for b in range(bodies.counts.shape[1])])
    joint_names = np.array([f"joint_{names[p]}_{names[c]}" for p, c in hierarchy.joint_bodies], dtype=np.str_)
    return Skeleton(
        fixed if settings.fixed_joints else found,
        hierarchy.joint_bodies,
        joint_names,
        names,
        turned,
        bodies.centers,
        hierarchy.root,
        root_positions,
        offsets,
        body_offsets,
        relative,
        settings.fixed_joints,
        float(fps),
    )
