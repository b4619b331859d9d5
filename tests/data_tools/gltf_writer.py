"""Writes small glTF files for tests, byte by byte, without the library that reads them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

TYPES = {"u1": 5121, "i1": 5120, "u2": 5123, "i2": 5122, "u4": 5125, "f4": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class GltfWriter:
    def __init__(self) -> None:
        self.data = b""
        self.document: dict = {
            "asset": {"version": "2.0"},
            "bufferViews": [],
            "accessors": [],
            "nodes": [],
            "meshes": [],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        }

    def view(self, data: bytes, stride: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        if stride:
            view["byteStride"] = stride
        self.document["bufferViews"].append(view)
        self.data += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values, kind: str = "f4", *, normalized: bool = False, padding: int = 0) -> int:
        array = np.asarray(values, dtype="<" + kind)
        flat = array.reshape(len(array), -1)
        rows = b"".join(row.tobytes() + b"\xaa" * padding for row in flat)
        stride = flat.itemsize * flat.shape[1] + padding if padding else None
        return self.entry(
            bufferView=self.view(rows, stride),
            componentType=TYPES[kind],
            count=len(flat),
            type=SHAPES[flat.shape[1]],
            normalized=normalized,
        )

    def entry(self, **accessor) -> int:
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def animate(self, node: int, path: str, times, values, interpolation: str = "LINEAR", name: str = "move") -> None:
        animations = self.document.setdefault("animations", [])
        animation = next((a for a in animations if a["name"] == name), None)
        if animation is None:
            animation = {"name": name, "channels": [], "samplers": []}
            animations.append(animation)
        values = np.asarray(values, dtype=float)
        sampler = {
            "input": self.accessor(np.asarray(times, dtype=float)),
            "output": self.accessor(values),
            "interpolation": interpolation,
        }
        animation["samplers"].append(sampler)
        animation["channels"].append(
            {"sampler": len(animation["samplers"]) - 1, "target": {"node": node, "path": path}}
        )

    def write(self, path: Path) -> Path:
        """Write .gltf with its .bin beside it."""
        binary = path.with_suffix(".bin")
        binary.write_bytes(self.data)
        self.document["buffers"] = [{"byteLength": len(self.data), "uri": binary.name}]
        path.write_text(json.dumps(self.document))
        return path

    def write_glb(self, path: Path) -> Path:
        self.data += b"\0" * (-len(self.data) % 4)
        self.document["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        chunks = len(text).to_bytes(4, "little") + b"JSON" + text
        chunks += len(self.data).to_bytes(4, "little") + b"BIN\0" + self.data
        path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks)
        return path
