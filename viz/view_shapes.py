"""Shapes that the viewer hands over: surfaces cut into their bodies, turns as quaternions, fields of view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.export.skinned_mesh import SkinnedMesh
from geomocap.model.rig import Rig


@dataclass(frozen=True)
class BodyPiece:
    """The part of a skinned surface that one body moves most.

    Attributes
    ----------
    vertices : (V, 3) float, metres
    faces : (F, 3) int
    bones : (K,) int
        Nodes that move it.
    weights : (V, K) float
    """

    vertices: np.ndarray
    faces: np.ndarray
    bones: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class MovingSurface:
    """A surface whose vertices are asked for frame by frame.

    Attributes
    ----------
    faces : (F, 3) int
    owner : (F,) int
        The node that moves each triangle most.
    at : callable
        Frame to vertices (V, 3), metres.
    """

    faces: np.ndarray
    owner: np.ndarray
    at: Callable[[int], np.ndarray]

    def pieces(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Cut it by its nodes: node, the vertices of its piece (K,) and triangles of these (G, 3)."""
        found = []
        for node in np.unique(self.owner).tolist():
            used, faces = np.unique(self.faces[self.owner == node], return_inverse=True)
            found.append((node, used, faces.reshape(-1, 3)))
        return found


def body_pieces(mesh: SkinnedMesh, n_nodes: int) -> list[tuple[int, BodyPiece]]:
    """Cut a skinned surface into the pieces of its bodies; a triangle belongs to the node that moves it most."""
    dense = np.zeros((len(mesh.vertices), n_nodes))
    np.add.at(dense, (np.arange(len(dense))[:, None], mesh.nodes), mesh.weights)
    owner = dense[mesh.triangles].sum(axis=1).argmax(axis=1)
    pieces = []
    for node in np.unique(owner).tolist():
        used, faces = np.unique(mesh.triangles[owner == node], return_inverse=True)
        bones = np.flatnonzero(dense[used].any(axis=0))
        piece = BodyPiece(mesh.vertices[used], faces.reshape(-1, 3), bones, dense[np.ix_(used, bones)])
        pieces.append((node, piece))
    return pieces


def quaternion(rotations: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3) as quaternions (..., 4), w first."""
    found = Rotation.from_matrix(np.reshape(rotations, (-1, 3, 3))).as_quat(scalar_first=True)
    return found.reshape(*np.shape(rotations)[:-2], 4)


def vertical_fov(rig: Rig, camera: int) -> float:
    """Return the vertical field of view of a camera, radians."""
    return float(2 * np.arctan(rig.sizes[camera, 1] / 2 / rig.cameras[camera].focal_length_y))
