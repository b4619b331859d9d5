"""A small made-up truth: boxes in a tree, each turning against its parent, and a run with known flaws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d

from geomocap.files.run import Run
from geomocap.model.rotations import rotation_about

PARENTS = np.array([-1, 0, 1, 0, 3])
LENGTH, WIDTH = 0.4, 0.05


def truth_arrays(n_frames: int = 16, fps: float = 15.0) -> dict[str, np.ndarray]:
    """A trunk (0) with two limbs of two segments each; segment 4 turns by 5° only, less than a body must."""
    t = np.arange(n_frames) / fps
    base = np.array([[0, 0, 1.0], [0, 0, LENGTH], [LENGTH, 0, 0], [0, 0, 0], [0, 0, -LENGTH]])
    swing = np.deg2rad([20, 60, 50, 40, 5])
    axis = [2, 1, 1, 0, 0]
    R = np.empty((n_frames, 5, 3, 3))
    p = np.empty((n_frames, 5, 3))
    for j, parent in enumerate(PARENTS):
        turn = rotation_about(axis[j], swing[j] * np.sin(2.5 * t + 0.3 * j))
        if parent < 0:
            R[:, j] = turn
            p[:, j] = base[j] + np.stack([0.5 * t, 0 * t, 0.05 * np.sin(6 * t)], 1)
        else:
            R[:, j] = R[:, parent] @ turn
            p[:, j] = p[:, parent] + np.einsum("tij,j->ti", R[:, parent], base[j])
    along = np.array([[0, 0, 1], [1, 0, 0], [1, 0, 0], [0, 0, -1], [0, 0, -1]], float)
    vertices, faces, owner = [], [], []
    for j in range(5):
        v, f = _box(along[j])
        faces.append(f + sum(map(len, owner)))
        owner.append(np.full(len(v), j))
        vertices.append(np.einsum("tij,vj->tvi", R[:, j], v) + p[:, None, j])
    joint = np.concatenate(owner)
    return {
        "fps": np.array(fps),
        "vertices": np.concatenate(vertices, axis=1).astype(np.float32),
        "faces": np.concatenate(faces).astype(np.int32),
        "vertex_joint": joint,
        "vertex_weights": np.eye(5, dtype=np.float32)[joint],
        "joint_names": np.array(["trunk", "arm", "hand", "leg", "foot"]),
        "joint_parents": PARENTS,
        "joint_positions": p,
        "joint_rotations": R,
    }


def _box(along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed box from the origin along an axis, subdivided: vertices (V, 3), faces (F, 3)."""
    box = o3d.geometry.TriangleMesh.create_box(LENGTH - 0.02, WIDTH, WIDTH).subdivide_midpoint(3)
    v = np.asarray(box.vertices) + np.array([0.01, -WIDTH / 2, -WIDTH / 2])
    other = np.cross([0.0, 1, 0], along) if abs(along[1]) < 0.5 else np.array([1.0, 0, 0])
    frame = np.stack([along, np.cross(other, along), other], axis=1)
    return v @ frame.T, np.asarray(box.triangles)


def write_truth(folder: Path, **change: np.ndarray) -> Path:
    """Write a truth folder, with some arrays changed."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "truth.npz", **{**truth_arrays(), **change})
    return folder


def flawed_run(folder: Path, *, joint_noise: float = 0.02, seed: int = 1) -> Run:
    """A run whose bodies, joints, rotations, cloud and tracks are off by known amounts."""
    rng = np.random.default_rng(seed)
    t = truth_arrays()
    T = len(t["vertices"])
    run = Run(folder)
    run.write_record({"source": {"up": "z", "fps": 15.0}})
    first = np.array([0, 1, 2, 3])  # rig joints of the true bodies; foot belongs to leg
    joints = t["joint_positions"][:, [1, 2, 3]]
    joints = joints + rng.normal(0, joint_noise, joints.shape)
    joints = np.concatenate([joints, np.full((T, 1, 3), 30.0)], axis=1)  # one joint that is nowhere
    joints[3, 1] = np.nan
    turned = t["joint_rotations"][:, first]
    turned = np.einsum("tbij,bkj->tbik", turned, turned[0])
    turned[:, 1] = turned[:, 1] @ rotation_about(0, np.deg2rad(np.linspace(0, 12, T)))
    run.write_npz(
        "skeleton.npz",
        joint_positions=joints,
        joint_bodies=np.array([[0, 1], [1, 2], [0, 3], [2, 4]]),
        joint_names=np.array(["joint_body00_body01", "joint_body01_body02", "joint_body00_body03", "joint_odd"]),
        body_rotations=turned[:, [0, 1, 2, 3, 3]],  # the last one is a body without points
        body_positions=t["joint_positions"][:, [0, 1, 2, 3, 3]],
        fps=15.0,
    )
    for k in range(T):
        vertices = t["vertices"][k].astype(float)
        points = vertices[rng.choice(len(vertices), 300)] + rng.normal(0, 0.01, (300, 3))
        points[:5] += 1.0  # far from the surface
        nearest = np.linalg.norm(points[:, None] - vertices, axis=-1).argmin(axis=1)
        label = np.array([0, 1, 2, 3, 3])[t["vertex_joint"][nearest]].astype(np.int32)
        wrong = rng.random(300) < 0.15
        label[wrong] = rng.integers(-1, 4, wrong.sum())
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(points.astype(np.float32)))
        cloud.point["body"] = o3d.core.Tensor.from_numpy(label[:, None])
        for kind in ("bodies", "cloud"):
            (folder / kind).mkdir(exist_ok=True)
            o3d.t.io.write_point_cloud(str(run.frame_file(kind, k)), cloud)
    tracks = t["vertices"][:, rng.choice(t["vertices"].shape[1], 20)].transpose(1, 0, 2).astype(float)
    tracks += np.cumsum(rng.normal(0, 0.002, tracks.shape), axis=1)
    tracks[:10, :4] = np.nan
    tracks[5:15, 12:] = np.nan
    run.write_npz("tracks.npz", positions=tracks)
    return run
