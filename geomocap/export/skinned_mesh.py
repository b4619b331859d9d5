"""A surface that nodes of a motion carry along (linear blend skinning)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.export.export_errors import MotionError
from geomocap.export.motion_tree import MotionTree
from geomocap.model.palette import body_colors

CORNERS = 24  # of a bone's eight triangles
INFLUENCES = 4  # nodes that may move a vertex, as glTF's JOINTS_0 holds them


@dataclass(frozen=True)
class SkinnedMesh:
    """A triangle mesh with the nodes and weights that move each vertex.

    Attributes
    ----------
    vertices : (V, 3) float, metres, world, in the pose of `bind_frame`
    normals : (V, 3) float, unit
    triangles : (F, 3) int
    colors : (V, 3) uint8, RGB
    nodes : (V, 4) int
        Nodes of the motion.
    weights : (V, 4) float
        They sum to one.
    bind_frame : int or None
        Frame of the motion in whose pose the vertices are; None: that in which no node is turned.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    bind_frame: int | None = 0

    def __post_init__(self) -> None:
        v = len(self.vertices)
        if v == 0 or len(self.triangles) == 0:
            raise MotionError("skin: the surface is empty; choose another reference frame")
        expected = {"normals": (v, 3), "colors": (v, 3), "nodes": (v, INFLUENCES), "weights": (v, INFLUENCES)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise MotionError(f"skin: {name} has shape {getattr(self, name).shape}, expected {shape}")

    def posed(self, motion: MotionTree) -> np.ndarray:
        """Vertices in every frame of the motion: (T, V, 3) metres, world."""
        R, p = motion.forward_kinematics()
        # Vertices in the axes of the nodes that carry them, as they were bound.
        bound_R, bound_p = motion.bind_pose(self.bind_frame)
        local = np.einsum("vkji,vkj->vki", bound_R[self.nodes], self.vertices[:, None] - bound_p[self.nodes])
        posed = np.empty((motion.n_frames, len(self.vertices), 3))
        for t in range(motion.n_frames):
            carried = np.einsum("vkij,vkj->vki", R[t][self.nodes], local) + p[t][self.nodes]
            posed[t] = np.einsum("vk,vki->vi", self.weights, carried)
        return posed


def bone_mesh(motion: MotionTree, thickness: float = 0.12) -> SkinnedMesh:
    """Make a long octahedron for every bone, so that a skeleton can be seen in any viewer.

    Parameters
    ----------
    motion : MotionTree
    thickness : float
        Half width of a bone as a fraction of its length.
    """
    R, p = motion.forward_kinematics()
    bones = _bones(motion, p[0], R[0])
    corners = np.concatenate([_octahedron(start, end, thickness) for _, start, end in bones])
    faces = np.arange(len(corners)).reshape(-1, 3)
    flat = corners[faces]
    normal = np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    carrier = np.zeros((len(corners), INFLUENCES), int)
    carrier[:, 0] = np.repeat([node for node, _, _ in bones], CORNERS)
    weights = np.zeros((len(corners), INFLUENCES))
    weights[:, 0] = 1
    colors = body_colors(motion.bodies)[carrier[:, 0]]
    return SkinnedMesh(corners, np.repeat(normal, 3, axis=0), faces, colors, carrier, weights)


def _bones(motion: MotionTree, p: np.ndarray, R: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Node that carries it, start and end of every bone in the first frame."""
    bones = [
        (int(motion.parents[n]), p[motion.parents[n]], p[n])
        for n in range(1, motion.n_nodes)
        if motion.bodies[motion.parents[n]] >= 0 or motion.parents[n] > 0
    ]
    for n in np.flatnonzero(np.isfinite(motion.tips).all(axis=1)).tolist():
        bones.append((n, p[n], p[n] + R[n] @ motion.tips[n]))
    return [b for b in bones if np.linalg.norm(b[2] - b[1]) > 1e-4]


def _octahedron(start: np.ndarray, end: np.ndarray, thickness: float) -> np.ndarray:
    """Corners of the eight triangles, (CORNERS, 3), each with its own for flat shading."""
    along = end - start
    length = np.linalg.norm(along)
    side = np.eye(3)[np.argmin(np.abs(along))]
    u = np.cross(along, side)
    u *= thickness * length / np.linalg.norm(u)
    v = np.cross(along, u) / length
    waist = start + 0.2 * along + np.array([u, v, -u, -v])
    corners = []
    for k in range(4):
        a, b = waist[k], waist[(k + 1) % 4]
        corners += [start, b, a, end, a, b]
    return np.array(corners)
