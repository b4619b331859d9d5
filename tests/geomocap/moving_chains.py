"""Chains of boxes that turn about hinges, with the truth of every sample: for tests of bodies from motion paths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Chain:
    """positions (N, T, 3), body (N,), rotations (T, B, 3, 3) since frame 0, joints (J, 3) in frame 0, axes (J, 3)."""

    positions: np.ndarray
    body: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    joints: np.ndarray
    axes: np.ndarray


def box_surface(rng: np.random.Generator, count: int, low: list[float], high: list[float]) -> np.ndarray:
    """Points on the long sides of a box."""
    size = np.array(high) - low
    points = rng.random((count, 3)) * size + low
    side = rng.integers(0, 2, count) + 1
    points[np.arange(count), side] = np.where(rng.random(count) < 0.5, np.array(low)[side], np.array(high)[side])
    return points


def chain(bodies: int = 3, frames: int = 24, samples: int = 90, turn_deg: float = 50.0, seed: int = 0) -> Chain:
    """Boxes 0.4 m long in a row along x; each turns against the one before, about z and y by turns."""
    rng = np.random.default_rng(seed)
    rest, body = [], []
    for b in range(bodies):
        rest.append(box_surface(rng, samples, [0.4 * b, -0.06, -0.05], [0.4 * b + 0.4, 0.06, 0.05]))
        body += [b] * samples
    points = np.concatenate(rest)
    joints = np.array([[0.4 * b, 0.0, 0.0] for b in range(1, bodies)])
    axes = np.array([[0.0, 0.0, 1.0] if b % 2 else [0.0, 1.0, 0.0] for b in range(1, bodies)])
    time = np.arange(frames) / (frames - 1)
    rotations = np.tile(np.eye(3), (frames, bodies, 1, 1))
    translations = np.zeros((frames, bodies, 3))
    rotations[:, 0] = Rotation.from_rotvec(np.outer(np.sin(2 * np.pi * time), [0.2, 0.3, 0.1])).as_matrix()
    translations[:, 0] = np.outer(time, [0.5, 0.1, 0.0])
    for b in range(1, bodies):
        angle = np.deg2rad(turn_deg) * np.sin(2 * np.pi * time * (1 + 0.5 * b))
        local = Rotation.from_rotvec(angle[:, None] * axes[b - 1]).as_matrix()
        rotations[:, b] = rotations[:, b - 1] @ local
        place = rotations[:, b - 1] @ joints[b - 1] + translations[:, b - 1]
        translations[:, b] = place - rotations[:, b] @ joints[b - 1]
    labels = np.array(body)
    positions = np.einsum("tnij,nj->nti", rotations[:, labels], points) + translations[:, labels].swapaxes(0, 1)
    return Chain(positions, labels, rotations, translations, joints, axes)


def seen_by_single_cameras(scene: Chain, depth_std: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions whose depths, each as one of four cameras around sees it, are off as a hull is; rays."""
    rng = np.random.default_rng(seed)
    count, frames = scene.positions.shape[:2]
    around = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    camera = rng.integers(0, 4, count)
    ray = np.repeat(around[camera][:, None], frames, axis=1)
    hull = np.sin(0.9 * np.arange(frames) + 2.0 * camera[:, None] + 5.0 * scene.body[:, None])
    off = depth_std * (hull + 0.5 * rng.normal(size=(count, frames)))
    noise = rng.normal(scale=1e-3, size=scene.positions.shape)
    return scene.positions + noise + off[:, :, None] * ray, ray


def seen_while_it_turns(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (N, T, 3) of a chain that turns about its length as a whole, NaN on its far side; all; bodies (N,)."""
    scene = chain(3, frames=48, samples=200, seed=seed)
    angle = np.linspace(0, 1.2 * np.pi, 48)
    turns = Rotation.from_rotvec(np.outer(angle, [1.0, 0.0, 0.0])).as_matrix()
    true = np.einsum("tij,ntj->nti", turns, scene.positions)
    side = np.arctan2(1.2 * scene.positions[:, 0, 2], scene.positions[:, 0, 1])
    near = np.cos(side[:, None] + angle) > -0.2
    noisy = true + np.random.default_rng(seed).normal(scale=1e-3, size=true.shape)
    return np.where(near[..., None], noisy, np.nan), true, scene.body


def same_partition(found: np.ndarray, true: np.ndarray) -> float:
    """Fraction of samples whose body is the one that covers their true body best, one to one at best."""
    table = np.zeros((true.max() + 1, found.max() + 1))
    np.add.at(table, (true, found), 1)
    best = table.argmax(axis=1)
    return float(sum(table[b, best[b]] for b in range(len(best)) if (best == best[b]).sum() == 1) / len(true))


def loose_body(count: int, frames: int) -> tuple[np.ndarray, ...]:
    """A moving body of which some samples go astray, some are not seen, and most have rays."""
    rng = np.random.default_rng(13)
    rest = rng.normal(scale=0.1, size=(count, 3)) + 1.0
    true = Rotation.from_rotvec(rng.normal(scale=0.5, size=(frames, 3))).as_matrix()
    positions = np.einsum("tij,nj->nti", true, rest) + rng.normal(scale=2e-3, size=(count, frames, 3))
    positions[: count // 6] += rng.normal(scale=0.05, size=(count // 6, frames, 3))
    weights = rng.random((count, frames)) * (rng.random((count, frames)) > 0.1)
    ray = rng.normal(size=(count, frames, 3)) * (rng.random((count, frames, 1)) > 0.3)
    return positions, rest, weights, ray / np.maximum(np.linalg.norm(ray, axis=2, keepdims=True), 1e-12)
