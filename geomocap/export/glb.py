"""GLB (binary glTF 2.0): the skeleton animated, with a surface that it moves.

Axes y up, metres. The nodes' rest pose is the first frame. The surface is the subject's own skin, or a bone for each
node, so that any viewer shows something that moves. Vertex colours are linear, as glTF 2.0 section 3.7.2.1 asks.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gltf

from geomocap.export.conventions import GLB
from geomocap.export.motion_tree import MotionTree
from geomocap.export.skinned_mesh import SkinnedMesh, bone_mesh
from geomocap.files.atomic import write_bytes
from geomocap.model.rotations import quaternions

_COMPONENT = {np.dtype(np.float32): gltf.FLOAT, np.dtype(np.uint16): gltf.UNSIGNED_SHORT}
_COMPONENT[np.dtype(np.uint32)] = gltf.UNSIGNED_INT
_KIND = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


def write_glb(path: Path, motion: MotionTree, mesh: SkinnedMesh | None = None, *, name: str = "motion") -> None:
    """Write a motion as GLB, whole or not at all.

    Parameters
    ----------
    path : Path
    motion : MotionTree
        In world axes, metres.
    mesh : SkinnedMesh, optional
        The surface that it moves; without one, a bone for each node.
    name : str
        Name of the animation.
    """
    data = glb_bytes(motion, mesh or bone_mesh(motion), name)
    write_bytes(path, data)


def glb_bytes(motion: MotionTree, mesh: SkinnedMesh, name: str = "motion") -> bytes:
    """Return a GLB file of a motion and the surface that it moves."""
    file = _File()
    y_up = motion.converted(GLB)
    joints = file.add_nodes(y_up)
    skin = file.add_skin(y_up, joints, mesh.bind_frame)
    surface = file.add_mesh(mesh, motion)
    body = file.node(gltf.Node(name="surface", mesh=surface, skin=skin))
    file.add_animation(y_up, joints, name)
    return file.bytes([joints[0], body])


class _File:
    """A glTF document that grows: each array becomes a buffer view and an accessor."""

    def __init__(self) -> None:
        self.document = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="geomocap"))
        self.blob = bytearray()

    def node(self, node: gltf.Node) -> int:
        self.document.nodes.append(node)
        return len(self.document.nodes) - 1

    def accessor(self, array: np.ndarray, target: int | None = None, **extra: Any) -> int:
        """Append an array (float32, uint16 or uint32) and return its accessor."""
        array = np.ascontiguousarray(array)
        self.blob.extend(b"\0" * (-len(self.blob) % 4))
        view = gltf.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=array.nbytes, target=target)
        self.blob.extend(array.tobytes())
        self.document.bufferViews.append(view)
        self.document.accessors.append(
            gltf.Accessor(
                bufferView=len(self.document.bufferViews) - 1,
                componentType=_COMPONENT[array.dtype],
                count=len(array),
                type=_KIND[array.shape[1:]],
                **extra,
            )
        )
        return len(self.document.accessors) - 1

    def add_nodes(self, motion: MotionTree) -> list[int]:
        q = quaternions(motion.rotations)
        for n, name in enumerate(motion.names):
            self.node(
                gltf.Node(
                    name=name,
                    children=motion.children(n),
                    translation=motion.translations[0, n].tolist(),
                    rotation=q[0, n].tolist(),
                )
            )
        return list(range(motion.n_nodes))

    def add_skin(self, motion: MotionTree, joints: list[int], bind_frame: int) -> int:
        R, p = motion.forward_kinematics()
        inverse = np.tile(np.eye(4), (len(joints), 1, 1))
        turned = R[bind_frame].swapaxes(-1, -2)
        inverse[:, :3, :3] = turned
        inverse[:, :3, 3] = -np.einsum("nij,nj->ni", turned, p[bind_frame])
        matrices = self.accessor(inverse.swapaxes(-1, -2).astype(np.float32))  # column major
        self.document.skins.append(gltf.Skin(joints=joints, skeleton=joints[0], inverseBindMatrices=matrices))
        return 0

    def add_mesh(self, mesh: SkinnedMesh, motion: MotionTree) -> int:
        position = GLB.points(mesh.vertices, motion.up).astype(np.float32)
        normal = GLB.points(mesh.normals, motion.up)
        normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
        weights = mesh.weights.astype(np.float32)
        weights /= weights.sum(axis=1, keepdims=True)
        color = np.full((len(position), 4), 65535, np.uint16)
        color[:, :3] = np.rint(linear_light(mesh.colors / 255.0) * 65535)
        vertex = gltf.ARRAY_BUFFER
        attributes = gltf.Attributes(
            POSITION=self.accessor(
                position, vertex, min=position.min(axis=0).tolist(), max=position.max(axis=0).tolist()
            ),
            NORMAL=self.accessor(normal, vertex),
            COLOR_0=self.accessor(color, vertex, normalized=True),
            JOINTS_0=self.accessor(np.where(weights > 0, mesh.nodes, 0).astype(np.uint16), vertex),
            WEIGHTS_0=self.accessor(weights, vertex),
        )
        faces = self.accessor(mesh.triangles.astype(np.uint32).ravel(), gltf.ELEMENT_ARRAY_BUFFER)
        matte = gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=0.8)
        self.document.materials.append(gltf.Material(name="surface", pbrMetallicRoughness=matte, doubleSided=True))
        primitive = gltf.Primitive(attributes=attributes, indices=faces, material=0)
        self.document.meshes.append(gltf.Mesh(name="surface", primitives=[primitive]))
        return 0

    def add_animation(self, motion: MotionTree, joints: list[int], name: str) -> None:
        seconds = (np.arange(motion.n_frames) / motion.fps).astype(np.float32)
        time = self.accessor(seconds, min=[float(seconds[0])], max=[float(seconds[-1])])
        q = quaternions(motion.rotations).astype(np.float32)
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        animation = gltf.Animation(name=name)
        for n, joint in enumerate(joints):
            tracks = {"rotation": q[:, n]}
            if n == 0 or motion.moving[n]:
                tracks["translation"] = motion.translations[:, n].astype(np.float32)
            for path, values in tracks.items():
                animation.samplers.append(gltf.AnimationSampler(input=time, output=self.accessor(values)))
                target = gltf.AnimationChannelTarget(node=joint, path=path)
                animation.channels.append(gltf.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))
        self.document.animations.append(animation)

    def bytes(self, scene: list[int]) -> bytes:
        self.document.scenes.append(gltf.Scene(nodes=scene))
        self.document.scene = 0
        self.document.buffers.append(gltf.Buffer(byteLength=len(self.blob)))
        self.document.set_binary_blob(bytes(self.blob))
        return b"".join(self.document.save_to_bytes())


def linear_light(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values between 0 and 1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
