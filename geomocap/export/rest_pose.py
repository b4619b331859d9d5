"""A pose in which a skeleton counts as not turned: a person standing with the arms out, as retargeting tools expect.

Where a body's anatomical axes are known, the pose says how it is turned about its length, too: elbows bend forward in
it, whatever the subject does in the first frame. The pose looks along +z of the files, as characters of Mixamo and
HumanIK do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.angles.anatomical_frames import AnatomicalFrames
from geomocap.export.conventions import GLB
from geomocap.export.export_errors import MotionError
from geomocap.export.limb_pieces import pieces_beside
from geomocap.export.motion_tree import MotionTree
from geomocap.export.skinned_mesh import SkinnedMesh, bone_mesh
from geomocap.naming.found_names import FoundNames

# where bones point, in forward, left and up, of the left side; A: arms half down
TRUNK = ("thorax", "head")
ARM = ("upper_arm", "forearm", "hand")
LEG = ("thigh", "shank")
AXES_OF_THEIR_OWN = ("pelvis", "thorax", "upper_arm", "forearm", "thigh", "shank")  # others have their neighbours'
ARMS_OUT = {"T": np.array([0.0, 1.0, 0.0]), "A": np.array([0.0, 1.0, -1.0]) / np.sqrt(2)}


def at_rest(
    motion: MotionTree,
    mesh: SkinnedMesh | None,
    found: FoundNames,
    pose: Literal["first", "T", "A"],
    frames: AnatomicalFrames | None = None,
) -> tuple[MotionTree, SkinnedMesh | None]:
    """Return a motion whose nodes are not turned in a pose, and its mesh bound in that pose; bones without a mesh.

    Programs take the pose from the mesh. The motion itself stays the same. Bones of parts without a name keep their
    place on their parents, and named ones hang on named ones.

    Parameters
    ----------
    motion : MotionTree
        Not turned in the first frame.
    mesh : SkinnedMesh, optional
    found : FoundNames
    pose : "first", "T" or "A"
    frames : AnatomicalFrames, optional
        Without them limbs keep their turn about their length from the first frame.

    Raises
    ------
    MotionError
        If the pose is that of a person, and the subject wasn't named as one with left and right.
    """
    if pose == "first":
        return motion, mesh
    turns = _turns(motion, found, ARMS_OUT[pose], frames)
    parents = motion.parents
    before = np.where((parents >= 0)[:, None, None], turns[parents], np.eye(3))
    rested = replace(
        motion,
        rotations=before @ motion.rotations @ turns.swapaxes(1, 2),
        translations=np.einsum("nij,tnj->tni", before, motion.translations),
        offsets=np.einsum("nij,nj->ni", before, motion.offsets),
        tips=np.einsum("nij,nj->ni", turns, motion.tips),
    )
    rested = pieces_beside(rested, found)
    return rested, rebound(bone_mesh(motion) if mesh is None else mesh, rested)


def rebound(mesh: SkinnedMesh, motion: MotionTree) -> SkinnedMesh:
    """Return a mesh bound where no node of its motion is turned."""
    R, p = motion.bind_pose(mesh.bind_frame)
    _, rest = motion.bind_pose(None)
    local = np.einsum("vkji,vkj->vki", R[mesh.nodes], mesh.vertices[:, None] - p[mesh.nodes])
    vertices = np.einsum("vk,vki->vi", mesh.weights, local + rest[mesh.nodes])
    normals = np.einsum("vk,vkji,vj->vi", mesh.weights, R[mesh.nodes], mesh.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), mesh.normals)
    return replace(mesh, vertices=vertices, normals=normals, bind_frame=None)


def _turns(motion: MotionTree, found: FoundNames, arm: np.ndarray, frames: AnatomicalFrames | None) -> np.ndarray:
    """Turns (N, 3, 3) of the nodes from the first frame to the pose, in the world's axes."""
    template = found.template
    if template is None or template.name != "human" or found.from_world is None:
        raise MotionError(
            "rest pose T or A: the subject is not named as a person with left and right (--names human, or names.toml)"
        )
    front = GLB.points(np.eye(3), motion.up)[:, 2]
    up = np.eye(3)["xyz".index(motion.up)]
    pose_from_world = np.stack([front, np.cross(up, front), up])  # forward, left and up
    turns = np.tile(pose_from_world.T @ found.from_world, (motion.n_nodes, 1, 1))
    along: dict[int, np.ndarray] = {}
    for n in range(motion.n_nodes):
        parent = int(motion.parents[n])
        if n:
            turns[n] = turns[parent]
        part = _part_of_node(motion, found, n)
        if part is None:
            if parent in along and motion.children(n):
                along[n] = along[parent]  # a piece of a limb that is in two
        else:
            name, side = template.parts[part], template.sides[part]
            if name in (*ARM, *TRUNK, *LEG):
                mirror = np.array([1.0, -1.0 if side == "right" else 1.0, 1.0])
                along[n] = arm * mirror if name in ARM else np.array([0, 0, 1.0 if name in TRUNK else -1.0])
            axes = None if frames is None else frames.axes.get(f"{name}_{side}" if side else name)
            if axes is not None and name in AXES_OF_THEIR_OWN:
                turns[n] = (_axes_in_pose(along.get(n, np.array([0, 0, -1.0]))) @ pose_from_world).T @ axes.T
        bone = turns[n] @ _bone(motion, n)
        if n in along and np.linalg.norm(bone) > 1e-6:
            least, _ = Rotation.align_vectors((along[n] @ pose_from_world)[None], bone[None])
            turns[n] = least.as_matrix() @ turns[n]
    return turns


def _part_of_node(motion: MotionTree, found: FoundNames, node: int) -> int | None:
    """The template's part that begins at a node; None if it isn't known, or the body is what was cut off from one."""
    body = int(motion.bodies[node])
    part = found.joint_parts.get(int(motion.joints[node]), -1)
    if part in found.parts.get(body, ()):
        return part
    return found.parts[body][0] if body in found.whole else None


def _axes_in_pose(along: np.ndarray) -> np.ndarray:
    """Axes X, Y, Z of a part that points `along`, (3, 3), as rows in forward, left and up: those of a standing person.

    Arms get there by a turn about the axis that points forward.
    """
    standing = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    if abs(along[1]) < 1e-9:
        return standing
    raised, _ = Rotation.align_vectors(along[None], np.array([[0, 0, -1.0]]))
    return standing @ raised.as_matrix().T


def _bone(motion: MotionTree, node: int) -> np.ndarray:
    """From a node's joint to the next along its limb, or to its end, (3,) in its axes; the mean of several."""
    children = motion.children(node)
    return motion.offsets[children].mean(axis=0) if children else motion.tips[node]
