"""A subject's own model: its surface with skin weights, joints, and the poses it has been seen in; `model.npz`."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.errors import GeometryError, RunError
from geomocap.files.array_schema import Expected, check_arrays
from geomocap.files.npz import read_npz, write_npz
from geomocap.model.hierarchy import Hierarchy
from geomocap.reading import reason
from geomocap.skeleton.body_observations import SkinPoints
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, body_motion, posed

MODEL_FILE = "model.npz"
KIND = "geomocap subject model"
VERSION = 1
_SINGLE = {"root": int, "diagonal": float, "spacing": float, "up": int}
_BEFORE = {"skin_shares": "skin_weights", "extent": "diagonal"}  # arrays as older versions call them

SCHEMA = {
    "points": Expected("P 3", low=-1e5, high=1e5),
    "normals": Expected("P 3", "direction", gaps=True),
    "colors": Expected("C 3", "whole", low=0, high=255),
    "skin_bodies": Expected("P I", "whole", low=0, high="B"),
    "skin_weights": Expected("P I", low=0, high=1.01),
    "joint_bodies": Expected("J 2", "whole", low=0, high="B"),
    "joints": Expected("J 3", low=-1e5, high=1e5),
    "joint_axes": Expected("J 3", "direction"),
    "joint_hinge": Expected("J", "truth"),
    "joint_limits": Expected("J 2 3", low=-7, high=7),
    "joint_names": Expected("J", "text"),
    "body_names": Expected("B", "text"),
    "root": Expected("", "whole", low=0, high="B"),
    "origin": Expected("3", low=-1e5, high=1e5),
    "body_extents": Expected("B 3", low=0, high=1e5),
    "poses": Expected("K B 3 3", "rotation"),
    "diagonal": Expected("", low=1e-9, high=1e5),
    "spacing": Expected("", low=1e-9, high=1e5),
    "up": Expected("", "whole", low=0, high=2),
}


@dataclass(frozen=True)
class SubjectModel:
    """B bodies with their surface, connected by J = B - 1 joints, in a rest pose: frame 0 of its sequence.

    Attributes
    ----------
    points : (P, 3) float, metres, world
        Surface at rest.
    normals : (P, 3) float
        Outward, unit.
    colors : (P, 3) uint8 or (0, 3)
        RGB; none if the geometry had no colours.
    skin_bodies, skin_weights : (P, 4) int32, (P, 4) float
        Bodies that each point follows, the main one first, and by which weights; they sum to one.
    joints : (J, 3) float, metres, world
        At rest.
    joint_bodies : (J, 2) int32
        Parent and child; a parent's own joint comes before its children's.
    joint_axes : (J, 3) float
        Axis of each hinge at rest; the main axis of a ball.
    joint_hinge : (J,) bool
        Whether a joint turns about its axis only.
    joint_limits : (J, 2, 3) float, radians
        Least and largest components of the rotation vectors seen in any sequence, from the first of `poses` and in the
        parent's axes there, whatever the rest pose is.
    joint_names : (J,) str
    body_names : (B,) str
    root : int
        Body without a parent.
    origin : (3,) float, metres, world
        Centre of the root body at rest.
    body_extents : (B, 3) float, metres
        Size of each body along its principal axes.
    poses : (K, B, 3, 3) float
        Turns of the bodies against their parents (of the root: in world axes) in poses that differ most; the first is
        frame 0 of the first sequence.
    diagonal : float, metres
        Diagonal of the box around the subject at rest.
    spacing : float, metres
        Distance of neighbouring points.
    up : int
        World axis that points up, 0 to 2.
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    skin_bodies: np.ndarray
    skin_weights: np.ndarray
    joints: np.ndarray
    joint_bodies: np.ndarray
    joint_axes: np.ndarray
    joint_hinge: np.ndarray
    joint_limits: np.ndarray
    joint_names: np.ndarray
    body_names: np.ndarray
    root: int
    origin: np.ndarray
    body_extents: np.ndarray
    poses: np.ndarray
    diagonal: float
    spacing: float
    up: int = 2

    def __post_init__(self) -> None:
        bodies = len(self.joint_bodies) + 1
        sizes = check_arrays({name: getattr(self, name) for name in SCHEMA}, SCHEMA, B=bodies)
        if sizes["C"] not in (sizes["P"], 0):
            raise GeometryError(f"colors has the shape {self.colors.shape}, expected {sizes['P']} × 3 or none")
        if not sizes["P"] or not sizes["K"]:
            raise GeometryError("it has no surface points or no poses")
        if not self.normals.any():
            raise GeometryError("normals are all zero")
        if not np.allclose(self.skin_weights.sum(axis=1), 1, atol=0.01):
            raise GeometryError("skin_weights doesn't sum to one at every point")
        across = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        if not across / 4 <= self.diagonal <= 4 * across:
            raise GeometryError(f"diagonal is {self.diagonal:g} m, but its points are {across:g} m across")
        if not self.spacing <= across:
            raise GeometryError(f"spacing is {self.spacing:g} m, but its points are {across:g} m across")
        _ = self.linkage  # the tree is checked

    @property
    def body_count(self) -> int:
        """Number of bodies B."""
        return len(self.joints) + 1

    @property
    def linkage(self) -> Linkage:
        """The bodies and joints at rest."""
        hierarchy = Hierarchy(self.root, self.joint_bodies)
        return Linkage(hierarchy, self.joints, self.joint_axes, self.joint_hinge, self.origin)

    @property
    def skin(self) -> SkinPoints:
        """The surface with its weights."""
        return SkinPoints(self.points, self.skin_bodies, self.skin_weights)

    def reposed(self, bodies: BodyMotion, frame: int) -> SubjectModel:
        """Return the model with the pose of a frame of a motion as its rest pose."""
        rotations = bodies.rotations[frame]
        linkage, parents = posed(self.linkage, bodies, frame), self.linkage.hierarchy.parents
        before = np.where((parents >= 0)[:, None, None], rotations[parents], np.eye(3))
        poses = np.einsum("bij,kbjl,bml->kbim", before, self.poses, rotations)
        one = bodies.part(slice(frame, frame + 1))
        return replace(
            self,
            points=one.carry(self.points, self.skin_bodies, self.skin_weights)[0],
            normals=np.einsum("pij,pj->pi", rotations[self.skin.body], self.normals),
            joints=linkage.joints,
            joint_axes=linkage.axes,
            origin=linkage.origin,
            poses=poses,
        )

    def turned_up(self, up: int) -> SubjectModel:
        """Return the model in a world in which another axis points up; the axes keep their cyclic order."""
        if up == self.up:
            return self
        turn = np.roll(np.eye(3), up - self.up, axis=0)
        places = ("points", "normals", "joints", "joint_axes", "joint_limits", "origin")
        turned = {name: getattr(self, name) @ turn.T for name in places}
        return replace(self, **turned, poses=turn @ self.poses @ turn.T, up=up)

    def widened(self, bodies: BodyMotion) -> SubjectModel:
        """Return the model with limits that hold the turns of a motion, too."""
        first = body_motion(self.linkage, JointMotion(self.poses[:1], self.origin[None])).rotations[0]
        parents, children = (bodies.rotations[:, b] @ first[b].swapaxes(1, 2) for b in self.joint_bodies.T)
        low, high = rotation_limits(parents.swapaxes(2, 3) @ children).swapaxes(0, 1)
        limits = np.minimum(low, self.joint_limits[:, 0]), np.maximum(high, self.joint_limits[:, 1])
        return replace(self, joint_limits=np.stack(limits, axis=1))


def rotation_limits(rotations: np.ndarray) -> np.ndarray:
    """Least and largest components of rotation vectors, (J, 2, 3) radians, of rotations (T, J, 3, 3)."""
    vectors = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(*rotations.shape[:2], 3)
    return np.stack([vectors.min(axis=0), vectors.max(axis=0)], axis=1)


def write_model(path: Path, model: SubjectModel) -> None:
    """Write a `model.npz`, whole or not at all."""
    values = {f.name: np.asarray(getattr(model, f.name)) for f in fields(model)}
    write_npz(path, {"kind": np.array(KIND), "version": np.array(VERSION), **values})


def read_model(path: str | Path) -> SubjectModel:
    """Read a `model.npz`, never executing anything in it.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    GeometryError
        If the file is missing, damaged, no model, or inconsistent.
    """
    path = Path(path)
    if not path.is_file():
        raise GeometryError(f"{path}: no such model; a run by motion writes its subject's as model.npz")
    try:
        arrays = read_npz(path)
    except RunError as error:
        why = str(error).removeprefix(f"{path}: ").partition(";")[0]
        raise GeometryError(f"{path}: can't be read as a model ({why}); expected a run's model.npz") from None
    if str(arrays.get("kind", "")) != KIND:
        raise GeometryError(f"{path}: no subject model; expected a run's model.npz")
    if str(arrays.get("version", "")) != str(VERSION):
        raise GeometryError(f"{path}: model of version {arrays.get('version')}, expected {VERSION}; make it anew")
    arrays |= {now: arrays[before] for before, now in _BEFORE.items() if before in arrays}
    names = list(SubjectModel.__dataclass_fields__)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise GeometryError(f"{path}: model without the array {missing[0]}; make it anew")
    values: dict[str, Any] = {name: arrays[name] for name in names}
    try:
        check_arrays(
            values, {name: SCHEMA[name] for name in _SINGLE} | {"joint_bodies": Expected("J 2", "whole")}, B=1 << 30
        )
        values |= {name: kind(values[name]) for name, kind in _SINGLE.items()}
        return SubjectModel(**values)
    except (GeometryError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise GeometryError(f"{path}: model can't be used: {reason(error)}; make it anew") from None
