"""A small run and capture of a stick figure that waves, made here: six frames, three cameras, 160 × 120."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pycolmap
import pytest

from geomocap.files.capture import Capture, CaptureInfo, write_capture_info
from geomocap.files.frame_files import write_voxels
from geomocap.files.rigs import write_rig
from geomocap.files.run import Run
from geomocap.model.frame_geometry import Voxels
from geomocap.model.rig import Rig
from viz.body_colors import body_colors
from viz.viewpoints import look

UP = np.array([0.0, 0.0, 1.0])
# body, parent, joint relative to the parent's joint (m), limb from the joint (m), radius (m), swing (rad)
LIMBS = [
    ("trunk", -1, (0, 0, 0.95), (0, 0, 0.50), 0.13, 0.0),
    ("head", 0, (0, 0, 0.56), (0, 0, 0.20), 0.09, 0.2),
    ("arm_l", 0, (0.19, 0, 0.48), (0.05, 0, -0.28), 0.05, 0.7),
    ("forearm_l", 2, (0.05, 0, -0.30), (0.02, 0, -0.28), 0.04, 0.6),
    ("arm_r", 0, (-0.19, 0, 0.48), (-0.05, 0, -0.28), 0.05, -0.7),
    ("forearm_r", 4, (-0.05, 0, -0.30), (-0.02, 0, -0.28), 0.04, 0.6),
    ("thigh_l", 0, (0.10, 0, -0.04), (0.01, 0, -0.40), 0.075, -0.5),
    ("shin_l", 6, (0.01, 0, -0.43), (0, 0, -0.42), 0.055, -0.4),
    ("thigh_r", 0, (-0.10, 0, -0.04), (-0.01, 0, -0.40), 0.075, 0.5),
    ("shin_r", 8, (-0.01, 0, -0.43), (0, 0, -0.42), 0.055, -0.4),
]


@dataclass(frozen=True)
class Figure:
    """The figure's bodies over time."""

    rotations: np.ndarray  # (T, B, 3, 3)
    joints: np.ndarray  # (T, B, 3): the joint to the parent; the trunk's own origin
    ends: np.ndarray  # (T, B, 3)

    def points(self, frame: int, count: int = 700) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(frame)
        points, bodies = [], []
        for b, limb in enumerate(LIMBS):
            a, e = self.joints[frame, b], self.ends[frame, b]
            axis = e - a
            s = rng.uniform(-limb[4] / np.linalg.norm(axis), 1 + limb[4] / np.linalg.norm(axis), count)
            core = a + np.clip(s, 0, 1)[:, None] * axis
            n = rng.normal(size=(count, 3))
            along = axis / np.linalg.norm(axis)
            n -= np.where((s > 0) & (s < 1), n @ along, 0.0)[:, None] * along
            points.append(core + limb[4] * n / np.linalg.norm(n, axis=1, keepdims=True))
            bodies.append(np.full(count, b))
        return np.concatenate(points), np.concatenate(bodies)


def rotation_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def make_figure(n_frames: int) -> Figure:
    T, B = n_frames, len(LIMBS)
    rotations, joints, ends = np.zeros((T, B, 3, 3)), np.zeros((T, B, 3)), np.zeros((T, B, 3))
    for t in range(T):
        phase = 2 * np.pi * t / 30
        for b, (_, parent, offset, limb, _, swing) in enumerate(LIMBS):
            own = rotation_x(swing * np.sin(phase) if parent <= 0 else swing * (0.5 - 0.5 * np.cos(phase)))
            if parent < 0:
                rotations[t, b] = np.eye(3)
                joints[t, b] = np.array(offset) + np.array([0, 0.02 * t, 0.02 * np.sin(2 * phase)])
            else:
                rotations[t, b] = rotations[t, parent] @ own
                joints[t, b] = joints[t, parent] + rotations[t, parent] @ np.array(offset)
            ends[t, b] = joints[t, b] + rotations[t, b] @ np.array(limb)
    return Figure(rotations, joints, ends)


def make_rig(count: int, width: int, height: int) -> Rig:
    poses, cameras = [], []
    for c in range(count):
        angle = 2 * np.pi * c / count + 0.3
        eye = np.array([3.6 * np.cos(angle), 3.6 * np.sin(angle), 1.3 + 0.5 * (c % 2)])
        poses.append(look(eye, np.array([0, 0, 0.85]), UP))
        focal = 1.15 * width
        params = [focal, focal, width / 2 + 1.5, height / 2 - 2.5, -0.12, 0.03, 0.001, -0.0005]
        cameras.append(pycolmap.Camera(model="OPENCV", width=width, height=height, params=params))
    return Rig(tuple(f"cam{c}" for c in range(count)), tuple(cameras), np.array(poses))


def make_capture(path: Path, figure: Figure, rig: Rig) -> Capture:
    """Photographs: the figure's points as dots on a plain wall; silhouettes are those dots, closed."""
    write_capture_info(path, CaptureInfo(name="stick figure", fps=30.0))
    write_rig(path / "sparse", rig)
    for c, name in enumerate(rig.names):
        (path / "images" / name).mkdir(parents=True)
        width, height = rig.sizes[c]
        shade = np.linspace(150, 200, height)[:, None, None] + np.array([0, 4, -6])
        for t in range(len(figure.joints)):
            image = np.tile(shade, (1, width, 1)).astype(np.uint8)
            points, bodies = figure.points(t)
            pixels = rig.project(points)[c]
            for (x, y), color in zip(pixels, body_colors(bodies), strict=True):
                cv2.circle(image, (round(x - 0.5), round(y - 0.5)), 1, (0.6 * color + 30).tolist(), -1)
            cv2.imwrite(str(path / "images" / name / f"{t:06d}.png"), image[..., ::-1])
    return Capture.open(path)


def make_run(path: Path, figure: Figure, rig: Rig) -> Run:
    run = Run(path)
    T, B = figure.rotations.shape[:2]
    for kind in ("voxels", "bodies"):
        (path / kind).mkdir(parents=True)
    size = 0.015
    origin = np.array([-1.0, -1.0, -0.2])
    for t in range(T):
        points, bodies = figure.points(t, 1500)
        indices, first = np.unique(np.floor((points - origin) / size).astype(np.int32), axis=0, return_index=True)
        colors = (0.5 * body_colors(bodies[first]) + 70).astype(np.uint8)
        write_voxels(run.frame_file("voxels", t), Voxels(indices, colors, origin, size))
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor((origin + (indices + 0.5) * size).astype(np.float32)))
        labels = np.where(np.arange(len(first)) % 97 == 0, -1, bodies[first]).astype(np.int32)
        cloud.point["body"] = o3d.core.Tensor(labels[:, None])
        cloud.point["colors"] = o3d.core.Tensor(body_colors(labels))
        o3d.t.io.write_point_cloud(str(run.frame_file("bodies", t)), cloud)
        for c, name in enumerate(rig.names):
            width, height = rig.sizes[c]
            mask = np.zeros((height, width), np.uint8)
            for x, y in rig.project(points)[c]:
                cv2.circle(mask, (round(x - 0.5), round(y - 0.5)), 1, 255, -1)
            run.silhouette_file(name, t).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(run.silhouette_file(name, t)), mask)
    middle = (figure.joints + figure.ends) / 2
    along = figure.ends - figure.joints
    K = 2 * B
    centers = np.concatenate([middle - along / 4, middle + along / 4], axis=1)
    radius = np.array([limb[4] for limb in LIMBS])
    length = np.linalg.norm(along[0], axis=1)
    radii = np.tile(np.column_stack([radius, radius, length / 4 + radius / 2]), (2, 1))
    run.write_npz(
        "ellipsoids.npz",
        centers=centers,
        radii=np.tile(radii, (T, 1, 1)),
        rotations=np.concatenate([figure.rotations] * 2, axis=1),
        counts=np.full((T, K), 350),
        errors=np.full((T, K), 0.01),
        body=np.tile(np.arange(B), 2),
    )
    parents = np.array([limb[1] for limb in LIMBS])
    run.write_npz(
        "skeleton.npz",
        joint_positions=figure.joints[:, 1:],
        joint_bodies=np.column_stack([parents, np.arange(B)])[1:],
        joint_names=np.array([limb[0] for limb in LIMBS[1:]]),
        body_rotations=figure.rotations,
        body_positions=middle,
        fps=30.0,
    )
    run.write_record(
        {
            "source": {"capture": "stick figure"},
            "versions": {"geomocap": "0.1.0", "open3d": o3d.__version__},
            "settings": {"volume": {"resolution": 128}, "segmentation": {"method": "m3"}},
        }
    )
    timings = {"silhouettes": 1.2, "voxels": 3.4, "segment": 2.0, "skeleton": 0.2}
    text = {k: {"seconds": s, "items": T, "items_per_second": T / s} for k, s in timings.items()}
    (path / "timings.json").write_text(json.dumps(text))
    return run


@dataclass(frozen=True)
class Made:
    """The figure, its capture and its run."""

    figure: Figure
    rig: Rig
    capture: Capture
    run: Run


def make(path: Path, n_frames: int = 6, cameras: int = 3, size: tuple[int, int] = (160, 120)) -> Made:
    figure, rig = make_figure(n_frames), make_rig(cameras, *size)
    return Made(figure, rig, make_capture(path / "capture", figure, rig), make_run(path / "run", figure, rig))


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Made]:
    """Return a small capture and run; nobody may change them."""
    yield make(tmp_path_factory.mktemp("figure"))
