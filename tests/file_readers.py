"""Every reader with a small whole file of its kind."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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
from geomocap.evaluation.other_system import read_matches, read_motion_file
from geomocap.evaluation.truth import Truth
from geomocap.export.names import Names
from geomocap.files.camera_file import read_camera_doubts
from geomocap.files.capture import read_capture_info
from geomocap.files.check_file import read_self_check
from geomocap.files.corrected_cameras import camera_warnings
from geomocap.files.frame_files import read_points, read_voxels
from geomocap.files.images import image_size, read_image
from geomocap.files.results import (
    read_diagnostics,
    read_ellipsoids,
    read_keypoint_paths,
    read_skeleton,
    read_tracks,
    read_warnings,
)
from geomocap.files.rigs import read_rig
from geomocap.files.run import Run
from geomocap.files.scan_settings import ScanSettings
from geomocap.files.scans import open_scans
from geomocap.files.videos import Video
from geomocap.inspection import describe
from geomocap.keypoints.keypoint_regions import read_keypoints
from geomocap.settings import read_settings
from geomocap.subject.subject_model import read_model
from tests import small_files as small
from viz.picture_files import load


@dataclass(frozen=True)
class Reader:
    """A reader: `make(folder)` writes whole files and returns the one to damage, `read(file)` reads it."""

    make: Callable[[Path], Path]
    read: Callable[[Path], object]


def _of_run(read: Callable[[Run], object]) -> Callable[[Path], object]:
    return lambda file: read(Run(file.parent))


def _scan(file: Path) -> object:
    scans = open_scans(file, ScanSettings(samples=50))
    return [scans.points(k) for k in range(len(scans))]


def _both(file: Path) -> object:
    image_size(file)
    return read_image(file)


def _frames(file: Path) -> object:
    video = Video(file)
    return [video.read(k) for k in range(min(len(video), 10))]


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

_RECORD = '[geomocap]\nentries = 6\n[source]\nkind = "capture"\npath = "a"\nfps = 30.0\nup = "z"\n[config]\na = 1\n'
_STAGE = {"key": "k", "done": True, "outputs": ["b"], "files": {"b": [1, 2, 3]}}
_TIMING = {"seconds": 1.5, "items": 3, "items_per_second": 2.0}

READERS: dict[str, Reader] = {
    "run.toml": Reader(
        small.text("run.toml", _RECORD),
        _of_run(Run.read_record),
    ),
    "timings.json": Reader(small.text("timings.json", json.dumps({"a": _TIMING})), _of_run(Run.read_timings)),
    "stage record": Reader(
        small.text(".stages/a.json", json.dumps(_STAGE)),
        lambda file: Run(file.parent.parent).faults(),
    ),
    "stage journal": Reader(small.stage_journal, lambda file: Run(file.parent.parent).sound("a")),
    "capture.toml": Reader(
        small.text("capture.toml", 'name = "x"\nfps = 30.0\nup = "z"\ncameras = ["a", "b"]\nframes = [0, 4]\n'),
        lambda file: read_capture_info(file.parent),
    ),
    "settings": Reader(small.text("s.toml", "[carving]\nresolution = 64\n"), read_settings),
    "names": Reader(small.text("names.toml", "a = 0\n[joints]\nk = 1\n"), Names.read),
    "key-points": Reader(small.text("keypoints.toml", _KEYPOINT), read_keypoints),
    "bar": Reader(small.text("bar.toml", "length = 0.5\nfloor = [1, 2]\n"), read_bar_info),
    "matches": Reader(small.text("m.toml", 'joint_a = "LKNE"\n'), read_matches),
    "points.csv": Reader(small.text("p.csv", "frame,camera,point,x,y\n0,a,0,1.5,2.5\n1,b,1,3,4\n"), read_observed),
    "check.json": Reader(small.text("check.json", json.dumps(_CHECK)), _of_run(read_self_check)),
    "correction.json": Reader(
        small.text("correction.json", '{"disagreement_px": 9.5, "left_px": 1.5, "corrected": true}'),
        _of_run(camera_warnings),
    ),
    "cameras.json": Reader(
        small.text("cameras.json", '{"contradicting": ["a"], "left_out": [], "warnings": ["b"]}'),
        _of_run(read_camera_doubts),
    ),
    "diagnostics.json": Reader(small.text("diagnostics.json", '{"warnings": ["a"]}'), _of_run(read_warnings)),
    "cameras.bin": Reader(small.binary_model("cameras.bin"), lambda file: read_rig(file.parent)),
    "images.bin": Reader(small.binary_model("images.bin"), lambda file: read_rig(file.parent)),
    "cameras.txt": Reader(small.text_model("cameras.txt"), lambda file: read_rig(file.parent)),
    "images.txt": Reader(small.text_model("images.txt"), lambda file: read_rig(file.parent)),
    "aniposelib": Reader(small.calibration(write_aniposelib, "c.toml"), read_calibration),
    "caliscope": Reader(small.calibration(write_caliscope, "c.toml"), read_calibration),
    "pose2sim": Reader(small.calibration(write_pose2sim, "c.toml"), read_calibration),
    "opencv": Reader(small.calibration(write_opencv, "c", "cam1.yml"), lambda file: read_calibration(file.parent)),
    "easymocap": Reader(
        small.calibration(write_easymocap, "c", "extri.yml"), lambda file: read_calibration(file.parent)
    ),
    "qualisys": Reader(small.text("c.qca.txt", _QUALISYS), read_calibration),
    "png": Reader(small.picture("a.png"), _both),
    "png of 16 bits": Reader(small.deep_picture, _both),
    "jpg": Reader(small.picture("a.jpg", quality=90), _both),
    "progressive jpg": Reader(small.picture("b.jpg", progressive=True), _both),
    "bmp": Reader(small.picture("a.bmp"), _both),
    **{
        f"video.{e}": Reader(small.video(f"a.{e}", codec), _frames)
        for e, codec in (("mp4", "libx264"), ("avi", "mpeg4"), ("mkv", "libx264"), ("webm", "libvpx"), ("mov", "mjpeg"))
    },
    "skeleton.npz": Reader(small.skeleton, _of_run(read_skeleton)),
    "ellipsoids.npz": Reader(
        small.arrays("ellipsoids.npz", centers=np.ones((_T, 2, 3)), radii=np.ones((_T, 2, 3)), rotations=_TURNS),
        _of_run(read_ellipsoids),
    ),
    "tracks.npz": Reader(
        small.arrays("tracks.npz", positions=_RNG.normal(size=(_N, _T, 3)), velocities=np.zeros((_N, _T, 3))),
        _of_run(read_tracks),
    ),
    "ragged tracks.npz": Reader(
        small.arrays(
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
        small.arrays("keypoints.npz", names=np.array(["a", "b"]), positions=np.ones((_T, 2, 3)), radius=np.ones(2)),
        _of_run(read_keypoint_paths),
    ),
    "diagnostics.npz": Reader(
        small.arrays(
            "diagnostics.npz", paths="nodes", sample_positions=np.ones((_N, _T, 3)), sample_body=np.zeros(_N, int)
        ),
        _of_run(read_diagnostics),
    ),
    "model.npz": Reader(small.model, read_model),
    "truth.npz": Reader(small.truth, Truth.read),
    "bvh": Reader(small.bvh, _describe_and_read),
    "trc": Reader(small.trc, _describe_and_read),
    "c3d": Reader(small.c3d, _describe_and_read),
    "voxels.ply": Reader(small.voxels, read_voxels),
    "points.ply": Reader(small.cloud("a.ply"), read_points),
    "bodies.ply": Reader(small.bodies, read_points),
    "scan.npz": Reader(small.arrays("s.npz", points=_RNG.normal(size=(3, 30, 3))), _scan),
    **{f"scan.{e}": Reader(small.mesh(f"a.{e}"), _scan) for e in ("obj", "stl", "off", "glb", "gltf")},
    **{f"scan.{e}": Reader(small.cloud(f"a.{e}"), _scan) for e in ("pcd", "pts", "xyz")},
    "scan of text.ply": Reader(small.cloud("a.ply", write_ascii=True), _scan),
    "scan of packed.pcd": Reader(small.cloud("a.pcd", compressed=True), _scan),
    "scan of text.pcd": Reader(small.cloud("a.pcd", write_ascii=True), _scan),
    "picture of mesh.ply": Reader(small.mesh("a.ply"), load),
    "picture of.obj": Reader(small.mesh("a.obj"), load),
    "picture of.off": Reader(small.mesh("a.off"), load),
    "picture of.glb": Reader(small.mesh("a.glb"), load),
    "animation.glb": Reader(small.mesh("a.glb"), load_gltf),
}
