"""Refinement: motion, joints and shape of connected bodies, over all frames, against the paths of their samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from geomocap.bodies.motion_bodies import MotionBodies
from geomocap.model.motion_paths import DEPTH_FRACTION, MotionPaths, sure_part
from geomocap.model.skeleton import bone_fixed_skeleton
from geomocap.skeleton.articulated_adjustment import JointPrior, adjust
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.bone_motion import fit_offsets, forward_kinematics
from geomocap.skeleton.borders import Border
from geomocap.skeleton.hinges import find_hinges, off_axis, turn_information
from geomocap.skeleton.kinematics import (
    BodyMotion,
    JointMotion,
    Linkage,
    body_motion,
    joint_motion,
    posed,
    since,
)
from geomocap.skeleton.motion_skeleton import MotionSkeleton
from geomocap.skeleton.motion_skeleton_settings import RefinementSettings
from geomocap.skeleton.motion_smoothness import Smoothness, typical_accelerations

_MEDIAN_LENGTH = 1.54  # median length of a normal vector of three dimensions, standard deviations
_SETTLE_ROUNDS = 3


class Further(Protocol):
    """What else than paths tells of a motion."""

    def observe(self, bodies: BodyMotion) -> tuple[SkinPoints, Observations]:
        """Return points at rest, and what is observed of them, judged by the motion found so far."""

    def settle(self, pose: BodyMotion) -> None:
        """Take note of the pose, a single frame, that is the rest pose of what was found."""


@dataclass(frozen=True)
class RefinedMotion:
    """A refined motion, counted from frame 0.

    Attributes
    ----------
    linkage : Linkage
        In the pose of frame 0.
    bodies : BodyMotion
        Not quite held together by the joints, see `looseness` of `adjust`.
    points : SkinPoints
        The samples in the pose of frame 0, with their skin weights.
    sigma : (N,) float, metres
        How well each sample follows its bodies: standard deviation of a coordinate.
    """

    linkage: Linkage
    bodies: BodyMotion
    points: SkinPoints
    sigma: np.ndarray

    def joint_positions(self) -> np.ndarray:
        """Where the two bodies of each joint carry it, in the middle, (T, J, 3), metres, world."""
        ends = self.linkage.hierarchy.joint_bodies
        carried = [
            np.einsum("tjik,jk->tji", self.bodies.rotations[:, ends[:, e]], self.linkage.joints)
            + self.bodies.translations[:, ends[:, e]]
            for e in (0, 1)
        ]
        return 0.5 * (carried[0] + carried[1])


def refine_skeleton(
    found: MotionSkeleton,
    bodies: MotionBodies,
    paths: MotionPaths,
    settings: RefinementSettings | None = None,
    further: Further | None = None,
) -> tuple[MotionSkeleton, MotionBodies]:
    """Refine a skeleton and the bodies that it connects.

    Parameters
    ----------
    found : MotionSkeleton
    bodies : MotionBodies
        Of the samples of `paths`.
    paths : MotionPaths
    settings : RefinementSettings, optional
    further : Further, optional
        More observations than those of the paths.

    Returns
    -------
    MotionSkeleton
    MotionBodies
        With refined motion, rest and weights; labels stay.
    """
    settings = settings or RefinementSettings()
    if settings.rounds == 0:
        return found, bodies
    linkage, motion = linkage_of(found)
    points = SkinPoints.of_weights(bodies.rest, bodies.weights)
    misses = np.array([joint.miss for joint in found.joints])
    refined = refine_motion(linkage, motion, points, paths, bodies.diagonal, settings, misses, further)
    refined = replace(refined, linkage=joints_by_shape(refined.linkage, refined.bodies, found.borders, bodies.noise))
    bodies = replace(
        bodies,
        weights=refined.points.weights(bodies.body_count),
        rotations=refined.bodies.rotations,
        translations=refined.bodies.translations,
        rest=refined.points.rest,
    )
    middle = np.stack([bodies.rest[bodies.label == b].mean(axis=0) for b in range(bodies.body_count)])
    centers, root = bodies.centers, linkage.hierarchy.root
    # Bones that keep their length, their joints as near as can be to where bodies meet
    places = refined.joint_positions()
    offsets, _ = fit_offsets(linkage.hierarchy, bodies.rotations, centers[:, root], places, centers)
    local = linkage.hierarchy.local_rotations(bodies.rotations)
    places, _ = forward_kinematics(linkage.hierarchy, offsets, local, centers[:, root])
    skeleton = bone_fixed_skeleton(
        linkage.hierarchy, places[0], bodies.rotations, places, centers, middle, found.skeleton.fps
    )
    joints = tuple(
        replace(joint, point=point, axis=axis, hinge=bool(hinge))
        for joint, point, axis, hinge in zip(
            found.joints, places[0], refined.linkage.axes, refined.linkage.hinge, strict=True
        )
    )
    return replace(found, skeleton=skeleton, joints=joints), bodies


def joints_by_shape(linkage: Linkage, bodies: BodyMotion, borders: tuple[Border, ...], noise: float) -> Linkage:
    """Linkage whose joints are, along their axes, where motion and the bodies' shapes together say.

    Where bodies turn about one axis, points along it are told apart by the turns about other axes alone: a joint is
    known to the noise of the surface over these turns, however often it is seen, as soft skin errs alike each time.
    The shapes know it to the spread of the border. In a hinge the motion leaves it open.

    Parameters
    ----------
    linkage, bodies
        Refined.
    borders : tuple of Border
        Of each joint's bodies.
    noise : float, metres
        Root mean square by which the surface misses where it goes.
    """
    places = []
    for j, (joint, axis, border) in enumerate(zip(linkage.joints, linkage.axes, borders, strict=True)):
        parent, child = linkage.hierarchy.joint_bodies[j]
        turns = np.swapaxes(bodies.rotations[:, parent], 1, 2) @ bodies.rotations[:, child]
        across = 0.0 if linkage.hinge[j] else float(off_axis(turns, axis).var(axis=0).sum())
        by_shape = noise**2 / max(noise**2 + across * border.spread**2, 1e-18)
        places.append(joint + by_shape * (border.middle_along(joint, axis) - joint))
    return replace(linkage, joints=np.array(places).reshape(-1, 3))


def linkage_of(found: MotionSkeleton) -> tuple[Linkage, JointMotion]:
    """Linkage of a skeleton, all joints balls, and its motion."""
    skeleton = found.skeleton
    axes = np.array([joint.axis / np.linalg.norm(joint.axis) for joint in found.joints]).reshape(-1, 3)
    linkage = Linkage(
        skeleton.hierarchy,
        skeleton.joint_positions[0],
        axes,
        np.zeros(len(axes), bool),
        skeleton.body_positions[0, skeleton.root],
    )
    return linkage, joint_motion(linkage, skeleton.body_rotations, skeleton.body_positions[:, skeleton.root])


def refine_motion(
    linkage: Linkage,
    motion: JointMotion,
    points: SkinPoints,
    paths: MotionPaths,
    diagonal: float,
    settings: RefinementSettings | None = None,
    misses: np.ndarray | None = None,
    further: Further | None = None,
) -> RefinedMotion:
    """Find, by turns, the shape at rest, and the motion of all frames together with the joints.

    Skin weights stay: fitted anew in each round they changed nothing. (18 sets of paths of 13 captures: core index 0.88
    both, error of the joints 2.2 % of the height both, rotations 5.0° both; models overlapped silhouettes as much.)

    Each sample counts by how well it follows its bodies, so that soft skin has little say. In frames without
    observations the temporal prior carries the motion on.

    Parameters
    ----------
    linkage, motion
        Start.
    points : SkinPoints
        The samples, at rest.
    paths : MotionPaths
        What was seen of them.
    diagonal : float, metres
        Of the subject.
    settings : RefinementSettings, optional
    misses : (J,) float, metres, optional
        How far the bodies, each by itself, carry each joint apart. A joint may slip by as much, and by what it still
        does after each round: one that is none, as a body between was not found, doesn't bend its bodies' motion.
    further : Further, optional
        More observations than those of the paths, in each round.
    """
    settings = settings or RefinementSettings()
    prior = JointPrior(linkage.joints, settings.joint_sigma * diagonal)
    least = settings.noise * diagonal
    tightest = np.full(len(linkage.joints), settings.least_slip * diagonal)
    looseness = tightest if misses is None else np.maximum(misses, tightest)
    bodies = body_motion(linkage, motion)
    sigma = _sample_sigma(bodies, points, paths, least)
    for k in range(settings.rounds):
        # Shape of the motion so far
        points = _settled(points, bodies, paths, settings.cutoff * sigma)
        sigma = _sample_sigma(bodies, points, paths, least)
        if k == settings.rounds - 1:
            linkage = _with_hinges(linkage, motion, bodies, points, paths, sigma, settings.independence)
            motion = replace(joint_motion(linkage, bodies.rotations, motion.root), slip=motion.slip)
        # Motion and joints of the shape so far
        spread = np.broadcast_to(sigma[:, None] / np.sqrt(settings.independence), paths.seen.shape)
        depth = DEPTH_FRACTION if further is None else 0.0  # silhouettes know it better
        everything, seen = points, Observations.of_paths(paths.positions, spread, ray=paths.ray, depth=depth)
        if further is not None:
            more, told = further.observe(bodies)
            everything, seen = points.joined(more), seen.joined(told.renumbered(len(points)))
        adjusted = adjust(
            linkage,
            motion,
            everything,
            seen,
            smoothness=smoothness_of(linkage, motion, diagonal, settings),
            joint_prior=prior,
            looseness=looseness,
            cutoff=settings.cutoff,
            rounds=settings.steps,
        )
        linkage, motion, bodies = adjusted.linkage, adjusted.motion, adjusted.bodies
        assert motion.slip is not None
        slips = np.sqrt((motion.slip**2).sum(axis=2).mean(axis=0) / 3.0)
        looseness = np.clip(slips, tightest, looseness)
    start = bodies.part(slice(0, 1))
    if further is not None:
        further.settle(start)
    first = start.carry(points.rest, points.bodies, points.fractions)[0]
    return RefinedMotion(posed(linkage, bodies, 0), since(bodies, 0), replace(points, rest=first), sigma)


def _with_hinges(
    linkage: Linkage,
    motion: JointMotion,
    bodies: BodyMotion,
    points: SkinPoints,
    paths: MotionPaths,
    sigma: np.ndarray,
    independence: float,
) -> Linkage:
    """Linkage whose hinges are those that the observations can't tell from hinges."""
    information = turn_information(linkage, bodies, points, paths.seen, independence / sigma**2)
    shown = np.bincount(points.body, paths.seen.sum(axis=1), linkage.body_count)
    observations = independence * shown[linkage.hierarchy.joint_bodies].sum(axis=1)
    return find_hinges(linkage, motion, information, observations)


def smoothness_of(linkage: Linkage, motion: JointMotion, diagonal: float, settings: RefinementSettings) -> Smoothness:
    """Temporal prior whose scales are the accelerations that the motion has, medians over time, above the floors."""
    turn, shift = typical_accelerations(linkage, motion)
    return Smoothness(
        np.maximum(turn, np.deg2rad(settings.least_turn_deg)),
        max(shift, settings.least_shift * diagonal),
        settings.cutoff,
    )


def _misses(bodies: BodyMotion, points: SkinPoints, paths: MotionPaths) -> np.ndarray:
    """Distances of what was seen from where the bodies carry the points, (N, T), metres; NaN where not seen."""
    carried = bodies.carry(points.rest, points.bodies, points.fractions).swapaxes(0, 1)
    return np.linalg.norm(sure_part(carried - paths.positions, paths.ray), axis=2)


def _trust(bodies: BodyMotion, points: SkinPoints, paths: MotionPaths, cutoff: np.ndarray) -> np.ndarray:
    """Weights of the observations by their misses, (N, T): a half at the cutoff (Cauchy); 0 where not seen."""
    miss = _misses(bodies, points, paths)
    return np.where(paths.seen, 1.0 / (1.0 + (np.where(paths.seen, miss, 0.0) / cutoff[:, None]) ** 2), 0.0)


def _sample_sigma(bodies: BodyMotion, points: SkinPoints, paths: MotionPaths, least: float) -> np.ndarray:
    """Standard deviation of a coordinate of each sample, (N,): what is stated, and how well it follows its bodies."""
    follows = np.nanmedian(_misses(bodies, points, paths), axis=1) / _MEDIAN_LENGTH
    return np.maximum(np.hypot(paths.typical_sigma(), follows), least)


def _settled(points: SkinPoints, bodies: BodyMotion, paths: MotionPaths, cutoff: np.ndarray) -> SkinPoints:
    """Points with the places at rest that fit the motion best: least squares over the frames, robust."""
    frames, count = len(bodies.rotations), len(points)
    matrix, offset = np.zeros((frames, count, 3, 3)), np.zeros((frames, count, 3))
    for k in range(points.bodies.shape[1]):
        matrix += points.fractions[:, k, None, None] * bodies.rotations[:, points.bodies[:, k]]
        offset += points.fractions[:, k, None] * bodies.translations[:, points.bodies[:, k]]
    target = np.where(paths.seen[..., None], paths.positions, 0.0).swapaxes(0, 1) - offset
    counted = matrix
    if paths.ray is not None:
        ray = paths.ray.swapaxes(0, 1)
        along = (1.0 - DEPTH_FRACTION**2) * (ray[:, :, None] @ matrix)
        counted = matrix - ray[..., None] * along
    rest = points.rest
    for _ in range(_SETTLE_ROUNDS):
        trust = _trust(bodies, replace(points, rest=rest), paths, cutoff).T
        turned = (trust[..., None, None] * counted).swapaxes(2, 3)
        normal = (turned @ matrix).sum(axis=0) + 1e-3 * np.eye(3)
        right = (turned @ target[..., None]).sum(axis=0)[..., 0] + 1e-3 * rest
        rest = np.linalg.solve(normal, right[..., None])[..., 0]
    return replace(points, rest=rest)
