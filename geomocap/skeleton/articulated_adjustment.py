"""Articulated adjustment: degrees of freedom of all frames, and the joints' places, by least squares together.

Levenberg–Marquardt. The normal equations are banded in time (the temporal prior reaches two frames back), with the
joints' places, which all frames share, as a border (Triggs et al., Bundle Adjustment, 2000, section 6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from geomocap.scheduling import spread
from geomocap.skeleton.adjustment_kernel import normal_equations
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, body_motion, moved_by
from geomocap.skeleton.motion_smoothness import PosePrior, Smoothness, pose_terms, prior_terms

_FEW = 4  # frames that are not worth waking the other threads for
_CHUNK = 64  # frames whose blocks are in memory at once
_LEAST_DAMPING = 1e-6
_MOST_DAMPING = 1e6
_LONGEST_TURN = 0.5  # radians, in one step


@dataclass(frozen=True)
class JointPrior:
    """Where joints are expected.

    Attributes
    ----------
    joints : (J, 3) float, metres
        At rest.
    sigma : float, metres
    """

    joints: np.ndarray
    sigma: float


@dataclass(frozen=True)
class Adjusted:
    """Result of an adjustment.

    Attributes
    ----------
    linkage : Linkage
    motion : JointMotion
    bodies : BodyMotion
    cost : float
        Half the robust sum of squares of all standardised residuals.
    """

    linkage: Linkage
    motion: JointMotion
    bodies: BodyMotion
    cost: float


def adjust(
    linkage: Linkage,
    motion: JointMotion,
    points: SkinPoints,
    observations: Observations,
    *,
    smoothness: Smoothness | None = None,
    pose_prior: PosePrior | None = None,
    joint_prior: JointPrior | None = None,
    looseness: np.ndarray | None = None,
    cutoff: float = 3.0,
    rounds: int = 10,
    least_gain: float = 1e-4,
) -> Adjusted:
    """Find the motion, and with a prior for them the joints, that fit the observations best.

    Parameters
    ----------
    linkage, motion
        Start.
    points : SkinPoints
    observations : Observations
    smoothness : Smoothness, optional
        Temporal prior; without it every frame is by itself.
    pose_prior : PosePrior, optional
        What is expected of each frame.
    joint_prior : JointPrior, optional
        Joints are unknowns, too; without it they stay.
    looseness : (J,) float, metres, optional
        Standard deviation of the joints' slips, which also change slowly; without it joints hold.
    cutoff : float
        Residuals of this many standard deviations count half (Cauchy).
    rounds : int
        Steps at most.
    least_gain : float
        Stop when a step lowers the cost by a smaller fraction.
    """
    damping = 1e-4
    priors = (smoothness, pose_prior, joint_prior, looseness)
    if looseness is None:
        motion = replace(motion, slip=None)
    elif motion.slip is None:
        motion = replace(motion, slip=np.zeros((motion.frames, len(linkage.joints), 3)))
    system = _system(linkage, motion, points, observations, priors, cutoff)
    for _ in range(rounds):
        improved = False
        while damping <= _MOST_DAMPING:
            step, shift = system.solve(damping)
            trial = moved_by(linkage, motion, step)
            bent = replace(linkage, joints=linkage.joints + shift) if joint_prior is not None else linkage
            attempt = _system(bent, trial, points, observations, priors, cutoff)
            if attempt.cost < system.cost:
                improved = True
                break
            damping *= 10.0
        if not improved:
            break
        gain = 1.0 - attempt.cost / system.cost
        linkage, motion, system = bent, trial, attempt
        damping = max(damping / 10.0, _LEAST_DAMPING)
        if gain < least_gain:
            break
    return Adjusted(linkage, motion, body_motion(linkage, motion), system.cost)


@dataclass(frozen=True)
class _System:
    """Normal equations: `blocks` (T, D, D), `border` (T, D, G) and `corner` (G, G), right sides, and the prior.

    Degrees of freedom before `turns` are of the root and turns of the joints; those from there on are slips.
    """

    blocks: np.ndarray
    border: np.ndarray
    corner: np.ndarray
    right: np.ndarray
    corner_right: np.ndarray
    prior: np.ndarray | None
    cost: float
    turns: int

    def solve(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Steps of the degrees of freedom, (T, D), and of the joints, (J, 3)."""
        frames, size = self.right.shape
        bands = self._bands(damping)
        factor = cholesky_banded(bands, overwrite_ab=True, check_finite=False)
        sides = np.concatenate([self.right.reshape(-1, 1), self.border.reshape(frames * size, -1)], axis=1)
        solved = cho_solve_banded((factor, False), sides, check_finite=False)
        step, shift = solved[:, 0], np.zeros(0)
        if len(self.corner):
            border = self.border.reshape(frames * size, -1)
            reduced = self.corner - border.T @ solved[:, 1:]
            reduced[np.diag_indices_from(reduced)] += damping * np.diag(self.corner)
            shift = cho_solve(cho_factor(reduced), self.corner_right - border.T @ step)
            step = step - solved[:, 1:] @ shift
        step = step.reshape(frames, size)
        turns = np.r_[0:3, 6 : self.turns]
        step[:, turns] = np.clip(step[:, turns], -_LONGEST_TURN, _LONGEST_TURN)
        return step, shift.reshape(-1, 3)

    def _bands(self, damping: float) -> np.ndarray:
        """Upper banded form of the damped matrix of the degrees of freedom."""
        frames, size = self.right.shape
        reach = 2 if self.prior is not None else 0
        width = reach * size if reach else size - 1
        bands = np.zeros((width + 1, frames * size))
        diagonal = np.einsum("tii->ti", self.blocks).copy()
        by_frame = bands.reshape(width + 1, frames, size)
        for i in range(size):
            columns = np.arange(i, size)
            by_frame[width + i - columns, :, columns] = self.blocks[:, i, i:].T
        if self.prior is not None:
            w = self.prior
            diagonal[:-2] += w
            diagonal[1:-1] += 4.0 * w
            diagonal[2:] += w
            by_frame[width - size, 1:-1] -= 2.0 * w
            by_frame[width - size, 2:] -= 2.0 * w
            by_frame[width - 2 * size, 2:] += w
        largest = diagonal.max(axis=0)  # of turns and shifts apart: these depend on the unit of length
        least = 1e-9 * np.where(largest > 0, largest, 1.0)
        by_frame[width] = diagonal * (1.0 + damping) + least
        return bands


def _system(
    linkage: Linkage,
    motion: JointMotion,
    points: SkinPoints,
    observations: Observations,
    priors: tuple[Smoothness | None, PosePrior | None, JointPrior | None, np.ndarray | None],
    cutoff: float,
) -> _System:
    smoothness, pose_prior, joint_prior, looseness = priors
    bodies = body_motion(linkage, motion)
    turns = int(linkage.joint_dof[-1])
    size = turns + (3 * len(linkage.joints) if looseness is not None else 0)
    shared = 3 * len(linkage.joints) if joint_prior is not None else 0
    chains = _unknowns_of_bodies(linkage, looseness is not None, joint_prior is not None)
    frames = motion.frames
    blocks, right = np.empty((frames, size, size)), np.empty((frames, size))
    border = np.empty((frames, size, shared))
    corner, corner_right, cost = np.zeros((shared, shared)), np.zeros(shared), 0.0
    for low in range(0, frames, _CHUNK):
        some = slice(low, min(low + _CHUNK, frames))
        part = bodies.part(some)
        count = some.stop - some.start
        matrix, sides = np.zeros((count, size + shared, size + shared)), np.zeros((count, size + shared))
        costs = np.empty(count)
        spread(
            normal_equations,
            count,
            (part.rotations, part.translations, _twists(linkage, motion.part(some), part, joint_prior is not None)),
            chains,
            points.arrays,
            observations.arrays(some),
            cutoff,
            matrix,
            sides,
            costs,
            few=_FEW,
        )
        blocks[some], border[some] = matrix[:, :size, :size], matrix[:, :size, size:]
        right[some] = sides[:, :size]
        corner += matrix[:, size:, size:].sum(axis=0)
        corner_right += sides[:, size:].sum(axis=0)
        cost += float(costs.sum())
    prior = None
    if smoothness is not None and frames > 2:
        prior, value, prior_cost = prior_terms(linkage, motion, smoothness, looseness)
        push = prior * value
        right[:-2] -= push
        right[1:-1] += 2.0 * push
        right[2:] -= push
        cost += prior_cost
    if pose_prior is not None:
        weights, away, pose_cost = pose_terms(linkage, motion, pose_prior)
        blocks[:, np.arange(turns), np.arange(turns)] += weights
        right[:, :turns] -= weights * away
        cost += pose_cost
    if joint_prior is not None:
        weight = joint_prior.sigma**-2
        apart = linkage.joints - joint_prior.joints
        corner[np.diag_indices(shared)] += weight
        corner_right -= weight * apart.ravel()
        cost += 0.5 * weight * float((apart**2).sum())
    if looseness is not None:
        assert motion.slip is not None
        tightness = np.repeat(looseness**-2.0, 3)
        slip = motion.slip.reshape(frames, -1)
        blocks[:, np.arange(turns, size), np.arange(turns, size)] += tightness
        right[:, turns:] -= tightness * slip
        cost += 0.5 * float((tightness * slip**2).sum())
    return _System(blocks, border, corner, right, corner_right, prior, cost, turns)


def _unknowns_of_bodies(linkage: Linkage, with_slips: bool, with_joints: bool) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns that move each body: degrees of freedom and, after all of these, the places of joints."""
    first = linkage.joint_dof
    lists = []
    for row in linkage.chains():
        joints = np.flatnonzero(row)
        unknowns = [np.arange(6), *(np.arange(first[j], first[j + 1]) for j in joints)]
        last = first[-1]
        for present in (with_slips, with_joints):
            if present:
                unknowns += [last + 3 * j + np.arange(3) for j in joints]
                last += 3 * len(linkage.joints)
        lists.append(np.concatenate(unknowns))
    return np.concatenate(lists), np.concatenate([[0], np.cumsum([len(u) for u in lists])])


def _twists(linkage: Linkage, motion: JointMotion, bodies: BodyMotion, with_joints: bool) -> np.ndarray:
    """Twists (T, K, 6) of all unknowns, see `normal_equations`."""
    first = linkage.joint_dof
    frames, count = motion.frames, 3 * len(linkage.joints)
    slips = int(first[-1])
    places = slips + (0 if motion.slip is None else count)
    twists = np.zeros((frames, places + (count if with_joints else 0), 6))
    twists[:, :3, :3] = np.eye(3)
    twists[:, :3, 3:] = np.cross(motion.root[:, None], np.eye(3))
    twists[:, 3:6, 3:] = np.eye(3)
    for j, (parent, child) in enumerate(linkage.hierarchy.joint_bodies):
        turned = bodies.rotations[:, parent]
        axes = (turned @ linkage.axes[j])[:, None] if linkage.hinge[j] else turned.swapaxes(1, 2)
        place = bodies.rotations[:, child] @ linkage.joints[j] + bodies.translations[:, child]
        twists[:, first[j] : first[j + 1], :3] = axes
        twists[:, first[j] : first[j + 1], 3:] = np.cross(place[:, None], axes)
        if motion.slip is not None:
            twists[:, slips + 3 * j : slips + 3 * j + 3, 3:] = turned.swapaxes(1, 2)
        if with_joints:
            at = places + 3 * j
            twists[:, at : at + 3, 3:] = (turned - bodies.rotations[:, child]).swapaxes(1, 2)
    return twists
