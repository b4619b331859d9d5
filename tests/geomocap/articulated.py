"""A made-up articulated subject with known motion: the truth for tests of motion files."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.model.ellipsoids import Ellipsoids
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


def shells_at(
    centers: np.ndarray, body: list[int], counts: np.ndarray | None = None, radius: float = 0.1
) -> Ellipsoids:
    """Balls with centres (T, K, 3)."""
    lead = centers.shape[:2]
    counts = np.full(lead, 30) if counts is None else counts
    turns = np.tile(np.eye(3), (*lead, 1, 1))
    return Ellipsoids(centers, np.full(centers.shape, radius), turns, counts, np.zeros(lead), np.array(body))


def alike(one, other):
    """Whether two values hold the same in all their fields."""
    for f in fields(one):
        a, b = getattr(one, f.name), getattr(other, f.name)
        if hasattr(a, "__dataclass_fields__"):
            alike(a, b)
        elif a is None:
            assert b is None
        else:
            np.testing.assert_array_equal(a, b, err_msg=f.name)
