"""Motion of a skeleton: rotations relative to parents, and bones that keep their length."""

from __future__ import annotations

import numpy as np

from geomocap.model.hierarchy import Hierarchy
from geomocap.model.rotations import nearest_rotation

_TURNED = 0.2
_ROUNDS = 4


def forward_kinematics(
    hierarchy: Hierarchy, offsets: np.ndarray, rotations: np.ndarray, root_positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions and body rotations of bones with constant offsets.

    Parameters
    ----------
    hierarchy : Hierarchy
    offsets : (J, 3) float, metres
        From the parent body's own joint (for the root: its position) to the joint, in the parent's frame.
    rotations : (T, B, 3, 3) float
        Relative to the parent, see `Hierarchy.local_rotations`.
    root_positions : (T, 3) float, metres

    Returns
    -------
    joint_positions : (T, J, 3) float, metres, world
    body_rotations : (T, B, 3, 3) float, world
    """
    origins = np.empty(rotations.shape[:3])
    origins[:, hierarchy.root], origins[:, hierarchy.joint_bodies[:, 1]] = root_positions, offsets
    world, origins = hierarchy.forward_kinematics(rotations, origins)
    return origins[:, hierarchy.joint_bodies[:, 1]], world


def fit_offsets(
    hierarchy: Hierarchy,
    body_rotations: np.ndarray,
    root_positions: np.ndarray,
    joint_positions: np.ndarray,
    body_positions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Constant bone offsets whose forward kinematics come nearest to joints and bodies found frame by frame.

    With the rotations known, joint j stands at root(t) + Σ R_parent(a)(t) o_a over the joints a from the root to j, and
    the centre of a body at its own joint + R_body(t) d_body: both are linear in the constants o and d, which are found
    together by least squares over all frames.

    Parameters
    ----------
    hierarchy : Hierarchy
    body_rotations : (T, B, 3, 3) float
        Since frame 0, world axes.
    root_positions : (T, 3) float, metres
    joint_positions : (T, J, 3) float, metres
        Found in each frame.
    body_positions : (T, B, 3) float, metres

    Returns
    -------
    offsets : (J, 3) float, metres
        See `forward_kinematics`.
    body_offsets : (B, 3) float, metres
        From a body's own joint to its centre, in the body's frame.
    """
    joints, bodies = len(hierarchy.joint_bodies), body_rotations.shape[1]
    own = hierarchy.body_joints
    size = 3 * (joints + bodies)
    normal = np.zeros((size, size))
    right = np.zeros(size)
    chains: list[list[tuple[int, int]]] = []  # of each joint: (unknown, body whose rotation turns it)
    for j, (parent, _) in enumerate(hierarchy.joint_bodies):
        before = [] if own[parent] < 0 else chains[own[parent]]
        chains.append([*before, (j, int(parent))])
    observed = [(chains[j], joint_positions[:, j]) for j in range(joints)]
    for b in range(bodies):
        before = [] if own[b] < 0 else chains[own[b]]
        observed.append(([*before, (joints + b, b)], body_positions[:, b]))
    products: dict[tuple[int, int], np.ndarray] = {}
    for chain, positions in observed:
        miss = positions - root_positions
        for u, a in chain:
            right[3 * u : 3 * u + 3] += np.einsum("tji,tj->i", body_rotations[:, a], miss)
            for w, c in chain:
                if (a, c) not in products:
                    products[a, c] = np.einsum("tji,tjk->ik", body_rotations[:, a], body_rotations[:, c])
                normal[3 * u : 3 * u + 3, 3 * w : 3 * w + 3] += products[a, c]
    # what the motion leaves open is decided by the shortest bones
    solution = np.linalg.solve(normal + 1e-6 * len(body_rotations) * np.eye(size), right).reshape(-1, 3)
    return solution[:joints], solution[joints:]


def turn_bones(
    hierarchy: Hierarchy,
    offsets: np.ndarray,
    body_offsets: np.ndarray,
    body_rotations: np.ndarray,
    root_positions: np.ndarray,
    joint_positions: np.ndarray,
    body_positions: np.ndarray,
) -> np.ndarray:
    """Turn each bone towards the joints and the body centre found at its far end, from the root outward.

    A body's rotation is the one nearest (Kabsch) to its child joints and its centre as seen from its own joint of the
    forward kinematics, and weakly to the rotation that the segmentation gave, which decides the roll of a bone with
    one joint.

    Parameters
    ----------
    hierarchy, offsets, body_offsets, root_positions
        See `forward_kinematics` and `fit_offsets`.
    body_rotations : (T, B, 3, 3) float
        Given by the segmentation.
    joint_positions : (T, J, 3) float, metres
        Found in each frame.
    body_positions : (T, B, 3) float, metres

    Returns
    -------
    (T, B, 3, 3) float
        Since frame 0, world axes; the identity in frame 0.
    """
    turned = body_rotations.copy()
    positions = np.empty((len(turned), len(offsets), 3))
    own = hierarchy.body_joints
    for body in [hierarchy.root, *hierarchy.joint_bodies[:, 1].tolist()]:
        joint = own[body]
        if joint >= 0:
            parent = hierarchy.joint_bodies[joint, 0]
            start = root_positions if own[parent] < 0 else positions[:, own[parent]]
            positions[:, joint] = start + turned[:, parent] @ offsets[joint]
        origin = root_positions if joint < 0 else positions[:, joint]
        children = np.flatnonzero(hierarchy.joint_bodies[:, 0] == body)
        rest = np.concatenate([offsets[children], body_offsets[[body]]])
        seen = np.concatenate([joint_positions[:, children], body_positions[:, [body]]], axis=1) - origin[:, None]
        evidence = np.einsum("tni,nj->tij", seen, rest) + _TURNED * (rest**2).sum() * body_rotations[:, body]
        evidence[0] = np.eye(3)
        turned[:, body] = nearest_rotation(evidence)
    return turned


def fit_motion(
    hierarchy: Hierarchy,
    body_rotations: np.ndarray,
    root_positions: np.ndarray,
    joint_positions: np.ndarray,
    body_positions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find bones of constant length and their turns, by turns: `fit_offsets`, then `turn_bones`.

    Returns
    -------
    body_rotations : (T, B, 3, 3) float
    offsets : (J, 3) float, metres
    body_offsets : (B, 3) float, metres
    """
    turned = body_rotations
    found = (root_positions, joint_positions, body_positions)
    for _ in range(_ROUNDS):
        offsets, body_offsets = fit_offsets(hierarchy, turned, *found)
        turned = turn_bones(hierarchy, offsets, body_offsets, body_rotations, *found)
    return turned, *fit_offsets(hierarchy, turned, *found)
