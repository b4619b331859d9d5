"""Which joints are hinges: turns about other axes than one, judged by what the observations can tell of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.skeleton.body_observations import SkinPoints
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, about_axis

_ROUNDS = 5
_TILT = 1e-4  # radians, for slopes


def turn_information(
    linkage: Linkage, bodies: BodyMotion, points: SkinPoints, seen: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """What observations tell of the turns in each joint, (T, J, 3, 3), 1 / radians², in the parent's axes.

    A sample at r from a joint whose position has the weight w tells w (r² I - r rᵀ) of its body's turn about the joint.
    The turn in the joint is known as well as both bodies' turns are: inverse of the sum of their covariances.

    Parameters
    ----------
    linkage, bodies
    points : SkinPoints
    seen : (N, T) bool
    weights : (N,) float, 1 / metres²
        Inverse variance of a coordinate.
    """
    frames = seen.shape[1]
    result = np.empty((frames, len(linkage.joints), 3, 3))
    for j, (parent, child) in enumerate(linkage.hierarchy.joint_bodies):
        covariance = np.zeros((frames, 3, 3))
        for b in (parent, child):
            mine = points.body == b
            lever = points.rest[mine] - linkage.joints[j]
            moment = (lever**2).sum(axis=1)[:, None, None] * np.eye(3) - lever[:, :, None] * lever[:, None, :]
            known = np.einsum("nt,n,nij->tij", seen[mine].astype(float), weights[mine], moment)
            known += 1e-3 * np.eye(3)
            turned = np.swapaxes(bodies.rotations[:, parent], 1, 2) @ bodies.rotations[:, b]
            covariance += turned @ np.linalg.inv(known) @ np.swapaxes(turned, 1, 2)
        result[:, j] = np.linalg.inv(covariance)
    return result


def find_hinges(linkage: Linkage, motion: JointMotion, information: np.ndarray, observations: np.ndarray) -> Linkage:
    """Linkage in which those joints are hinges whose turns about other axes the observations don't show.

    The axes of the other joints are those about which most of their turns are.

    A ball has two degrees of freedom more in each frame, a hinge has two for its axis. By the Bayesian information
    criterion it is a hinge if Σ φᵀ I φ over the turns φ about other axes is less than (2 T - 2) log n.

    Parameters
    ----------
    linkage : Linkage
    motion : JointMotion
        All joints free to turn as balls.
    information : (T, J, 3, 3) float
        See `turn_information`.
    observations : (J,) float
        Independent observations n of the two bodies of each joint.
    """
    axes, hinge = linkage.axes.copy(), linkage.hinge.copy()
    for j, child in enumerate(linkage.hierarchy.joint_bodies[:, 1]):
        axis, off = hinge_axis(motion.local[:, child], information[:, j])
        chi2 = float(np.einsum("ti,tij,tj->", off, information[:, j], off))
        hinge[j] = chi2 <= (2 * motion.frames - 2) * np.log(max(float(observations[j]), math.e))
        axes[j] = axis
    return replace(linkage, axes=axes, hinge=hinge)


def hinge_axis(turns: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axis about which most turns are, (3,), and the turns about other axes that are left, (T, 3), radians.

    The axis is where the turns since rest have their largest moment, then moved to where what is left weighs least
    (Gauss-Newton on its two angles).

    Parameters
    ----------
    turns : (T, 3, 3) float
        Since rest.
    information : (T, 3, 3) float
        Of each.
    """
    axis = main_axis(turns, np.trace(information, axis1=1, axis2=2))
    for _ in range(_ROUNDS):
        off = off_axis(turns, axis)
        across = np.linalg.svd(axis[None])[2][1:]
        slopes = np.stack([(off_axis(turns, _tilted(axis, c)) - off) / _TILT for c in across], axis=-1)
        normal = np.einsum("tia,tij,tjb->ab", slopes, information, slopes)
        right = -np.einsum("tia,tij,tj->a", slopes, information, off)
        axis = axis + np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(2) + 1e-12 * np.eye(2), right) @ across
        axis /= np.linalg.norm(axis)
    return axis, off_axis(turns, axis)


def main_axis(turns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Axis of the largest moment of turns (T, 3, 3), by the sines of half their angles, with weights (T,): (3,)."""
    half = Rotation.from_matrix(turns).as_quat(canonical=True)[:, :3]
    axis = np.linalg.eigh(np.einsum("t,ti,tj->ij", weights, half, half))[1][:, 2]
    return axis * (1.0 if axis[np.argmax(np.abs(axis))] > 0 else -1.0)


def _tilted(axis: np.ndarray, across: np.ndarray) -> np.ndarray:
    return np.cos(_TILT) * axis + np.sin(_TILT) * across


def off_axis(turns: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """What is left of turns (T, 3, 3) without those about an axis, (T, 3), radians."""
    return Rotation.from_matrix(turns @ np.swapaxes(about_axis(turns, axis), 1, 2)).as_rotvec()
