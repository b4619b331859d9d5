from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from data_tools.asset import WORLD_FROM_GLTF, AssetError
from data_tools.gltf_reader import load_gltf
from tests.data_tools.gltf_writer import GltfWriter

TURN = WORLD_FROM_GLTF[:3, :3]
TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def quaternion(axis: str, degrees: float) -> list[float]:
    return Rotation.from_euler(axis, degrees, degrees=True).as_quat().tolist()


def rigid_triangle(**node) -> GltfWriter:
    writer = GltfWriter()
    writer.document["nodes"] = [{"name": "part", "mesh": 0, **node}]
    attributes = {"POSITION": writer.accessor(TRIANGLE)}
    writer.document["meshes"] = [{"primitives": [{"attributes": attributes}]}]
    return writer


def skinned_strip(weights_kind: str = "f4", joints_kind: str = "u1") -> GltfWriter:
    """Three vertices along x; joint 0 at the origin, joint 1 at x = 1; the last vertex follows joint 1."""
    writer = GltfWriter()
    writer.document["nodes"] = [
        {"children": [1, 3], "name": "top"},
        {"children": [2], "name": "root"},
        {"translation": [1, 0, 0], "name": "tip"},
        {"mesh": 0, "skin": 0, "translation": [9, 9, 9], "name": "skin"},  # a skinned mesh's own place counts not
    ]
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 0, 3] = -1
    matrices = writer.accessor(inverse.transpose(0, 2, 1).reshape(2, 16))
    writer.document["skins"] = [{"joints": [1, 2], "inverseBindMatrices": matrices}]
    full = {"f4": 1.0, "u1": 255, "u2": 65535}[weights_kind]
    half = {"f4": 0.5, "u1": 127.5, "u2": 32767.5}[weights_kind]
    weights = [[full, 0, 0, 0], [half, half, 0, 0], [0, full, 0, 0]]
    attributes = {
        "POSITION": writer.accessor([[0, 0, 0], [1, 0, 0], [2, 0, 0]], padding=8),
        "JOINTS_0": writer.accessor([[0, 1, 0, 0]] * 3, joints_kind),
        "WEIGHTS_0": writer.accessor(np.floor(weights), weights_kind, normalized=weights_kind != "f4")
        if weights_kind != "f4"
        else writer.accessor(weights),
    }
    indices = writer.accessor([0, 1, 2], "u2")
    writer.document["meshes"] = [{"primitives": [{"attributes": attributes, "indices": indices}]}]
    return writer


@pytest.mark.parametrize("weights_kind", ["f4", "u1", "u2"])
@pytest.mark.parametrize("joints_kind", ["u1", "u2"])
def test_skin_follows_its_joints(tmp_path: Path, weights_kind: str, joints_kind: str) -> None:
    writer = skinned_strip(weights_kind, joints_kind)
    writer.animate(2, "rotation", [0, 1], [quaternion("z", 0), quaternion("z", 90)])
    asset = load_gltf(writer.write_glb(tmp_path / "strip.glb"))
    moved = asset.vertices(1.0) @ TURN
    # The tip turns by 90° about (1, 0, 0); the middle vertex lies on that axis
    np.testing.assert_allclose(moved, [[0, 0, 0], [1, 0, 0], [1, 1, 0]], atol=1e-6)
    assert asset.joint_names == ("root", "tip")
    assert asset.joint_parents.tolist() == [-1, 0]
    np.testing.assert_allclose(asset.vertex_weights, [[1, 0], [0.5, 0.5], [0, 1]], atol=0.003)


def test_linear_rotation_turns_evenly_the_short_way(tmp_path: Path) -> None:
    writer = rigid_triangle()
    last = -np.array(quaternion("y", 120))  # the same rotation with the other sign
    writer.animate(0, "rotation", [0.5, 2.5], [quaternion("y", 0), last])
    asset = load_gltf(writer.write(tmp_path / "a.gltf"))
    assert asset.duration == pytest.approx(2.0)
    for time, angle in ((0.0, 0), (0.5, 30), (1.0, 60), (2.0, 120)):
        expected = TRIANGLE @ Rotation.from_euler("y", angle, degrees=True).as_matrix().T
        np.testing.assert_allclose(asset.vertices(time) @ TURN, expected, atol=1e-6)


def test_step_holds_and_linear_scale_grows(tmp_path: Path) -> None:
    writer = rigid_triangle()
    writer.animate(0, "translation", [0, 1, 2], [[0, 0, 0], [5, 0, 0], [6, 0, 0]], "STEP")
    writer.animate(0, "scale", [0, 2], [[1, 1, 1], [3, 3, 3]])
    asset = load_gltf(writer.write(tmp_path / "a.gltf"))
    np.testing.assert_allclose(asset.vertices(0.9) @ TURN, TRIANGLE * 1.9, atol=1e-6)
    np.testing.assert_allclose(asset.vertices(1.5) @ TURN, TRIANGLE * 2.5 + [5, 0, 0], atol=1e-6)
    _, rotations = asset.joint_transforms(1.5)
    np.testing.assert_allclose(rotations[0], TURN, atol=1e-12)  # no scale left in it


def test_cubic_spline_follows_its_polynomial(tmp_path: Path) -> None:
    # x(t) = t³ has value 0 and slope 0 at 0, value 8 and slope 12 at 2: the spline must be exactly that
    writer = rigid_triangle()
    keys = [[[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[12, 0, 0], [8, 0, 0], [12, 0, 0]]]
    writer.animate(0, "translation", [0, 2], np.reshape(keys, (6, 3)), "CUBICSPLINE")
    asset = load_gltf(writer.write(tmp_path / "a.gltf"))
    for time in (0.0, 0.3, 1.0, 1.7, 2.0):
        np.testing.assert_allclose((asset.vertices(time) @ TURN)[0], [time**3, 0, 0], atol=1e-6)


def test_cubic_rotation_is_a_unit_quaternion(tmp_path: Path) -> None:
    writer = rigid_triangle()
    zero = [0, 0, 0, 0]
    keys = [zero, quaternion("z", 0), zero, zero, quaternion("z", 90), zero]
    writer.animate(0, "rotation", [0, 1], keys, "CUBICSPLINE")
    moved = load_gltf(writer.write(tmp_path / "a.gltf")).vertices(0.5) @ TURN
    expected = TRIANGLE @ Rotation.from_euler("z", 45, degrees=True).as_matrix().T  # by symmetry
    np.testing.assert_allclose(moved, expected, atol=1e-6)


def test_sparse_accessor_replaces_single_values(tmp_path: Path) -> None:
    writer = rigid_triangle()
    where = writer.view(np.array([2], "<u2").tobytes())
    values = writer.view(np.array([[0, 7, 0]], "<f4").tobytes())
    writer.document["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": values},
    }
    np.testing.assert_allclose(
        load_gltf(writer.write(tmp_path / "a.gltf")).vertices(None) @ TURN, [[0, 0, 0], [1, 0, 0], [0, 7, 0]]
    )


def test_rigid_meshes_hang_on_the_nearest_moving_node(tmp_path: Path) -> None:
    writer = rigid_triangle()
    column_major = np.eye(4)
    column_major[:3, 3] = [0, 0, 2]
    writer.document["nodes"] = [
        {"name": "base", "children": [1], "mesh": 0},
        {"name": "hinge", "children": [2], "translation": [1, 0, 0]},
        {"name": "bracket", "children": [3], "matrix": column_major.T.ravel().tolist()},
        {"name": "flap", "mesh": 0},
    ]
    writer.animate(1, "rotation", [0, 1], [quaternion("z", 0), quaternion("z", 90)])
    asset = load_gltf(writer.write(tmp_path / "a.gltf"))
    assert asset.joint_names == ("base", "hinge")
    assert asset.joint_parents.tolist() == [-1, 0]
    turned = TRIANGLE @ Rotation.from_euler("z", 90, degrees=True).as_matrix().T + [1, 0, 2]
    np.testing.assert_allclose(asset.vertices(1.0) @ TURN, np.concatenate([TRIANGLE, turned]), atol=1e-6)
    np.testing.assert_array_equal(asset.vertex_weights.argmax(axis=1), [0, 0, 0, 1, 1, 1])


def test_morph_targets_are_added(tmp_path: Path) -> None:
    writer = rigid_triangle()
    primitive = writer.document["meshes"][0]["primitives"][0]
    primitive["targets"] = [
        {"POSITION": writer.accessor([[0, 0, 1]] * 3)},
        {"POSITION": writer.accessor([[2, 0, 0]] * 3)},
    ]
    writer.document["meshes"][0]["weights"] = [0.5, 0.0]
    writer.animate(0, "weights", [0, 1], [[0], [1], [1], [0]])
    asset = load_gltf(writer.write(tmp_path / "a.gltf"))
    np.testing.assert_allclose(asset.vertices(None) @ TURN, np.add(TRIANGLE, [0, 0, 0.5]), atol=1e-6)
    np.testing.assert_allclose(asset.vertices(0.25) @ TURN, np.add(TRIANGLE, [1.5, 0, 0.25]), atol=1e-6)


def test_texture_colours_and_second_coordinates(tmp_path: Path) -> None:
    writer = rigid_triangle()
    picture = np.zeros((2, 4, 3), np.uint8)
    picture[:, :2] = (0, 0, 255)  # OpenCV writes BGR: red on the left
    cv2.imwrite(str(tmp_path / "red left.png"), picture)
    primitive = writer.document["meshes"][0]["primitives"][0]
    primitive["material"] = 0
    primitive["attributes"]["TEXCOORD_1"] = writer.accessor([[0, 0], [255, 0], [0, 255]], "u1", normalized=True)
    primitive["attributes"]["COLOR_0"] = writer.accessor([[65535, 0, 0]] * 3, "u2", normalized=True)
    writer.document["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}, "baseColorFactor": [1, 1, 1, 1]}}
    ]
    writer.document["textures"] = [{"source": 0}]
    writer.document["images"] = [{"uri": "red%20left.png"}]
    asset = load_gltf(writer.write(tmp_path / "a.gltf"))
    np.testing.assert_array_equal(asset.textures[0][0], [[255, 0, 0], [255, 0, 0], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(asset.uv, [[0, 0], [1, 0], [0, 1]])
    np.testing.assert_allclose(asset.vertex_colors, [[1, 0, 0]] * 3)
    assert asset.face_textures.tolist() == [0]


def test_strips_and_fans(tmp_path: Path) -> None:
    square = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    for mode, order in ((5, [0, 1, 2, 3]), (6, [0, 1, 3, 2])):
        writer = rigid_triangle()
        indices = writer.accessor(order, "u1")
        attributes = {"POSITION": writer.accessor(square)}
        writer.document["meshes"][0]["primitives"] = [{"attributes": attributes, "indices": indices, "mode": mode}]
        asset = load_gltf(writer.write(tmp_path / "a.gltf"))
        corners = np.array(square)[asset.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        np.testing.assert_allclose(normals, [[0, 0, 1], [0, 0, 1]])  # both triangles face the same way


def test_clip_is_looped_and_stands_on_the_floor(tmp_path: Path) -> None:
    writer = rigid_triangle()
    writer.animate(0, "translation", [0, 1], [[0, 3, 0], [0, 5, 0]])
    asset = load_gltf(writer.write(tmp_path / "a.gltf"))
    np.testing.assert_allclose(asset.vertices(3.25), asset.vertices(0.25), atol=1e-12)
    tall = asset.standing(height=2.0)
    lowest = min(tall.vertices(t)[:, 2].min() for t in np.linspace(0, 1, 60))
    assert lowest == pytest.approx(0, abs=1e-9)
    assert np.ptp(tall.vertices(0)[:, 2]) == pytest.approx(2.0)
    assert tall.vertices(1)[:, 2].min() == pytest.approx(2 * 2.0)  # a constant shift: the jump stays, scaled


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (lambda d: d.update(buffers=[{"byteLength": 36, "uri": "../other.bin"}]), "outside its own folder"),
        (lambda d: d.update(buffers=[{"byteLength": 36, "uri": "missing.bin"}]), "missing.bin"),
        (lambda d: d["accessors"][0].update(count=300), "beyond its buffer"),
        (lambda d: d["meshes"][0].update(primitives=[]), "no triangles"),
        (lambda d: d["nodes"][0].update(mesh=5), "not a valid glTF"),
    ],
)
def test_broken_files_say_what_is_wrong(tmp_path: Path, change, message: str) -> None:
    import json

    path = rigid_triangle().write(tmp_path / "a.gltf")
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(AssetError, match=message):
        load_gltf(path)


def test_wrong_files_and_animations_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"no glTF at all")
    with pytest.raises(AssetError, match="not a readable glTF"):
        load_gltf(tmp_path / "a.glb")
    with pytest.raises(AssetError, match="no such file"):
        load_gltf(tmp_path / "b.glb")
    writer = rigid_triangle()
    writer.animate(0, "translation", [0, 1], [[0, 0, 0], [1, 0, 0]], name="walk")
    path = writer.write(tmp_path / "c.gltf")
    with pytest.raises(AssetError, match=r"no animation 'run'; it has walk"):
        load_gltf(path, "run")
    assert load_gltf(path, 0).duration == load_gltf(path, "walk").duration == 1


@pytest.mark.parametrize(
    ("name", "animation", "joints", "seconds"),
    [("CesiumMan.glb", None, 19, 1.9583), ("horse-animations.glb", "Walk", 56, 0.9333)],
)
def test_characters_agree_with_another_reader(data: Path, name, animation, joints, seconds) -> None:
    path = data / "characters" / name
    asset = load_gltf(path, animation)
    assert len(asset.joint_names) == joints
    assert asset.duration == pytest.approx(seconds, abs=1e-3)
    np.testing.assert_allclose(asset.slot_weights.sum(axis=1), 1)
    graph = trimesh.load_scene(path).graph
    positions, _ = asset.joint_transforms(None)
    expected = np.array([graph.get(name)[0][:3, 3] for name in asset.joint_names])
    np.testing.assert_allclose(positions, expected @ TURN.T, atol=1e-5)
    # Skins and joints hang together: no vertex is far from the joint that moves it most
    positions, _ = asset.joint_transforms(0.4)
    owner = asset.vertex_weights.argmax(axis=1)
    size = np.ptp(positions, axis=0).max()
    assert np.linalg.norm(asset.vertices(0.4) - positions[owner], axis=1).max() < 0.45 * size


def test_kinematics_of_a_character_step_by_step(data: Path) -> None:
    """Forward kinematics from the raw key frames, joint by joint along one chain, at a key's own time."""
    asset = load_gltf(data / "characters" / "CesiumMan.glb")
    tree = asset.pose
    time = float(tree.channels[0].times[7])
    world = np.eye(4)
    chain = [0, 1, 3, 12, 13, 17, 18]  # from the file's root to the left forearm
    for node in chain:
        values = {c.path: c.values[7] for c in tree.channels if c.node == node}
        if values:
            local = np.eye(4)
            x, y, z, w = values["rotation"]
            local[:3, :3] = [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
            local[:3, :3] *= values["scale"]
            local[:3, 3] = values["translation"]
        else:
            local = tree.matrices[node]
        world = world @ local
    positions, _ = asset.joint_transforms(time - tree.start)
    joint = asset.joint_names.index("Skeleton_arm_joint_L__3_")
    np.testing.assert_allclose(positions[joint], (WORLD_FROM_GLTF @ world)[:3, 3], atol=1e-6)
