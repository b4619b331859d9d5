"""An animated subject: a textured mesh that moves with its joints, whatever file or code it came from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from geomocap.errors import GeomocapError
from geomocap.model.rotations import nearest_rotation

WORLD_FROM_GLTF = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""Turns glTF's axes (Y up, Z towards the viewer) into ours (Z up), (4, 4)."""

_WANDER_PERIODS = (17.0, 10.5 * 5**0.5)  # seconds, along x and y; their ratio is irrational


class AssetError(GeomocapError):
    """A file of a subject that can't be read or animated."""


@dataclass(frozen=True)
class Pose:
    """Where the joints of an asset are at one time.

    Attributes
    ----------
    asset_from_joint : (J, 4, 4) float
        Transforms of the joints in the asset's own axes and unit; they may scale.
    morph_weights : (M,) float
        How much of each morph target is added.
    """

    asset_from_joint: np.ndarray
    morph_weights: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class AnimatedAsset:
    """A mesh skinned to moving joints.

    A *slot* is a joint together with the inverse bind matrix that a skin gives it: two skins may use one joint.

    Attributes
    ----------
    name : str
    bind_vertices : (V, 3) float
        Vertices before skinning, asset's unit.
    faces : (F, 3) int
    normals_group : (V,) int
        Vertices with the same number share one smooth normal (seams of the texture are not edges of the surface).
    uv : (V, 2) float
        Texture coordinates, (0, 0) the top-left corner of the texture.
    vertex_colors : (V, 3) float
        Factors on the texture's colour.
    face_textures : (F,) int
        Index into `textures`, -1 for none.
    textures : tuple of (H, W, 3) uint8
    slot_weights : (V, S) float
        Skin weights; each row sums to 1.
    slot_joints : (S,) int
    slot_from_bind : (S, 4, 4) float
        Inverse bind matrices.
    joint_names : tuple of J str
    joint_parents : (J,) int
        -1 for roots.
    pose : callable
        Time in seconds, 0 at the clip's first key, to `Pose`; None asks for the rest pose.
    duration : float
        Length of the clip, seconds; 0 if nothing moves.
    key_rate : float
        Key frames per second of the clip; 0 if it has none.
    world_from_asset : (4, 4) float
        Similarity into the world: metres, z up.
    morph_targets : (M, V, 3) float
        Displacements of the bind vertices.
    truth_extras : dict of str to array
        What else is known about the subject; goes into truth.npz under these names.
    wander : float, metres
        How far the subject's place drifts along x and y while the clip is played in a loop.
    """

    name: str
    bind_vertices: np.ndarray
    faces: np.ndarray
    normals_group: np.ndarray
    uv: np.ndarray
    vertex_colors: np.ndarray
    face_textures: np.ndarray
    textures: tuple[np.ndarray, ...]
    slot_weights: np.ndarray
    slot_joints: np.ndarray
    slot_from_bind: np.ndarray
    joint_names: tuple[str, ...]
    joint_parents: np.ndarray
    pose: Callable[[float | None], Pose]
    duration: float
    key_rate: float = 0.0
    world_from_asset: np.ndarray = field(default_factory=lambda: np.eye(4))
    morph_targets: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    truth_extras: dict[str, np.ndarray] = field(default_factory=dict)
    wander: float = 0.0

    def __post_init__(self) -> None:
        V, S, J = len(self.bind_vertices), len(self.slot_joints), len(self.joint_names)
        if not V or not len(self.faces):
            raise AssetError(f"{self.name}: no triangles in it; export the mesh together with the animation")
        if self.slot_weights.shape != (V, S) or self.slot_from_bind.shape != (S, 4, 4):
            raise AssetError(
                f"{self.name}: weights {self.slot_weights.shape} and bind matrices {self.slot_from_bind.shape} "
                f"don't fit {V} vertices and {S} slots"
            )
        if len(self.joint_parents) != J or np.any(self.joint_parents >= J):
            raise AssetError(f"{self.name}: {J} joints, but parents {self.joint_parents.tolist()}")

    @property
    def scale(self) -> float:
        """Metres per unit of the asset."""
        return float(np.cbrt(abs(np.linalg.det(self.world_from_asset[:3, :3]))))

    @cached_property
    def _sparse_weights(self) -> csr_array:
        return csr_array(self.slot_weights)

    @property
    def vertex_weights(self) -> np.ndarray:
        """Skin weights of the joints, (V, J) float."""
        weights = np.zeros((len(self.bind_vertices), len(self.joint_names)))
        np.add.at(weights.T, self.slot_joints, self.slot_weights.T)
        return weights

    def clip_time(self, time: float | None) -> float | None:
        """Fold a time into the clip, which is played in a loop."""
        if time is None or self.duration <= 0:
            return time
        return time if 0 <= time <= self.duration else float(time % self.duration)

    def place(self, time: float | None) -> np.ndarray:
        """How far the subject has drifted, (3,) float, metres, world; it never comes back to where it was."""
        angles = 2 * np.pi * (time or 0.0) / np.array(_WANDER_PERIODS)
        return self.wander * np.append(np.sin(angles), 0.0)

    def vertices(self, time: float | None) -> np.ndarray:
        """Vertices at a time in seconds (None: rest pose), (V, 3) float, metres, world."""
        pose = self.pose(self.clip_time(time))
        bound = self.bind_vertices
        if len(pose.morph_weights):
            bound = bound + np.tensordot(pose.morph_weights, self.morph_targets, axes=1)
        skin = self.world_from_asset @ pose.asset_from_joint[self.slot_joints] @ self.slot_from_bind
        homogeneous = np.column_stack([bound, np.ones(len(bound))])
        # Linear blend skinning: the weighted mean of the slots' matrices moves the vertex
        blended = (self._sparse_weights @ skin[:, :3].reshape(len(skin), 12)).reshape(-1, 3, 4)
        return np.einsum("vij,vj->vi", blended, homogeneous) + self.place(time)

    def joint_transforms(self, time: float | None) -> tuple[np.ndarray, np.ndarray]:
        """Joints at a time in seconds (None: rest pose).

        Returns
        -------
        positions : (J, 3) float, metres, world
        rotations : (J, 3, 3) float
            World from joint; scale and shear are taken out (the rotation nearest to the transform).
        """
        world = self.world_from_asset @ self.pose(self.clip_time(time)).asset_from_joint
        return world[:, :3, 3] + self.place(time), nearest_rotation(world[:, :3, :3])

    def welded(self, normals: np.ndarray) -> AnimatedAsset:
        """Return the asset with vertices that lie together at rest sharing one normal, unless the file parts them.

        Parameters
        ----------
        normals : (V, 3) float
            The file's normals; where they differ there is a sharp edge. Zeros make the surface smooth everywhere.
        """
        rest = self.vertices(None)
        size = float(np.ptp(rest, axis=0).max()) or 1.0
        key = np.column_stack([np.rint(rest / size * 1e5), np.rint(normals * 20)])
        return replace(self, normals_group=np.unique(key, axis=0, return_inverse=True)[1].ravel())

    def standing(self, height: float | None = None, samples: int = 60) -> AnimatedAsset:
        """Return the asset put on the floor: lowest point of the whole clip at z = 0, centred over the origin.

        Parameters
        ----------
        height : float, optional
            Height wanted at the clip's begin, metres; as the file has it if not given.
        samples : int
            Number of times at which the clip is looked at.
        """
        times = np.linspace(0.0, self.duration, samples if self.duration > 0 else 1)
        factor = 1.0
        if height is not None:
            factor = height / float(np.ptp(self.vertices(0.0)[:, 2]))
        shapes = np.array([self.vertices(t) for t in times])
        low, high = shapes.min(axis=(0, 1)) * factor, shapes.max(axis=(0, 1)) * factor
        world = np.diag([factor, factor, factor, 1.0])
        world[:3, 3] = -(low + high) / 2
        world[2, 3] = -low[2]
        return replace(self, world_from_asset=world @ self.world_from_asset)
