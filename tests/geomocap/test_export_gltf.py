import json
import shutil
import subprocess

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from geomocap.export.glb import write_glb
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.skinned_mesh import bone_mesh
from tests.geomocap.articulated import articulated_skeleton, skeleton_arrays, skeleton_of

TYPES = {5126: np.float32, 5123: np.uint16, 5125: np.uint32}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """A reader that follows the glTF 2.0 specification and shares nothing with the writer."""

    def __init__(self, path):
        self.file = pygltflib.GLTF2.load(str(path))
        self.blob = self.file.binary_blob()

    def array(self, index):
        accessor = self.file.accessors[index]
        view = self.file.bufferViews[accessor.bufferView]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        width = WIDTHS[accessor.type]
        data = np.frombuffer(self.blob, TYPES[accessor.componentType], accessor.count * width, start)
        return data.reshape(accessor.count, width)

    def local(self, node, frame):
        n = self.file.nodes[node]
        values = {"translation": n.translation or [0, 0, 0], "rotation": n.rotation or [0, 0, 0, 1]}
        animation = self.file.animations[0]
        for channel in animation.channels:
            if channel.target.node == node:
                values[channel.target.path] = self.array(animation.samplers[channel.sampler].output)[frame]
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(values["rotation"]).as_matrix()
        matrix[:3, 3] = values["translation"]
        return matrix

    def world(self, frame):
        """4×4 matrices of all nodes by name."""
        result = {}
        stack = [(n, np.eye(4)) for n in self.file.scenes[self.file.scene].nodes]
        while stack:
            node, parent = stack.pop()
            matrix = parent @ self.local(node, frame)
            result[self.file.nodes[node].name] = matrix
            stack += [(c, matrix) for c in self.file.nodes[node].children or []]
        return result

    def skinned(self, frame):
        """Vertices in a frame, as glTF 2.0 section 3.7.3.3 moves them."""
        skin = self.file.skins[0]
        attributes = self.file.meshes[0].primitives[0].attributes
        inverse = self.array(skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
        world = self.world(frame)
        joint = np.array([world[self.file.nodes[j].name] for j in skin.joints]) @ inverse
        v = np.c_[self.array(attributes.POSITION), np.ones(len(self.array(attributes.POSITION)))]
        moved = np.einsum("vkij,vj->vki", joint[self.array(attributes.JOINTS_0)], v)
        return np.einsum("vk,vki->vi", self.array(attributes.WEIGHTS_0), moved)[:, :3]


def z_up(points):
    return points[..., [0, 2, 1]] * [1, -1, 1]


@pytest.mark.parametrize("kind", [{}, {"jump_mm": 15.0}])
def test_joints_read_back(tmp_path, kind):
    arrays = skeleton_arrays(**kind)
    motion = motion_from_skeleton(skeleton_of(arrays))
    write_glb(tmp_path / "m.glb", motion)
    glb = Glb(tmp_path / "m.glb")
    for frame in range(20):
        world = glb.world(frame)
        for node, joint in enumerate(motion.joints):
            if joint >= 0:
                found = z_up(world[motion.names[node]][:3, 3])
                np.testing.assert_allclose(found, arrays["joint_positions"][frame, joint], atol=1e-5)
    times = glb.array(glb.file.animations[0].samplers[0].input).ravel()
    np.testing.assert_allclose(times, np.arange(20) / 15, rtol=1e-6)


def test_surface_is_moved_as_the_library_moves_it(tmp_path):
    motion = motion_from_skeleton(articulated_skeleton())
    mesh = bone_mesh(motion)
    write_glb(tmp_path / "m.glb", motion, mesh)
    glb, posed = Glb(tmp_path / "m.glb"), mesh.posed(motion)
    for frame in (0, 7, 19):
        np.testing.assert_allclose(z_up(glb.skinned(frame)), posed[frame], atol=1e-5)


def test_bones_run_between_the_joints_in_every_frame():
    arrays = skeleton_arrays()
    motion = motion_from_skeleton(skeleton_of(arrays))
    posed = bone_mesh(motion).posed(motion)
    for joint in arrays["joint_positions"].swapaxes(0, 1):
        nearest = np.linalg.norm(posed - joint[:, None], axis=-1).min(axis=1)
        np.testing.assert_allclose(nearest, 0, atol=1e-9)


def test_faces_look_outwards():
    mesh = bone_mesh(motion_from_skeleton(articulated_skeleton(n_bodies=1, n_frames=2)))
    outward = np.sum((mesh.vertices - mesh.vertices.mean(axis=0)) * mesh.normals, axis=1)
    assert (outward > 0).all()


VALIDATE = """
const fs = require("fs");
const validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then((r) => console.log(JSON.stringify(r)));
"""


def validated(file, tmp_path):
    """What Khronos' own validator says of a file: npm package gltf-validator, found by way of NODE_PATH."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Khronos' validator needs Node.js")
    script = tmp_path / "validate.cjs"
    script.write_text(VALIDATE)
    done = subprocess.run([node, str(script), str(file)], capture_output=True, text=True, timeout=120)
    if "Cannot find module 'gltf-validator'" in done.stderr:
        pytest.skip("no gltf-validator (npm install gltf-validator, and its node_modules in NODE_PATH)")
    return json.loads(done.stdout)


@pytest.mark.parametrize("kind", [{}, {"jump_mm": 15.0}, {"n_bodies": 1}])
@pytest.mark.parametrize("skinned", [True, False])
def test_the_khronos_validator_finds_nothing(tmp_path, kind, skinned):
    motion = motion_from_skeleton(skeleton_of(skeleton_arrays(**kind)))
    write_glb(tmp_path / "m.glb", motion, bone_mesh(motion) if skinned else None)
    report = validated(tmp_path / "m.glb", tmp_path)
    assert report["info"]["animationCount"] == 1
    assert report["issues"]["messages"] == []


def test_the_khronos_validator_sees_a_damaged_file(tmp_path):
    write_glb(tmp_path / "m.glb", motion_from_skeleton(articulated_skeleton()))
    data = (tmp_path / "m.glb").read_bytes()
    (tmp_path / "m.glb").write_bytes(data.replace(b'"VEC4"', b'"VEC3"', 1))
    assert validated(tmp_path / "m.glb", tmp_path)["issues"]["numErrors"] > 0
