"""Motion of connected bodies whose joints stay together: an articulated least squares fit to the samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.model.hierarchy import Hierarchy
from geomocap.model.rotations import nearest_rotation


@dataclass(frozen=True)
class ArticulatedMotion:
    """Forward kinematics of bodies connected at points.

    Attributes
    ----------
    rotations : (T, B, 3, 3) float
        Since frame 0, world axes.
    translations : (T, B, 3) float, metres
        position(t) = rotation @ position(0) + translation; the two bodies of a joint carry it to the same place.
    joint_positions : (T, J, 3) float, metres, world
    """

    rotations: np.ndarray
    translations: np.ndarray
    joint_positions: np.ndarray


@dataclass(frozen=True)
class BodyMoments:
    """What the samples say of each body in each frame: enough for the fit, whatever their number.

    Attributes
    ----------
    weight : (T, B) float
        Sum of the samples' weights.
    rest, moved : (T, B, 3) float, metres
        Weighted means in frame 0 and in the frame.
    correlation : (T, B, 3, 3) float, metres²
        Σ w (moved - mean)(rest - mean)ᵀ.
    scatter : (T, B, 3, 3) float, metres²
        Σ w (rest - mean)(rest - mean)ᵀ.
    """

    weight: np.ndarray
    rest: np.ndarray
    moved: np.ndarray
    correlation: np.ndarray
    scatter: np.ndarray


def prior_moments(
    rotations: np.ndarray, translations: np.ndarray, centers: np.ndarray, radii: np.ndarray, weights: np.ndarray
) -> BodyMoments:
    """Moments of bodies of which only the motion is known: as if of a ball of samples around each centre.

    Parameters
    ----------
    rotations, translations : (T, B, 3, 3), (T, B, 3) float
        Of each body by itself.
    centers : (B, 3) float, metres
        In frame 0.
    radii : (B,) float, metres
        Of gyration.
    weights : (T, B) float
    """
    moved = np.einsum("tbij,bj->tbi", rotations, centers) + translations
    inertia = (weights * radii**2 / 3.0)[..., None, None]
    scatter = inertia * np.eye(3)
    return BodyMoments(weights, np.broadcast_to(centers, moved.shape), moved, inertia * rotations, scatter)


def fit_articulated(
    moments: BodyMoments,
    hierarchy: Hierarchy,
    joints: np.ndarray,
    start: np.ndarray,
    rounds: int,
) -> ArticulatedMotion:
    """Rotations of all bodies and the path of the root that fit all bodies' samples best, joints kept together.

    Gauss–Newton on the turns of all bodies and the root's translation, frame by frame, all 3 B + 3 unknowns at once. A
    body is carried by the chain of joints from the root: x = p_root + Σ R_a (c_next - c_a) + R_b (X - c_b), so that a
    turn of a moves all that hangs on it.

    Parameters
    ----------
    moments : BodyMoments
    hierarchy : Hierarchy
    joints : (J, 3) float, metres, world
        In frame 0.
    start : (T, B, 3, 3) float
        First rotations.
    rounds : int
    """
    rotations = np.array(start, float)
    frames, bodies = rotations.shape[:2]
    arms, anchors = _chains(hierarchy, joints, bodies)
    total = np.maximum(moments.weight.sum(axis=1), 1e-9)
    root = _root_positions(rotations, moments, arms, anchors, total)
    for _ in range(rounds):
        normal = np.zeros((frames, 3 * bodies + 3, 3 * bodies + 3))
        right = np.zeros((frames, 3 * bodies + 3))
        # levers of every body's turn on the mean point of body b
        for b in range(bodies):
            levers = np.einsum("taij,taj->tai", rotations, _levers(b, arms, anchors, moments.rest[:, b]))
            miss = moments.moved[:, b] - root - levers.sum(axis=1)
            weight = moments.weight[:, b]
            rows = np.flatnonzero(np.abs(arms[b]).sum(axis=1) > 0)
            rows = np.union1d(rows, [b])
            jacobian = np.zeros((frames, 3, 3 * bodies + 3))
            for a in rows:
                jacobian[:, :, 3 * a : 3 * a + 3] = -_skew(levers[:, a])
            jacobian[:, :, -3:] = np.eye(3)
            turned = jacobian.swapaxes(1, 2)
            normal += weight[:, None, None] * (turned @ jacobian)
            right += weight[:, None] * (turned @ miss[..., None])[..., 0]
            # the body's own turn from the spread of its samples
            here = slice(3 * b, 3 * b + 3)
            carried = rotations[:, b] @ moments.scatter[:, b] @ rotations[:, b].swapaxes(1, 2)
            spread = np.trace(carried, axis1=1, axis2=2)[:, None, None] * np.eye(3) - carried
            normal[:, here, here] += spread
            twist = moments.correlation[:, b] @ rotations[:, b].swapaxes(1, 2)
            right[:, here] += _axial(twist)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3 * bodies + 3)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        turns = np.clip(step[:, :-3].reshape(frames, bodies, 3), -0.5, 0.5)
        rotations = nearest_rotation((np.eye(3) + _skew(turns)) @ rotations)
        root = _root_positions(rotations, moments, arms, anchors, total)
    return _kinematics(rotations, root, hierarchy, joints, arms, anchors)


def _chains(hierarchy: Hierarchy, joints: np.ndarray, bodies: int) -> tuple[np.ndarray, np.ndarray]:
    """Arms (B, B, 3): part of body a in the chain to body b; anchors (B, 3): own joint of each body."""
    arms = np.zeros((bodies, bodies, 3))
    anchors = np.zeros((bodies, 3))
    anchors[hierarchy.root] = joints[0] if len(joints) else 0.0
    for j, (parent, child) in enumerate(hierarchy.joint_bodies):
        anchors[child] = joints[j]
        arms[child] = arms[parent]
        arms[child, parent] = arms[child, parent] + joints[j] - anchors[parent]
    return arms, anchors


def _levers(body: int, arms: np.ndarray, anchors: np.ndarray, rest: np.ndarray) -> np.ndarray:
    levers = np.broadcast_to(arms[body], (len(rest), *arms[body].shape)).copy()
    levers[:, body] += rest - anchors[body]
    return levers


def _root_positions(
    rotations: np.ndarray, moments: BodyMoments, arms: np.ndarray, anchors: np.ndarray, total: np.ndarray
) -> np.ndarray:
    path = np.zeros((len(rotations), 3))
    for b in range(rotations.shape[1]):
        carried = np.einsum("taij,taj->ti", rotations, _levers(b, arms, anchors, moments.rest[:, b]))
        path += moments.weight[:, b, None] * (moments.moved[:, b] - carried)
    return path / total[:, None]


def _kinematics(
    rotations: np.ndarray,
    root: np.ndarray,
    hierarchy: Hierarchy,
    joints: np.ndarray,
    arms: np.ndarray,
    anchors: np.ndarray,
) -> ArticulatedMotion:
    own = root[:, None] + np.einsum("taij,baj->tbi", rotations, arms)  # where each body's own joint is
    translations = own - np.einsum("tbij,bj->tbi", rotations, anchors)
    children = hierarchy.joint_bodies[:, 1]
    return ArticulatedMotion(rotations, translations, own[:, children])


def _axial(matrix: np.ndarray) -> np.ndarray:
    return np.stack(
        [
            matrix[..., 2, 1] - matrix[..., 1, 2],
            matrix[..., 0, 2] - matrix[..., 2, 0],
            matrix[..., 1, 0] - matrix[..., 0, 1],
        ],
        axis=-1,
    )


def _skew(vectors: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)
