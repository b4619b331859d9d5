"""The first pose of a sequence: many starts, fitted all at once, the best of them again and better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.skeleton.articulated_adjustment import adjust
from geomocap.skeleton.kinematics import JointMotion, Linkage, body_motion
from geomocap.skeleton.motion_smoothness import PosePrior
from geomocap.subject.subject_model import SubjectModel
from geomocap.subject.surface_matching import FrameSurface, MatchingScales, ModelSurface, match_surfaces, misfit

HEADINGS = 12  # turns about the vertical from which the search starts
TRIED = 32  # starts that are fitted
KEPT = (6, 4, 3, 2)  # of these, fitted better and better
_COARSE_POINTS = 300
_COARSE_ROUNDS = 10
_COARSE_TURN = 0.2  # radians: how far joints may leave a pose seen
_FINE_TURN = 1.0
_FINE_ROUNDS = 10
_ANNEALING = (0.04, 0.02, 0.01, 0.0)  # standard deviation of the surface in the fine fits at least, diagonals


def find_pose(
    model: SubjectModel, surface: ModelSurface, frames: Sequence[FrameSurface], scales: MatchingScales, up: int
) -> tuple[int, JointMotion]:
    """Frame in which a model fits best, of some of which nothing is known before, and its pose there.

    Starts are the poses that the model has been seen in, turned about the vertical and to the frame's principal axes,
    centre on centre. All are fitted at once with few points, their joints held near the pose seen; those of least
    misfit, of all frames, again with all points and freer joints.

    Parameters
    ----------
    model : SubjectModel
    surface : ModelSurface
        Its points that are fitted.
    frames : sequence of FrameSurface
    scales : MatchingScales
    up : int
        World axis that points up.

    Returns
    -------
    int
        Which of the frames.
    JointMotion
        Of one frame.
    """
    linkage = model.linkage
    coarse = ModelSurface.of_model(model, _COARSE_POINTS, surface.colors is not None)
    wide = replace(scales, sigma=max(_ANNEALING[0] * model.diagonal, scales.sigma))
    tried = []
    for frame in frames:
        starts = _starts(model, coarse, frame, up)
        starts = _best(starts, _misfits(linkage, starts, coarse, [frame] * starts.frames, scales), TRIED)
        prior = PosePrior(starts, _COARSE_TURN, np.pi, model.diagonal)
        tried.append(fit_pose(linkage, starts, coarse, [frame] * starts.frames, wide, prior, _COARSE_ROUNDS))
    found = JointMotion(*(np.concatenate([getattr(t, name) for t in tried]) for name in ("local", "root")))
    number = np.repeat(np.arange(len(frames)), [t.frames for t in tried])
    for fraction, kept in zip(_ANNEALING, KEPT, strict=True):
        misfits = _misfits(linkage, found, surface, [frames[n] for n in number.tolist()], scales)
        best = np.sort(np.argsort(misfits, kind="stable")[:kept])
        found, number = JointMotion(found.local[best], found.root[best]), number[best]
        prior = PosePrior(found, _FINE_TURN, np.pi, model.diagonal)
        sharper = replace(scales, sigma=max(fraction * model.diagonal, scales.sigma))
        found = fit_pose(linkage, found, surface, [frames[n] for n in number.tolist()], sharper, prior, _FINE_ROUNDS)
    chosen = int(np.argmin(_misfits(linkage, found, surface, [frames[n] for n in number.tolist()], scales)))
    return int(number[chosen]), found.part(slice(chosen, chosen + 1))


def fit_pose(
    linkage: Linkage,
    motion: JointMotion,
    surface: ModelSurface,
    frames: list[FrameSurface],
    scales: MatchingScales,
    prior: PosePrior,
    rounds: int,
    least_turn: float = 1e-3,
) -> JointMotion:
    """Articulated iterative closest points, each frame by itself.

    Parameters
    ----------
    linkage, motion
        Start.
    surface : ModelSurface
    frames : list of FrameSurface
        One for each frame of the motion.
    scales : MatchingScales
    prior : PosePrior
    rounds : int
        Times that nearest points are found anew, at most.
    least_turn : float, radians
        Stop when no body turns more in a round.
    """
    bodies = body_motion(linkage, motion)
    for _ in range(rounds):
        observations = match_surfaces(surface, surface.posed(bodies), frames, scales)
        fitted = adjust(linkage, motion, surface.skin, observations, pose_prior=prior, rounds=1)
        change = np.abs(fitted.bodies.rotations - bodies.rotations).max()
        motion, bodies = fitted.motion, fitted.bodies
        if change < least_turn:
            break
    return motion


def _starts(model: SubjectModel, coarse: ModelSurface, frame: FrameSurface, up: int) -> JointMotion:
    """Poses seen, in all headings and along the frame's principal axes, centred on the frame."""
    linkage = model.linkage
    count, root = len(model.poses), model.root
    seen = JointMotion(model.poses, np.tile(linkage.origin, (count, 1)))
    places = [s.points for s in coarse.posed(body_motion(linkage, seen))]
    middle = frame.points.mean(axis=0)
    axis = np.eye(3)[up]
    headings = Rotation.from_rotvec(np.arange(HEADINGS)[:, None] * (2 * np.pi / HEADINGS) * axis).as_matrix()
    local, path = [], []
    for k in range(count):
        own = places[k].mean(axis=0)
        for turn in [*headings, *_aligning(places[k], frame.points)]:
            pose = model.poses[k].copy()
            pose[root] = turn @ pose[root]
            local.append(pose)
            path.append(middle + turn @ (linkage.origin - own))
    return JointMotion(np.array(local), np.array(path))


def _aligning(points: np.ndarray, others: np.ndarray) -> list[np.ndarray]:
    """The four rotations that turn the principal axes of points to those of others."""
    one, two = (np.linalg.eigh(np.cov(p.T))[1] for p in (points, others))
    turns = []
    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        flipped = two * np.array([*signs, 1.0])
        turn = flipped @ one.T
        if np.linalg.det(turn) < 0:
            turn = (two * np.array([*signs, -1.0])) @ one.T
        turns.append(turn)
    return turns


def _best(motion: JointMotion, misfits: np.ndarray, count: int) -> JointMotion:
    """Those of least misfit, in their order."""
    best = np.sort(np.argsort(misfits, kind="stable")[:count])
    return JointMotion(motion.local[best], motion.root[best])


def _misfits(
    linkage: Linkage,
    motion: JointMotion,
    surface: ModelSurface,
    frames: Sequence[FrameSurface],
    scales: MatchingScales,
) -> np.ndarray:
    posed = surface.posed(body_motion(linkage, motion))
    return np.array([misfit(one, frame, scales) for one, frame in zip(posed, frames, strict=True)])
