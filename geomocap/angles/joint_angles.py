"""Angles of joints over time: anatomical where they are known, else about the axis about which a joint turns most.

Anatomical angles are the turns of the outer body's axes against the inner body's in the order Z, X, Y: flexion first,
then adduction, then turning about its length (Grood & Suntay 1983, J. Biomech. Eng. 105, 136, for the knee; Wu et al.
2002). Of the shoulder there are also the plane of elevation and the elevation, order Y, X, Y (Wu et al. 2005).
Flexion, adduction and internal rotation are positive on both sides.
"""

from __future__ import annotations

import numpy as np

from geomocap.angles.anatomical_frames import AnatomicalFrames, anatomical_frames
from geomocap.angles.angle_set import AngleSet
from geomocap.model.rotations import relative_turns, rotation_vectors, zxy_angles
from geomocap.model.skeleton import Skeleton
from geomocap.naming.found_names import FoundNames
from geomocap.skeleton.hinges import main_axis

Columns = dict[str, tuple[np.ndarray, np.ndarray]]  # values and standard deviations over time, radians

# joint: inner part, outer part, sign of the turn about Z that bends it
ANATOMICAL = {
    "back": ("pelvis", "thorax", -1.0),
    "neck": ("thorax", "head", -1.0),
    "hip": ("pelvis", "thigh", 1.0),
    "knee": ("thigh", "shank", -1.0),
    "ankle": ("shank", "foot", 1.0),
    "shoulder": ("thorax", "upper_arm", 1.0),
    "elbow": ("upper_arm", "forearm", 1.0),
    "wrist": ("forearm", "hand", 1.0),
}


def joint_angles(
    skeleton: Skeleton,
    found: FoundNames,
    joint_names: tuple[str, ...],
    turn_covariances: np.ndarray | None = None,
    zero_frame: int | None = None,
) -> AngleSet:
    """Return the angles of all joints of a skeleton.

    Parameters
    ----------
    skeleton : Skeleton
    found : FoundNames
        Anatomical angles need a person whose left and right are told.
    joint_names : (J,) tuple of str
        For joints without anatomical angles.
    turn_covariances : (T, B, 3, 3) float, radians², optional
        Of the bodies' rotations, world axes.
    zero_frame : int, optional
        Frame in which all angles are zero; without it a straight limb has none.
    """
    columns: Columns = {}
    pairs: dict[str, tuple[int, int]] = {}
    frames = anatomical_frames(skeleton, found)
    if frames is not None:
        columns, pairs = _anatomical(skeleton, frames, turn_covariances, zero_frame)
    described = {frozenset(pair) for pair in pairs.values()}
    for j, (parent, child) in enumerate(skeleton.joint_bodies.tolist()):
        if frozenset((parent, child)) not in described:
            own = _about_own_axis(skeleton, joint_names[j], parent, child, turn_covariances, zero_frame)
            columns |= own
            pairs |= dict.fromkeys(own, (parent, child))
    values = [np.rad2deg(v) for v, _ in columns.values()]
    std = [np.rad2deg(s) for _, s in columns.values()]
    shape = (skeleton.frame_count, 0)
    return AngleSet(
        tuple(columns),
        np.stack(values, axis=1) if values else np.zeros(shape),
        np.stack(std, axis=1) if std else np.zeros(shape),
        skeleton.fps,
        np.array([pairs[name] for name in columns], int).reshape(-1, 2),
    )


def _anatomical(
    skeleton: Skeleton, frames: AnatomicalFrames, covariances: np.ndarray | None, zero_frame: int | None
) -> tuple[Columns, dict[str, tuple[int, int]]]:
    """Angles of the joints between named parts, and the two bodies of each."""
    columns: Columns = {}
    pairs: dict[str, tuple[int, int]] = {}
    for joint, (inner, outer, bend) in ANATOMICAL.items():
        for side in ("", "_left", "_right"):
            near = inner + side if inner + side in frames.axes else inner
            far = outer + side
            if near not in frames.axes or far not in frames.axes or frames.bodies[near] == frames.bodies[far]:
                continue
            a, b = frames.bodies[near], frames.bodies[far]
            first = skeleton.body_rotations[:, a] @ frames.axes[near]
            relative = relative_turns(first, skeleton.body_rotations[:, b] @ frames.axes[far])
            if zero_frame is not None:
                relative = relative @ relative[zero_frame].T
            angles = _known_angles(relative)
            inward = -1.0 if side == "_left" else 1.0
            signs = np.array([bend, inward, inward])
            # rates of the three angles by small turns about the axes Z, X', Y'' (all in the world)
            outer_axes = skeleton.body_rotations[:, b] @ frames.axes[far]
            between = np.cross(outer_axes[..., 1], first[..., 2])
            rates = np.linalg.pinv(np.stack([first[..., 2], between, outer_axes[..., 1]], axis=2))
            for i, kind in enumerate(("flexion", "adduction", "rotation")):
                std = _std(covariances, (a, b), rates[:, i])
                columns[f"{joint}{side}_{kind}"] = signs[i] * angles[:, i], std
            if joint == "shoulder":
                columns |= _elevation(relative, f"{joint}{side}", inward)
            pairs |= dict.fromkeys(columns.keys() - pairs.keys(), (a, b))
    return columns, pairs


def _known_angles(relative: np.ndarray) -> np.ndarray:
    """Angles Z, X, Y of rotations (T, 3, 3) of which some may be NaN."""
    known = np.isfinite(relative).all(axis=(1, 2))
    angles = np.full((len(relative), 3), np.nan)
    if known.any():
        angles[known] = zxy_angles(relative[known])
    return angles


def _elevation(relative: np.ndarray, name: str, inward: float) -> Columns:
    """Plane of elevation (0: to the side, 90°: to the front) and elevation of an upper arm."""
    down = -relative[:, :, 1]
    plane = np.arctan2(down[:, 0], inward * down[:, 2])
    whole = np.isfinite(plane)
    plane[whole] = np.unwrap(plane[whole])
    unknown = np.full(len(relative), np.nan)
    elevation = np.arccos(np.clip(-down[:, 1], -1, 1))
    return {f"{name}_plane_of_elevation": (plane, unknown), f"{name}_elevation": (elevation, unknown)}


def _about_own_axis(
    skeleton: Skeleton, name: str, parent: int, child: int, covariances: np.ndarray | None, zero_frame: int | None
) -> Columns:
    """Turn of a joint about its main axis since a frame, and the size of what is left."""
    relative = relative_turns(skeleton.body_rotations[:, parent], skeleton.body_rotations[:, child])
    relative = relative @ relative[zero_frame or 0].T
    known = np.isfinite(relative).all(axis=(1, 2))
    if not known.any():
        return {}
    axis = main_axis(relative[known], np.ones(int(known.sum())))
    vectors = rotation_vectors(relative[:, None])[:, 0]
    turn = vectors @ axis
    other = np.linalg.norm(vectors - turn[:, None] * axis, axis=1)
    world = np.einsum("tij,j->ti", skeleton.body_rotations[:, parent], axis)
    std = _std(covariances, (parent, child), world)
    return {f"{name}_turn": (turn, std), f"{name}_off_axis": (other, np.full(len(turn), np.nan))}


def _std(covariances: np.ndarray | None, bodies: tuple[int, int], rates: np.ndarray) -> np.ndarray:
    """Standard deviation (T,) of an angle that changes by `rates` (T, 3) with small turns of two bodies."""
    if covariances is None:
        return np.full(len(rates), np.nan)
    both = covariances[:, bodies[0]] + covariances[:, bodies[1]]
    return np.sqrt(np.einsum("ti,tij,tj->t", rates, both, rates))


def turn_covariances(rotations: np.ndarray, samples: np.ndarray, labels: np.ndarray, *, least: int = 4) -> np.ndarray:
    """Covariances of bodies' rotations, (T, B, 3, 3) radians², from how far their samples are from moving rigidly.

    With residuals of variance s² in a frame, samples at r from their centre tell Σ (r² I - r rᵀ) / s² of the turn. It
    is the random part only: samples beside each other that err alike err more than this.

    Parameters
    ----------
    rotations : (T, B, 3, 3) float
        Since frame 0.
    samples : (N, T, 3) float, metres
    labels : (N,) int
    least : int
        Bodies with fewer samples in a frame have no covariance there: NaN.
    """
    result = np.full((*rotations.shape[:2], 3, 3), np.nan)
    for b in range(rotations.shape[1]):
        mine = samples[labels == b]
        if len(mine) < least:
            continue
        local = np.einsum("tji,ntj->nti", rotations[:, b], mine)
        shape = np.nanmean(local - _mean(local, 0), axis=1)
        for t in range(len(rotations)):
            seen = np.isfinite(local[:, t]).all(axis=1) & np.isfinite(shape).all(axis=1)
            if seen.sum() < least:
                continue
            lever = shape[seen] - shape[seen].mean(axis=0)
            residual = local[seen, t] - local[seen, t].mean(axis=0) - lever
            variance = float((residual**2).sum() / (3 * seen.sum() - 6))
            r = lever @ rotations[t, b].T
            moment = (r**2).sum() * np.eye(3) - r.T @ r
            result[t, b] = variance * np.linalg.pinv(moment)
    return result


def _mean(values: np.ndarray, axis: int) -> np.ndarray:
    known = np.isfinite(values)
    return np.where(known, values, 0.0).sum(axis=axis) / np.maximum(known.sum(axis=axis), 1)
