"""Small whole files of every kind that is read, for tests that damage them: `make(folder)` writes and returns one."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import open3d as o3d
import pycolmap
import trimesh
from PIL import Image

from geomocap.export.bvh import write_bvh
from geomocap.export.markers import markers_from_run
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.trc import write_trc
from geomocap.files.frame_files import write_points, write_voxels
from geomocap.files.results import (
    write_skeleton,
)
from geomocap.files.rigs import colmap_model, write_rig
from geomocap.files.run import Run
from geomocap.model.frame_geometry import BodyPoints, Voxels
from geomocap.model.rig import Rig
from geomocap.subject.subject_model import write_model
from tests.geomocap.articulated import articulated_skeleton
from tests.geomocap.made_truth import truth_arrays
from tests.geomocap.small_model import small_model


def rig(count: int = 3) -> Rig:
    """Cameras in a circle that look at its middle."""
    cameras, poses = [], []
    for k in range(count):
        angle = 2 * np.pi * k / count
        center = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.2])
        z = -center / np.linalg.norm(center)
        x = np.cross([0.0, 0, -1], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        params = [300, 302, 161, 119, -0.1, 0.02, 1e-4, 1e-4]
        cameras.append(pycolmap.Camera(model="OPENCV", width=320, height=240, params=params))
        poses.append(np.column_stack([R, -R @ center]))
    return Rig(tuple(f"cam{k}" for k in range(count)), tuple(cameras), np.array(poses))


def text(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
        return folder / name

    return make


def stage_journal(folder: Path) -> Path:
    """A stage under way that has noted two files."""
    run = Run(folder)
    run.begin("a", "key", ["b"])
    for name in ("b", "c"):
        (folder / name).write_text(name)
        run.note("a", [folder / name])
    return folder / ".stages" / "a.journal"


def video(name: str, codec: str) -> Callable[[Path], Path]:
    """A film of six frames, 48×32."""

    def make(folder: Path) -> Path:
        y, x = np.mgrid[:32, :48]
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=10)
            stream.width, stream.height, stream.pix_fmt = 48, 32, "yuvj420p" if codec == "mjpeg" else "yuv420p"
            for k in range(6):
                values = np.stack([x * 5, y * 7, (x * (y + k)) % 256], axis=-1).astype(np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(values, format="rgb24")))
            container.mux(stream.encode())
        return folder / name

    return make


def arrays(name: str, **arrays: object) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        np.savez(folder / name, **arrays)  # not packed, so that numbers are hit
        return folder / name

    return make


def binary_model(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / "sparse").mkdir(exist_ok=True)
        colmap_model(rig()).write_binary(str(folder / "sparse"))
        return folder / "sparse" / name

    return make


def text_model(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write_rig(folder / "sparse", rig())
        return folder / "sparse" / name

    return make


def calibration(write: Callable[[Rig, Path], None], name: str, damaged: str = "") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write(rig(), folder / name)
        return folder / name / damaged

    return make


def picture(name: str, **options: object) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        y, x = np.mgrid[:40, :56]
        values = np.stack([x * 4, y * 6, (x * y) % 256], axis=-1).astype(np.uint8)
        Image.fromarray(values).save(folder / name, **options)
        return folder / name

    return make


def deep_picture(folder: Path) -> Path:
    Image.fromarray((np.arange(40 * 56, dtype=np.uint16) * 29).reshape(40, 56)).save(folder / "a.png")
    return folder / "a.png"


def mesh(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        made = trimesh.creation.icosphere(1).export(file_type=name.partition(".")[2])
        parts = made if isinstance(made, dict) else {name: made}
        for part, data in parts.items():
            (folder / (name if part == "model.gltf" else part)).write_bytes(
                data.encode() if isinstance(data, str) else data
            )
        return folder / name

    return make


def cloud(name: str, **options: object) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        points = np.random.default_rng(0).normal(size=(40, 3))
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        o3d.io.write_point_cloud(str(folder / name), cloud, **options)
        return folder / name

    return make


def bodies(folder: Path) -> Path:
    """A cloud with bodies, colours and normals."""
    draw = np.random.default_rng(0)
    colors, normals = draw.integers(0, 256, (40, 3)).astype(np.uint8), draw.normal(size=(40, 3))
    write_points(folder / "a.ply", BodyPoints(draw.normal(size=(40, 3)), np.arange(40) % 3, colors, normals))
    return folder / "a.ply"


def voxels(folder: Path) -> Path:
    index = np.argwhere(np.ones((4, 4, 4), bool)).astype(np.int32)
    write_voxels(folder / "a.ply", Voxels.sorted(index, np.full((64, 3), 128, np.uint8), np.zeros(3), 0.1))
    return folder / "a.ply"


def skeleton(folder: Path) -> Path:
    write_skeleton(Run(folder), articulated_skeleton())
    return folder / "skeleton.npz"


def model(folder: Path) -> Path:
    write_model(folder / "model.npz", small_model())
    return folder / "model.npz"


def truth(folder: Path) -> Path:
    np.savez(folder / "truth.npz", **truth_arrays(4))
    return folder / "truth.npz"


def bvh(folder: Path) -> Path:
    write_bvh(folder / "m.bvh", motion_from_skeleton(articulated_skeleton(n_frames=5)))
    return folder / "m.bvh"


def trc(folder: Path) -> Path:
    write_trc(folder / "m.trc", markers_from_run(articulated_skeleton(n_frames=5)))
    return folder / "m.trc"


def c3d(folder: Path) -> Path:
    """A C3D of 4 frames of 3 points, floats, as the format's guide has it."""

    def parameter(group: int, name: bytes, kind: int, shape: list[int], data: bytes) -> bytes:
        body = struct.pack("bB", kind, len(shape)) + bytes(shape) + data + b"\0"
        return struct.pack("bb", len(name), group) + name + struct.pack("<H", len(body) + 2) + body

    section = b"\0\0\1\x54" + struct.pack("bb", 5, -1) + b"POINT" + struct.pack("<H", 3) + b"\0"
    section += parameter(1, b"USED", 2, [], struct.pack("<h", 3)) + parameter(1, b"SCALE", 4, [], struct.pack("<f", -1))
    section += parameter(1, b"DATA_START", 2, [], struct.pack("<h", 3)) + parameter(1, b"RATE", 4, [], b"\0\0\xf0\x41")
    section += parameter(1, b"FRAMES", 2, [], struct.pack("<h", 4)) + parameter(1, b"UNITS", -1, [2], b"mm")
    section += parameter(1, b"LABELS", -1, [2, 3], b"a b c ") + b"\0\0"
    header = struct.pack("<BBHHHHHfHHf", 2, 0x50, 3, 0, 1, 4, 0, -1.0, 3, 0, 30.0)
    points = np.zeros((4, 3, 4), "<f4")
    points[..., :3] = np.random.default_rng(0).normal(size=(4, 3, 3)) * 500
    (folder / "m.c3d").write_bytes(header.ljust(512, b"\0") + section.ljust(512, b"\0") + points.tobytes())
    return folder / "m.c3d"
