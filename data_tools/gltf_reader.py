"""Reading animated glTF and GLB files: skins, rigid parts on moving nodes, morph targets, textures.

Source: Khronos glTF 2.0 specification.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pygltflib

from data_tools.animation import Channel, NodeTree, transform
from data_tools.asset import WORLD_FROM_GLTF, AnimatedAsset, AssetError
from data_tools.gltf_buffers import GltfBuffers
from geomocap.reading import read_bytes, reason

_INVALID = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, MemoryError, RecursionError)
READABLE_EXTENSIONS = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_materials_", "KHR_lights_", "KHR_xmp")


def load_gltf(path: Path, animation: str | int | None = None) -> AnimatedAsset:
    """Load an animated glTF or GLB file.

    Skin joints are joints; so is every moving node that carries a rigid mesh (a machine's parts).

    Parameters
    ----------
    path : Path
        .gltf (with its .bin and images beside it) or .glb.
    animation : str or int, optional
        Name or number of the animation; the first if not given.

    Raises
    ------
    AssetError
        If the file can't be read, has no triangles or no such animation, or needs an extension that is not known.
    """
    path = Path(path)
    gltf = _open(path)
    try:
        channels = _channels(GltfBuffers(path, gltf), _choose(path, gltf, animation))
        return _Reader(path, gltf, GltfBuffers(path, gltf), channels).asset()
    except _INVALID as error:
        raise AssetError(f"{path}: not a valid glTF file ({reason(error)}); export it again") from None


def _open(path: Path) -> pygltflib.GLTF2:
    if not path.is_file():
        raise AssetError(f"{path}: no such file; give a .glb or .gltf file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            binary = read_bytes(path)[:4] == b"glTF"
            gltf = pygltflib.GLTF2.load_binary(str(path)) if binary else pygltflib.GLTF2.load_json(str(path))
    except Exception as error:
        raise AssetError(f"{path}: not a readable glTF file ({reason(error)}); export it again as .glb") from None
    if gltf is None:
        raise AssetError(f"{path}: not a readable glTF file; export it again as .glb")
    unknown = [e for e in gltf.extensionsRequired or [] if not e.startswith(READABLE_EXTENSIONS)]
    if unknown:
        raise AssetError(f"{path}: needs {', '.join(unknown)}; export it without compression and extensions")
    return gltf


def _choose(path: Path, gltf: pygltflib.GLTF2, animation: str | int | None) -> pygltflib.Animation | None:
    if not gltf.animations:
        if animation is not None:
            raise AssetError(f"{path}: has no animations, so no {animation!r}; leave the animation out")
        return None
    if animation is None:
        return gltf.animations[0]
    names = [a.name or str(k) for k, a in enumerate(gltf.animations)]
    if animation in names:
        return gltf.animations[names.index(str(animation))]
    if isinstance(animation, int) or animation.isdecimal():
        if 0 <= int(animation) < len(names):
            return gltf.animations[int(animation)]
    raise AssetError(f"{path}: no animation {animation!r}; it has {', '.join(names)}")


def _channels(buffers: GltfBuffers, animation: pygltflib.Animation | None) -> tuple[Channel, ...]:
    if animation is None:
        return ()
    channels = []
    for channel in animation.channels:
        if channel.target.node is None:
            continue
        sampler = animation.samplers[channel.sampler]
        times = buffers.accessor(sampler.input)
        kind = sampler.interpolation or "LINEAR"
        values = buffers.accessor(sampler.output).reshape(
            (len(times), 3, -1) if kind == "CUBICSPLINE" else (len(times), -1)
        )
        path = channel.target.path
        if path == "rotation" and kind != "CUBICSPLINE":
            values = values / np.linalg.norm(values, axis=1, keepdims=True)
        if path in ("translation", "rotation", "scale", "weights"):
            channels.append(Channel(channel.target.node, path, times, values, kind))
    return tuple(channels)


def _key_rate(channels: list[Channel]) -> float:
    """Keys per second where they lie most densely, to a thousandth; 0 if there are none."""
    longest = max((c.times for c in channels), key=len, default=np.zeros(0))
    step = float(np.median(np.diff(longest))) if len(longest) > 1 else 0.0
    return round(1 / step, 3) if step > 0 else 0.0


@dataclass
class _Primitive:
    """One primitive on one node, with what moves it."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    colors: np.ndarray
    texture: int
    slots: np.ndarray
    weights: np.ndarray
    morphs: dict[int, np.ndarray]


class _Reader:
    """Gathers the parts of one file; used once by `load_gltf`."""

    def __init__(self, path: Path, gltf: pygltflib.GLTF2, buffers: GltfBuffers, channels: tuple[Channel, ...]) -> None:
        self.path, self.gltf, self.buffers, self.channels = path, gltf, buffers, channels
        self.moving = {c.node for c in channels if c.path != "weights"}
        self.parents, self.order = self._hierarchy()
        self.parts = tuple(self._parts(n) for n in gltf.nodes)
        self.matrices = np.array(
            [
                np.reshape(n.matrix, (4, 4)).T if n.matrix is not None else transform(*p)
                for n, p in zip(gltf.nodes, self.parts, strict=True)
            ]
        )
        self.slots: list[tuple[int, np.ndarray]] = []  # node and inverse bind matrix
        self.skin_slots: dict[int, int] = {}  # skin to its first slot
        self.texture_of_image: dict[int, int] = {}
        self.textures: list[np.ndarray] = []
        self.morphs: list[tuple[int, np.ndarray]] = []
        self.morph_start: dict[int, int] = {}

    def asset(self) -> AnimatedAsset:
        """Put all meshes of the scene together."""
        meshes = [m for node in self.order if self.gltf.nodes[node].mesh is not None for m in self._meshes(node)]
        if not meshes:
            raise AssetError(f"{self.path}: no triangles in it; export the mesh together with the animation")
        starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
        total = int(starts[-1])
        weights = np.zeros((total, len(self.slots)))
        morphs = np.zeros((sum(len(w) for _, w in self.morphs), total, 3))
        for mesh, first in zip(meshes, starts, strict=False):
            rows = np.arange(first, first + len(mesh.vertices))
            np.add.at(weights, (rows[:, None], mesh.slots), mesh.weights)
            for target, moved in mesh.morphs.items():
                morphs[target, rows] = moved
        nodes = sorted({node for node, _ in self.slots}, key=list(self.order).index)
        index = {node: k for k, node in enumerate(nodes)}
        used = [c for c in self.channels if c.node in set(self.order)]
        start = min((float(c.times[0]) for c in used), default=0.0)
        tree = NodeTree(
            self.parents, self.order, self.matrices, self.parts, self.channels, start, np.array(nodes),
            tuple(self.morphs),
        )  # fmt: skip
        asset = AnimatedAsset(
            name=self.path.stem,
            bind_vertices=np.concatenate([m.vertices for m in meshes]),
            faces=np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=False)]),
            normals_group=np.arange(total),
            uv=np.concatenate([m.uv for m in meshes]),
            vertex_colors=np.concatenate([m.colors for m in meshes]),
            face_textures=np.concatenate([np.full(len(m.faces), m.texture) for m in meshes]),
            textures=tuple(self.textures),
            slot_weights=weights,
            slot_joints=np.array([index[node] for node, _ in self.slots]),
            slot_from_bind=np.array([matrix for _, matrix in self.slots]),
            joint_names=tuple(self.gltf.nodes[n].name or f"node{n}" for n in nodes),
            joint_parents=np.array([index.get(self._ancestor(n, index), -1) for n in nodes]),
            pose=tree,
            duration=max((float(c.times[-1]) for c in used), default=start) - start,
            key_rate=_key_rate(used),
            world_from_asset=WORLD_FROM_GLTF,
            morph_targets=morphs,
        )
        return asset.welded(np.concatenate([m.normals for m in meshes]))

    def _hierarchy(self) -> tuple[np.ndarray, np.ndarray]:
        """Parents of all nodes, and the nodes of the scene, parents first."""
        parents = np.full(len(self.gltf.nodes), -1)
        for k, node in enumerate(self.gltf.nodes):
            parents[list(node.children or [])] = k
        roots = [k for k in range(len(parents)) if parents[k] < 0]
        if self.gltf.scenes:
            roots = list(self.gltf.scenes[self.gltf.scene or 0].nodes or roots)
        order, waiting = [], roots[::-1]
        while waiting:
            node = waiting.pop()
            order.append(node)
            waiting += list(self.gltf.nodes[node].children or [])[::-1]
            if len(order) > len(parents):
                raise AssetError(f"{self.path}: its nodes form a ring; export it again")
        return parents, np.array(order)

    @staticmethod
    def _parts(node: pygltflib.Node) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return (
            np.array(node.translation or (0.0, 0.0, 0.0), dtype=float),
            np.array(node.rotation or (0.0, 0.0, 0.0, 1.0), dtype=float),
            np.array(node.scale or (1.0, 1.0, 1.0), dtype=float),
        )

    def _ancestor(self, node: int, wanted: dict[int, int]) -> int:
        """Nearest ancestor among the wanted nodes, -1 if there is none."""
        parent = int(self.parents[node])
        while parent >= 0 and parent not in wanted:
            parent = int(self.parents[parent])
        return parent

    def _skin(self, index: int) -> int:
        """First slot of a skin."""
        if index not in self.skin_slots:
            skin = self.gltf.skins[index]
            inverse = np.tile(np.eye(4), (len(skin.joints), 1, 1))
            if skin.inverseBindMatrices is not None:
                inverse = self.buffers.accessor(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
            self.skin_slots[index] = len(self.slots)
            self.slots += list(zip(skin.joints, inverse, strict=False))
        return self.skin_slots[index]

    def _rigid(self, node: int) -> int:
        """Slot of an unskinned mesh: it hangs, by constant transforms, on the nearest node that moves."""
        carrier, constant = node, np.eye(4)
        while carrier not in self.moving and self.parents[carrier] >= 0:
            constant = self.matrices[carrier] @ constant
            carrier = int(self.parents[carrier])
        self.slots.append((carrier, constant))
        return len(self.slots) - 1

    def _meshes(self, node: int) -> list[_Primitive]:
        found = []
        description = self.gltf.nodes[node]
        mesh = self.gltf.meshes[description.mesh]
        for primitive in mesh.primitives:
            if primitive.mode in (0, 1, 2, 3) or primitive.attributes.POSITION is None:
                continue
            vertices = self.buffers.accessor(primitive.attributes.POSITION).astype(np.float64)
            skinned = description.skin is not None and primitive.attributes.JOINTS_0 is not None
            if skinned:
                first = self._skin(description.skin)
                slots, weights = self._skin_weights(primitive)
                slots = slots + first
            else:
                slots, weights = np.full((len(vertices), 1), self._rigid(node)), np.ones((len(vertices), 1))
            texture, uv, factor = self._material(primitive, len(vertices))
            colors = np.tile(factor, (len(vertices), 1))
            if getattr(primitive.attributes, "COLOR_0", None) is not None:
                # Colour factors are linear; textures, and everything here, are coded for display
                colors = colors * np.clip(self.buffers.accessor(primitive.attributes.COLOR_0)[:, :3], 0, 1) ** (1 / 2.2)
            normals = primitive.attributes.NORMAL
            found.append(
                _Primitive(
                    vertices=vertices,
                    normals=np.zeros((len(vertices), 3)) if normals is None else self.buffers.accessor(normals),
                    faces=self._faces(primitive, len(vertices)),
                    uv=uv,
                    colors=colors,
                    texture=texture,
                    slots=slots,
                    weights=weights,
                    morphs=self._morph_targets(node, mesh, primitive),
                )
            )
        return found

    def _skin_weights(self, primitive: pygltflib.Primitive) -> tuple[np.ndarray, np.ndarray]:
        joints, weights, k = [], [], 0
        while getattr(primitive.attributes, f"JOINTS_{k}", None) is not None:
            joints.append(self.buffers.accessor(getattr(primitive.attributes, f"JOINTS_{k}")).astype(np.int64))
            weights.append(self.buffers.accessor(getattr(primitive.attributes, f"WEIGHTS_{k}")))
            k += 1
        all_joints, all_weights = np.concatenate(joints, axis=1), np.concatenate(weights, axis=1).astype(np.float64)
        total = all_weights.sum(axis=1, keepdims=True)
        all_weights[total[:, 0] <= 0, 0] = 1.0
        return all_joints, all_weights / np.where(total > 0, total, 1.0)

    def _faces(self, primitive: pygltflib.Primitive, count: int) -> np.ndarray:
        index = np.arange(count) if primitive.indices is None else self.buffers.accessor(primitive.indices)
        index = index.astype(np.int64)
        if len(index) and index.max() >= count:
            raise AssetError(f"{self.path}: a triangle refers to vertex {index.max()} of {count}; export it again")
        if primitive.mode == 5:  # strip: every other triangle is turned round
            k = np.arange(len(index) - 2)
            odd = k % 2
            return np.stack([index[k], index[k + 1 + odd], index[k + 2 - odd]], axis=1)
        if primitive.mode == 6:  # fan
            k = np.arange(1, len(index) - 1)
            return np.stack([np.full(len(k), index[0]), index[k], index[k + 1]], axis=1)
        return index[: len(index) // 3 * 3].reshape(-1, 3)

    def _material(self, primitive: pygltflib.Primitive, count: int) -> tuple[int, np.ndarray, np.ndarray]:
        """Texture (-1: none), texture coordinates and colour factor of a primitive."""
        none = (-1, np.zeros((count, 2)), np.ones(3))
        if primitive.material is None:
            return none
        pbr = self.gltf.materials[primitive.material].pbrMetallicRoughness
        if pbr is None:
            return none
        factor = np.clip(np.array((pbr.baseColorFactor or (1, 1, 1))[:3], dtype=float), 0, 1) ** (1 / 2.2)
        info = pbr.baseColorTexture
        if info is None or self.gltf.textures[info.index].source is None:
            return -1, none[1], factor
        placed = (info.extensions or {}).get("KHR_texture_transform", {})
        channel = placed.get("texCoord", info.texCoord or 0)
        attribute = getattr(primitive.attributes, f"TEXCOORD_{channel}", None)
        if attribute is None:
            return -1, none[1], factor
        uv = self.buffers.accessor(attribute).astype(np.float64)
        if placed:
            c, s = np.cos(placed.get("rotation", 0.0)), np.sin(placed.get("rotation", 0.0))
            turned = (uv * placed.get("scale", (1, 1))) @ np.array([[c, -s], [s, c]])
            uv = turned + placed.get("offset", (0, 0))
        image = self.gltf.textures[info.index].source
        if image not in self.texture_of_image:
            self.texture_of_image[image] = len(self.textures)
            self.textures.append(self.buffers.image(image))
        return self.texture_of_image[image], uv, factor

    def _morph_targets(self, node: int, mesh: pygltflib.Mesh, primitive: pygltflib.Primitive) -> dict[int, np.ndarray]:
        if not primitive.targets:
            return {}
        if node not in self.morph_start:
            rest = getattr(self.gltf.nodes[node], "weights", None) or mesh.weights or [0.0] * len(primitive.targets)
            self.morph_start[node] = sum(len(w) for _, w in self.morphs)
            self.morphs.append((node, np.array(rest, dtype=float)))
        moved = {}
        for k, target in enumerate(primitive.targets):
            accessor = target.get("POSITION") if isinstance(target, dict) else target.POSITION
            if accessor is not None:
                moved[self.morph_start[node] + k] = self.buffers.accessor(accessor)
        return moved
