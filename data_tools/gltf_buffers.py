"""The binary side of glTF files: accessors and images, wherever their bytes are kept."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pygltflib

from data_tools.asset import AssetError
from geomocap.errors import CaptureError
from geomocap.files.array_schema import quiet_nan
from geomocap.files.images import decode_image
from geomocap.reading import read_bytes

COMPONENT_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
MOST_ELEMENTS = 1 << 26  # of an accessor; vertices of the largest meshes are a tenth of that
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(frozen=True)
class GltfBuffers:
    """Access to what a glTF file refers to by number.

    Attributes
    ----------
    path : Path
        Of the .gltf or .glb file; other files are read from its folder only.
    gltf : pygltflib.GLTF2
    """

    path: Path
    gltf: pygltflib.GLTF2
    _loaded: dict[int, bytes] = field(default_factory=dict, repr=False)

    def accessor(self, index: int) -> np.ndarray:
        """Read an accessor: (count, components) or (count,), float64 if float or normalised, else integer.

        Strides and sparse accessors are followed (glTF 2.0 specification, section 3.6.2).
        """
        accessor = self.gltf.accessors[index]
        kind, width = np.dtype(COMPONENT_TYPES[accessor.componentType]), COMPONENTS[accessor.type]
        if not 0 <= accessor.count <= MOST_ELEMENTS:
            raise AssetError(f"{self.path}: an accessor claims {accessor.count:,} elements; the file is damaged")
        if accessor.bufferView is None:
            values = np.zeros((accessor.count, width), dtype=kind)
        else:
            values = self._elements(accessor.bufferView, accessor.byteOffset or 0, accessor.count, kind, width).copy()
        if accessor.sparse is not None:
            s = accessor.sparse
            where_kind = np.dtype(COMPONENT_TYPES[s.indices.componentType])
            where = self._elements(s.indices.bufferView, s.indices.byteOffset or 0, s.count, where_kind, 1)
            values[where[:, 0]] = self._elements(s.values.bufferView, s.values.byteOffset or 0, s.count, kind, width)
        if kind.kind == "f":
            values = quiet_nan(values).astype(np.float64)
        elif accessor.normalized:
            # Section 3.6.2.2: signed integers have one value more below zero, which also means -1
            values = np.maximum(values.astype(np.float64) / np.iinfo(kind.str).max, -1.0)
        return values[:, 0] if width == 1 else values

    def image(self, index: int) -> np.ndarray:
        """Decode an image: (H, W, 3) uint8, RGB."""
        image = self.gltf.images[index]
        if image.bufferView is not None:
            view = self.gltf.bufferViews[image.bufferView]
            start = view.byteOffset or 0
            data = self._buffer(view.buffer)[start : start + view.byteLength]
        else:
            data = self._uri(image.uri)
        try:
            return decode_image(data, f"{self.path}: image {index} ({image.name or image.uri or 'embedded'})")
        except CaptureError as error:
            raise AssetError(str(error)) from None

    def _elements(self, view_index: int, offset: int, count: int, kind: np.dtype, width: int) -> np.ndarray:
        view = self.gltf.bufferViews[view_index]
        data = self._buffer(view.buffer)
        start = (view.byteOffset or 0) + offset
        stride = view.byteStride or kind.itemsize * width
        if count and start + (count - 1) * stride + kind.itemsize * width > len(data):
            raise AssetError(f"{self.path}: an accessor reads beyond its buffer; the file is cut off")
        little = kind.newbyteorder("<")
        return np.ndarray((count, width), dtype=little, buffer=data, offset=start, strides=(stride, kind.itemsize))

    def _buffer(self, index: int) -> bytes:
        if index not in self._loaded:
            uri = self.gltf.buffers[index].uri
            self._loaded[index] = self._uri(uri) if uri else bytes(self.gltf.binary_blob() or b"")
        return self._loaded[index]

    def _uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.split(",", 1)[1])
        folder = self.path.parent.resolve()
        file = (folder / unquote(uri)).resolve()
        if not file.is_relative_to(folder):
            raise AssetError(f"{self.path}: refers to {uri}, outside its own folder; copy that file beside it")
        try:
            return read_bytes(file)
        except OSError as error:
            raise AssetError(f"{file}: can't be read ({error.strerror}); {self.path.name} needs it") from None
