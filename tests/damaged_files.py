"""Every reader with a small whole file, and ways to damage it.

`python -m tests.damaged_files SECONDS [READER]` fuzzes each that long.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import pycolmap
import trimesh
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from PIL import Image

from data_tools.calibration_files import (
    read_calibration,
    write_aniposelib,
    write_caliscope,
    write_easymocap,
    write_opencv,
    write_pose2sim,
)
from data_tools.gltf_reader import load_gltf
from geomocap.calibration.observed_points import read_observed
from geomocap.calibration.recording import read_bar_info
from geomocap.errors import GeomocapError
from geomocap.evaluation.other_system import read_matches, read_motion_file
from geomocap.evaluation.truth import Truth
from geomocap.export.bvh import write_bvh
from geomocap.export.markers import markers_from_run
from geomocap.export.names import Names
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.trc import write_trc
from geomocap.files.camera_file import read_camera_doubts
from geomocap.files.capture import read_capture_info
from geomocap.files.check_file import read_self_check
from geomocap.files.corrected_cameras import camera_warnings
from geomocap.files.frame_files import read_points, read_voxels, write_voxels
from geomocap.files.images import image_size, read_image
from geomocap.files.results import (
    read_diagnostics,
    read_ellipsoids,
    read_keypoint_paths,
    read_skeleton,
    read_tracks,
    read_warnings,
    write_skeleton,
)
from geomocap.files.rigs import colmap_model, read_rig, write_rig
from geomocap.files.run import Run
from geomocap.files.scan_settings import ScanSettings
from geomocap.files.scans import open_scans
from geomocap.inspection import describe
from geomocap.keypoints.keypoint_regions import read_keypoints
from geomocap.model.frame_geometry import Voxels
from geomocap.model.rig import Rig
from geomocap.settings import read_settings
from geomocap.subject.subject_model import read_model, write_model
from tests.geomocap.articulated import articulated_skeleton
from tests.geomocap.made_truth import truth_arrays
from tests.geomocap.small_model import small_model
from viz.picture_files import load

TOKENS = [
    b"nan", b"-1", b"0", b"1e400", b"9" * 30, b"[", b"]", b"{", b"}", b'"', b"\n", b"\0", b"\xff", b" ", b"=", b"#",
    b"../../x", b"1000000000000", b"\xff" * 8, b"\x00" * 8, b"<!DOCTYPE x>", b"!!opencv-matrix", b"- ", b"&a", b"*a",
]  # fmt: skip


@dataclass(frozen=True)
class Reader:
    """A reader: `make(folder)` writes whole files and returns the one to damage, `read(file)` reads it."""

    make: Callable[[Path], Path]
    read: Callable[[Path], object]


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


def _text(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return make


def _arrays(name: str, **arrays: object) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        np.savez(folder / name, **arrays)  # not packed, so that numbers are hit
        return folder / name

    return make


def _binary_model(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / "sparse").mkdir(exist_ok=True)
        colmap_model(rig()).write_binary(str(folder / "sparse"))
        return folder / "sparse" / name

    return make


def _text_model(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write_rig(folder / "sparse", rig())
        return folder / "sparse" / name

    return make


def _calibration(write: Callable[[Rig, Path], None], name: str, damaged: str = "") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write(rig(), folder / name)
        return folder / name / damaged

    return make


def _picture(name: str, **options: object) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        y, x = np.mgrid[:40, :56]
        values = np.stack([x * 4, y * 6, (x * y) % 256], axis=-1).astype(np.uint8)
        Image.fromarray(values).save(folder / name, **options)
        return folder / name

    return make


def _deep_picture(folder: Path) -> Path:
    Image.fromarray((np.arange(40 * 56, dtype=np.uint16) * 29).reshape(40, 56)).save(folder / "a.png")
    return folder / "a.png"


def _mesh(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        made = trimesh.creation.icosphere(1).export(file_type=name.partition(".")[2])
        parts = made if isinstance(made, dict) else {name: made}
        for part, data in parts.items():
            (folder / (name if part == "model.gltf" else part)).write_bytes(
                data.encode() if isinstance(data, str) else data
            )
        return folder / name

    return make


def _cloud(name: str, **options: object) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        points = np.random.default_rng(0).normal(size=(40, 3))
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        o3d.io.write_point_cloud(str(folder / name), cloud, **options)
        return folder / name

    return make


def _voxels(folder: Path) -> Path:
    index = np.argwhere(np.ones((4, 4, 4), bool)).astype(np.int32)
    write_voxels(folder / "a.ply", Voxels.sorted(index, np.full((64, 3), 128, np.uint8), np.zeros(3), 0.1))
    return folder / "a.ply"


def _skeleton(folder: Path) -> Path:
    write_skeleton(Run(folder), articulated_skeleton())
    return folder / "skeleton.npz"


def _model(folder: Path) -> Path:
    write_model(folder / "model.npz", small_model())
    return folder / "model.npz"


def _truth(folder: Path) -> Path:
    np.savez(folder / "truth.npz", **truth_arrays(4))
    return folder / "truth.npz"


def _bvh(folder: Path) -> Path:
    write_bvh(folder / "m.bvh", motion_from_skeleton(articulated_skeleton(n_frames=5)))
    return folder / "m.bvh"


def _trc(folder: Path) -> Path:
    write_trc(folder / "m.trc", markers_from_run(articulated_skeleton(n_frames=5)))
    return folder / "m.trc"


def _c3d(folder: Path) -> Path:
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


def _of_run(read: Callable[[Run], object]) -> Callable[[Path], object]:
    return lambda file: read(Run(file.parent))


def _scan(file: Path) -> object:
    scans = open_scans(file, ScanSettings(samples=50))
    return [scans.points(k) for k in range(len(scans))]


def _both(file: Path) -> object:
    image_size(file)
    return read_image(file)


def _describe_and_read(file: Path) -> object:
    describe(file)
    return read_motion_file(file)


_QUALISYS = '<calibration><cameras>' + "".join(
    f'<camera active="1" serial="c{k}" viewrotation="0"><fov_video left="0" top="0" right="319" bottom="239"/>'
    f'<transform x="{x}" y="{y}" z="0" r11="{c}" r12="{s}" r13="0" r21="0" r22="0" r23="1" '
    f'r31="{s}" r32="{-c}" r33="0"/>'
    '<intrinsic focalLengthU="19200" focalLengthV="19200" centerPointU="10240" centerPointV="7680" skew="0" '
    'radialDistortion1="0" radialDistortion2="0" radialDistortion3="0" '
    'tangentalDistortion1="0" tangentalDistortion2="0"/>'
    "</camera>"
    for k, (x, y, c, s) in enumerate([(0, -3000, 1, 0), (3000, 0, 0, 1)])
) + "</cameras></calibration>"  # fmt: skip
_KEYPOINT = '[[keypoint]]\nname = "a"\ncenter = [0.0, 0.1, 1.2]\nradius = 0.2\nframe = 0\n'
_CHECK = {"cameras": ["a"], "frames": [0, 1], "model": [[0.9, 0.8]], "left_out": [[0.9, None]], "residual": 0.01}
_N, _T = 6, 5
_RNG = np.random.default_rng(1)
_TURNS = np.tile(np.eye(3), (_T, 2, 1, 1))

READERS: dict[str, Reader] = {
    "capture.toml": Reader(
        _text("capture.toml", 'name = "x"\nfps = 30.0\nup = "z"\ncameras = ["a", "b"]\nframes = [0, 4]\n'),
        lambda file: read_capture_info(file.parent),
    ),
    "settings": Reader(_text("s.toml", "[carving]\nresolution = 64\n"), read_settings),
    "names": Reader(_text("names.toml", "a = 0\n[joints]\nk = 1\n"), Names.read),
    "key-points": Reader(_text("keypoints.toml", _KEYPOINT), read_keypoints),
    "bar": Reader(_text("bar.toml", "length = 0.5\nfloor = [1, 2]\n"), read_bar_info),
    "matches": Reader(_text("m.toml", 'joint_a = "LKNE"\n'), read_matches),
    "points.csv": Reader(_text("p.csv", "frame,camera,point,x,y\n0,a,0,1.5,2.5\n1,b,1,3,4\n"), read_observed),
    "check.json": Reader(_text("check.json", json.dumps(_CHECK)), _of_run(read_self_check)),
    "correction.json": Reader(
        _text("correction.json", '{"disagreement_px": 9.5, "left_px": 1.5, "corrected": true}'),
        _of_run(camera_warnings),
    ),
    "cameras.json": Reader(
        _text("cameras.json", '{"contradicting": ["a"], "left_out": [], "warnings": ["b"]}'),
        _of_run(read_camera_doubts),
    ),
    "diagnostics.json": Reader(_text("diagnostics.json", '{"warnings": ["a"]}'), _of_run(read_warnings)),
    "cameras.bin": Reader(_binary_model("cameras.bin"), lambda file: read_rig(file.parent)),
    "images.bin": Reader(_binary_model("images.bin"), lambda file: read_rig(file.parent)),
    "cameras.txt": Reader(_text_model("cameras.txt"), lambda file: read_rig(file.parent)),
    "images.txt": Reader(_text_model("images.txt"), lambda file: read_rig(file.parent)),
    "aniposelib": Reader(_calibration(write_aniposelib, "c.toml"), read_calibration),
    "caliscope": Reader(_calibration(write_caliscope, "c.toml"), read_calibration),
    "pose2sim": Reader(_calibration(write_pose2sim, "c.toml"), read_calibration),
    "opencv": Reader(_calibration(write_opencv, "c", "cam1.yml"), lambda file: read_calibration(file.parent)),
    "easymocap": Reader(_calibration(write_easymocap, "c", "extri.yml"), lambda file: read_calibration(file.parent)),
    "qualisys": Reader(_text("c.qca.txt", _QUALISYS), read_calibration),
    "png": Reader(_picture("a.png"), _both),
    "png of 16 bits": Reader(_deep_picture, _both),
    "jpg": Reader(_picture("a.jpg", quality=90), _both),
    "progressive jpg": Reader(_picture("b.jpg", progressive=True), _both),
    "bmp": Reader(_picture("a.bmp"), _both),
    "skeleton.npz": Reader(_skeleton, _of_run(read_skeleton)),
    "ellipsoids.npz": Reader(
        _arrays("ellipsoids.npz", centers=np.ones((_T, 2, 3)), radii=np.ones((_T, 2, 3)), rotations=_TURNS),
        _of_run(read_ellipsoids),
    ),
    "tracks.npz": Reader(
        _arrays("tracks.npz", positions=_RNG.normal(size=(_N, _T, 3)), velocities=np.zeros((_N, _T, 3))),
        _of_run(read_tracks),
    ),
    "ragged tracks.npz": Reader(
        _arrays(
            "tracks.npz",
            layout="ragged",
            positions=_RNG.normal(size=(7, 3)),
            velocities=np.zeros((7, 3)),
            first=np.array([0, 3, 7]),
            start=np.array([0, 1]),
            end=np.array([2, 4]),
            n_frames=_T,
        ),
        _of_run(read_tracks),
    ),
    "keypoints.npz": Reader(
        _arrays("keypoints.npz", names=np.array(["a", "b"]), positions=np.ones((_T, 2, 3)), radius=np.ones(2)),
        _of_run(read_keypoint_paths),
    ),
    "diagnostics.npz": Reader(
        _arrays("diagnostics.npz", paths="nodes", sample_positions=np.ones((_N, _T, 3)), sample_body=np.zeros(_N, int)),
        _of_run(read_diagnostics),
    ),
    "model.npz": Reader(_model, read_model),
    "truth.npz": Reader(_truth, Truth.read),
    "bvh": Reader(_bvh, _describe_and_read),
    "trc": Reader(_trc, _describe_and_read),
    "c3d": Reader(_c3d, _describe_and_read),
    "voxels.ply": Reader(_voxels, read_voxels),
    "points.ply": Reader(_cloud("a.ply"), read_points),
    "scan.npz": Reader(_arrays("s.npz", points=_RNG.normal(size=(3, 30, 3))), _scan),
    **{f"scan.{e}": Reader(_mesh(f"a.{e}"), _scan) for e in ("obj", "stl", "off", "glb", "gltf")},
    **{f"scan.{e}": Reader(_cloud(f"a.{e}"), _scan) for e in ("pcd", "pts", "xyz")},
    "scan of text.ply": Reader(_cloud("a.ply", write_ascii=True), _scan),
    "scan of packed.pcd": Reader(_cloud("a.pcd", compressed=True), _scan),
    "scan of text.pcd": Reader(_cloud("a.pcd", write_ascii=True), _scan),
    "picture of mesh.ply": Reader(_mesh("a.ply"), load),
    "picture of.obj": Reader(_mesh("a.obj"), load),
    "picture of.off": Reader(_mesh("a.off"), load),
    "picture of.glb": Reader(_mesh("a.glb"), load),
    "animation.glb": Reader(_mesh("a.glb"), load_gltf),
}


@st.composite
def damages(draw: st.DrawFn) -> list[tuple[str, float, object]]:
    """Draw some damages: what, where (fraction of the file) and with what."""
    kinds = {
        "cut": st.none(),
        "flip": st.integers(0, 7),
        "byte": st.integers(0, 255),
        "put": st.sampled_from(TOKENS),
        "over": st.sampled_from(TOKENS),
        "zero": st.integers(1, 64),
        "drop": st.integers(1, 64),
        "double": st.integers(1, 200),
    }
    names = draw(st.lists(st.sampled_from(sorted(kinds)), min_size=1, max_size=4))
    return [(name, draw(st.floats(0, 1, exclude_max=True)), draw(kinds[name])) for name in names]


def damaged(data: bytes, done: list[tuple[str, float, object]]) -> bytes:
    """Do damages to the bytes of a file."""
    for name, where, how in done:
        at, got = int(where * len(data)), bytearray(data)
        match name, how:
            case "cut", _:
                got = got[:at]
            case "flip", int() if at < len(got):
                got[at] ^= 1 << how
            case "byte", int() if at < len(got):
                got[at] = how
            case "put", bytes():
                got[at:at] = how
            case "over", bytes():
                got[at : at + len(how)] = how
            case "zero", int():
                got[at : at + how] = bytes(len(got[at : at + how]))
            case "drop", int():
                del got[at : at + how]
            case "double", int():
                got[at:at] = got[at : at + how]
        data = bytes(got)
    return data


def survives(reader: Reader, file: Path, data: bytes) -> str:
    """Read damaged bytes: "" if something was read, else the error's line.

    Anything else than one clear line that names a file or what is in it is raised.
    """
    file.write_bytes(data)
    try:
        reader.read(file)
    except GeomocapError as error:
        said = str(error)
        assert said and "\n" not in said and len(said) < 2000, said
        assert "Traceback" not in said and "site-packages" not in said and "0x7f" not in said, said
        return said
    return ""


def fuzz(name: str, seconds: float) -> int:
    """Damage a reader's file for some seconds and return how often; the first failure is shrunk and raised."""
    reader, end, count = READERS[name], time.monotonic() + seconds, 0
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        file = reader.make(Path(folder))
        whole = file.read_bytes()
        assert survives(reader, file, whole) == ""
        while time.monotonic() < end:

            @seed(count)
            @settings(max_examples=200, deadline=None, database=None, suppress_health_check=list(HealthCheck))
            @given(damages())
            def once(done: list[tuple[str, float, object]]) -> None:
                survives(reader, file, damaged(whole, done))

            once()
            count += 200
    return count


def main() -> None:
    chosen = sys.argv[2:] or list(READERS)
    for name in chosen:
        print(name, fuzz(name, float(sys.argv[1])), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
