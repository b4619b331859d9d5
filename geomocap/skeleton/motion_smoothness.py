"""Temporal prior of an articulated motion: accelerations of its degrees of freedom, steady against quick ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.skeleton.kinematics import JointMotion, Linkage

_STEADY = 0.3  # accelerations of slips against the slips: these come and go slowly


@dataclass(frozen=True)
class Smoothness:
    """Standard deviations of the accelerations of the root's place and of all turns.

    Accelerations count 1 / (1 + χ² / cutoff²): a kick is not smoothed away.

    Attributes
    ----------
    turn : (J + 1,) float, radians / frame²
        Of the root and of each joint.
    shift : float, metres / frame²
        Of the root's place.
    cutoff : float
        In standard deviations.
    """

    turn: np.ndarray
    shift: float
    cutoff: float


@dataclass(frozen=True)
class PosePrior:
    """A motion that is expected, each frame by itself: a prediction, or poses seen before.

    Attributes
    ----------
    motion : JointMotion
    turn : float, radians
        Standard deviation of each joint's turn from what is expected.
    root_turn : float, radians
    shift : float, metres
        Of the root's place.
    """

    motion: JointMotion
    turn: float
    root_turn: float
    shift: float


def pose_terms(linkage: Linkage, motion: JointMotion, prior: PosePrior) -> tuple[np.ndarray, np.ndarray, float]:
    """Weights (D,) and values (T, D) of the turns and shifts from the expected motion, and their cost."""
    first = linkage.joint_dof
    value = np.empty((motion.frames, first[-1]))
    root = linkage.hierarchy.root
    away = motion.local @ prior.motion.local.swapaxes(-1, -2)
    vectors = Rotation.from_matrix(away.reshape(-1, 3, 3)).as_rotvec().reshape(*away.shape[:2], 3)
    value[:, :3], value[:, 3:6] = vectors[:, root], motion.root - prior.motion.root
    for j, child in enumerate(linkage.hierarchy.joint_bodies[:, 1]):
        turn = vectors[:, child]
        value[:, first[j] : first[j + 1]] = (turn @ linkage.axes[j])[:, None] if linkage.hinge[j] else turn
    sigma = np.repeat([prior.root_turn, prior.shift, prior.turn], [3, 3, first[-1] - 6])
    return sigma**-2, value, float(0.5 * ((value / sigma) ** 2).sum())


def accelerations(linkage: Linkage, motion: JointMotion) -> np.ndarray:
    """Second differences of all degrees of freedom, (T - 2, D): of turns on SO(3), in the parent's axes.

    The pace from t to t + 1 is log(R(t+1) R(t)ᵀ); a small turn φ before each R changes it by φ(t+1) - φ(t) to first
    order in the pace.
    """
    first = linkage.joint_dof
    result = np.empty((motion.frames - 2, first[-1]))
    result[:, :3] = _turning(motion.local[:, linkage.hierarchy.root])
    result[:, 3:6] = np.diff(motion.root, n=2, axis=0)
    for j, child in enumerate(linkage.hierarchy.joint_bodies[:, 1]):
        vector = _turning(motion.local[:, child])
        result[:, first[j] : first[j + 1]] = (vector @ linkage.axes[j])[:, None] if linkage.hinge[j] else vector
    return result


def _turning(rotations: np.ndarray) -> np.ndarray:
    pace = Rotation.from_matrix(rotations[1:] @ rotations[:-1].swapaxes(1, 2)).as_rotvec()
    return np.diff(pace, axis=0)


def acceleration_groups(linkage: Linkage) -> np.ndarray:
    """Group of each degree of freedom, (D,) int: 0 the root's turn, 1 its shift, 2 + j joint j."""
    return np.concatenate(
        [[0, 0, 0, 1, 1, 1], 2 + np.repeat(np.arange(len(linkage.joints)), np.diff(linkage.joint_dof))]
    )


def typical_accelerations(linkage: Linkage, motion: JointMotion) -> tuple[np.ndarray, float]:
    """Medians over time of the turning accelerations, (J + 1,) radians / frame², and of the root's, metres / frame²."""
    groups = acceleration_groups(linkage)
    if motion.frames < 3:
        return np.zeros(len(linkage.joints) + 1), 0.0
    value = accelerations(linkage, motion)
    sizes = [np.median(np.linalg.norm(value[:, groups == g], axis=1)) for g in range(len(linkage.joints) + 2)]
    return np.array([sizes[0], *sizes[2:]]), float(sizes[1])


def prior_terms(
    linkage: Linkage, motion: JointMotion, prior: Smoothness, looseness: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Weights (T - 2, D) and values (T - 2, D) of the accelerations, and their cost.

    Where joints slip, the accelerations of their slips follow; `looseness` (J,), metres, are the slips' standard
    deviations.
    """
    group = acceleration_groups(linkage)
    sigma = np.concatenate([[prior.turn[0], prior.shift], prior.turn[1:]])
    value = accelerations(linkage, motion)
    if looseness is not None and motion.slip is not None:
        group = np.concatenate([group, len(sigma) + np.repeat(np.arange(len(looseness)), 3)])
        sigma = np.concatenate([sigma, _STEADY * looseness])
        value = np.concatenate([value, np.diff(motion.slip, n=2, axis=0).reshape(len(value), -1)], axis=1)
    chi2 = np.zeros((len(value), len(sigma)))
    np.add.at(chi2.T, group, (value / sigma[group]).T ** 2)
    cost = float(0.5 * prior.cutoff**2 * np.log1p(chi2 / prior.cutoff**2).sum())
    robust = 1.0 / (1.0 + chi2 / prior.cutoff**2)
    return robust[:, group] / sigma[group] ** 2, value, cost
