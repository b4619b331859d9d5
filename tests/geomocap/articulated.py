"""A made-up articulated subject with known motion: the truth for tests of motion files."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.model.skeleton import Skeleton, body_names


def skeleton_arrays(
    n_bodies: int = 7,
    n_frames: int = 20,
    *,
    seed: int = 3,
    fps: float = 15.0,
    jump_mm: float = 0.0,
    wander_mm: float = 0.0,
    amplitude: float = 1.2,
) -> dict[str, np.ndarray]:
    """Arrays of a `skeleton.npz`: a random tree of rigid bodies that turn smoothly while the root walks.

    `jump_mm` moves every joint at random in every frame, as joints found frame by frame do; `wander_mm` moves the
    bodies' centres, but not their joints.
    """
    rng = np.random.default_rng(seed)
    parent = np.array([-1 if b < 1 else rng.integers(0, b) for b in range(n_bodies)])
    t = np.arange(n_frames) / fps
    phase, speed = rng.uniform(0, 6, (n_bodies, 3)), rng.uniform(1, 5, (n_bodies, 3))
    amount = rng.uniform(-amplitude, amplitude, (n_bodies, 3))
    wave = amount * (np.sin(speed * t[:, None, None] + phase) - np.sin(phase))
    local = Rotation.from_rotvec(wave.reshape(-1, 3)).as_matrix().reshape(n_frames, n_bodies, 3, 3)
    offset = rng.uniform(-0.5, 0.5, (n_bodies, 3))
    centre = rng.uniform(-0.2, 0.2, (n_bodies, 3))
    R = np.empty((n_frames, n_bodies, 3, 3))
    origin = np.empty((n_frames, n_bodies, 3))
    for b in range(n_bodies):
        if parent[b] < 0:
            R[:, b] = local[:, b]
            origin[:, b] = offset[b] + [0.3, -0.2, 1.1] + np.stack([0.8 * t, 0.1 * np.sin(3 * t), 0.05 * t], 1)
        else:
            R[:, b] = R[:, parent[b]] @ local[:, b]
            origin[:, b] = origin[:, parent[b]] + R[:, parent[b]] @ offset[b]
    children = np.flatnonzero(parent >= 0)
    joints = origin[:, children] + rng.normal(0, jump_mm / 1000, (n_frames, len(children), 3))
    wander = rng.normal(0, wander_mm / 1000, (n_frames, n_bodies, 3))
    return {
        "joint_positions": joints,
        "joint_bodies": np.stack([parent[children], children], axis=1),
        "joint_names": np.array([f"joint_body{parent[b]:02d}_body{b:02d}" for b in children]),
        "body_rotations": R,
        "body_positions": origin + np.einsum("tbij,bj->tbi", R, centre) + wander,
        "fps": np.array(fps),
    }


def skeleton_of(arrays: dict[str, np.ndarray]) -> Skeleton:
    """The skeleton that such a file holds."""
    count = arrays["body_positions"].shape[1]
    return Skeleton(
        arrays["joint_positions"],
        np.asarray(arrays["joint_bodies"], np.int32).reshape(-1, 2),
        arrays["joint_names"].astype(str),
        arrays.get("body_names", body_names(count)),
        arrays["body_rotations"],
        arrays["body_positions"],
        0,
        np.full((count - 1, 3), np.nan),
        np.full((count, 3), np.nan),
        False,
        float(arrays["fps"]),
    )


def articulated_skeleton(n_bodies: int = 7, n_frames: int = 20, **how) -> Skeleton:
    """A made-up skeleton; the arguments are those of `skeleton_arrays`."""
    return skeleton_of(skeleton_arrays(n_bodies, n_frames, **how))
