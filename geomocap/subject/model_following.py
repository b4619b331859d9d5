"""A known subject in a sequence: its model is found in a frame, followed, and fitted to all frames together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.bodies.body_settings import FOLLOWED
from geomocap.errors import GeometryError
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.rotations import turn_angles
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_here
from geomocap.skeleton.articulated_adjustment import adjust
from geomocap.skeleton.body_observations import Observations, SkinPoints
from geomocap.skeleton.kinematics import BodyMotion, JointMotion, Linkage, body_motion
from geomocap.skeleton.motion_smoothness import PosePrior, Smoothness, typical_accelerations
from geomocap.subject.following_settings import FollowingSettings
from geomocap.subject.pose_search import find_pose, fit_pose
from geomocap.subject.sequence_paths import attach_paths, turned_by_paths
from geomocap.subject.subject_model import SubjectModel
from geomocap.subject.surface_matching import (
    FrameSurface,
    MatchingScales,
    ModelSurface,
    distance_between,
    match_surfaces,
    misfit,
)

_STAGE = "model"
_REACH = 3.0  # standard deviations of the surface
_PATH_ROUNDS = 2  # the second with what the first has put right
# Of the motion, followed side by side: with one, a dancer's folded arm was lost for the last 30 of 107 frames; with
# three it was found again. More weren't tried, as each costs as much time as the first.
_HYPOTHESES = 3
_DISTINCT = np.deg2rad(10.0)  # turn of some body against its parent that makes two poses of one; not tuned


@dataclass(frozen=True)
class FollowedSequence:
    """Motion of a model's bodies in a sequence.

    Attributes
    ----------
    bodies : BodyMotion
        From the model's rest pose.
    distance : (T,) float, metres
        Between the model's surface and each frame's: root mean square of both directions.
    first_frame : int
        Where the model was found.
    """

    bodies: BodyMotion
    distance: np.ndarray
    first_frame: int


def follow_model(
    model: SubjectModel,
    read: Callable[[int], tuple[np.ndarray, np.ndarray | None]],
    frames: int,
    spacing: float,
    up: int,
    paths: MotionPaths | None = None,
    settings: FollowingSettings | None = None,
    progress: Progress = silent,
    known: tuple[int, JointMotion] | None = None,
) -> FollowedSequence:
    """Follow a model through a sequence.

    Parameters
    ----------
    model : SubjectModel
    read : callable
        `read(frame) -> (points (N, 3) metres, colors (N, 3) 0 to 1 or None)`.
    frames : int
    spacing : float, metres
        Distance of neighbouring points.
    up : int
        World axis that points up.
    paths : MotionPaths, optional
        Points of the surface that were tracked in this sequence; they keep it from sliding.
    settings : FollowingSettings, optional
    progress : Progress
    known : tuple of int and JointMotion, optional
        A frame and its pose, from where the model is followed both ways; else it is looked for in some frames.

    Raises
    ------
    GeometryError
        If a frame holds too few points.
    """
    settings = settings or FollowingSettings()
    sequence = _Sequence.of(model, read, frames, spacing, settings)
    if known is None:
        asked = np.unique(np.linspace(0, frames, settings.start_frames, endpoint=False).astype(int)).tolist()
        views = [sequence.views[t] for t in asked]
        best, pose = find_pose(model, sequence.surface, views, sequence.scales, up)
        first = asked[best]
    else:
        first, pose = known
    progress(_STAGE, 1, frames + 1)
    # Frame by frame, both ways; where paths tell how bodies turn, one hypothesis will do
    count = _HYPOTHESES if paths is None else 1
    pieces: dict[int, JointMotion] = {first: pose}
    for order in (range(first + 1, frames), range(first - 1, -1, -1)):
        for t in _through(sequence, pieces, order, count):
            progress(_STAGE, 1 + abs(t - first), frames + 1)
    return sequence.fitted_together(pieces, paths, first, progress)


@dataclass(frozen=True)
class _Sequence:
    """A model's surface and those of the frames that it is fitted to."""

    model: SubjectModel
    surface: ModelSurface
    views: list[FrameSurface]
    scales: MatchingScales
    settings: FollowingSettings

    @classmethod
    def of(
        cls,
        model: SubjectModel,
        read: Callable[[int], tuple[np.ndarray, np.ndarray | None]],
        frames: int,
        spacing: float,
        settings: FollowingSettings,
    ) -> _Sequence:
        diagonal = model.diagonal
        scales = MatchingScales(
            settings.normal * diagonal,
            settings.color * diagonal,
            settings.reach * diagonal,
            max(spacing, model.spacing / 2),
            settings.along,
            settings.independence,
        )
        views = map_here(lambda t: _view(*read(t), t, spacing, scales, settings.points), range(frames))
        colored = all(v.sought.colors is not None for v in views)
        return cls(model, ModelSurface.of_model(model, settings.points, colored), views, scales, settings)

    def fitted(self, expected: JointMotion, frame: int) -> JointMotion:
        """Pose of a frame that fits its surface, near the one expected."""
        s = self.settings
        prior = PosePrior(expected, np.deg2rad(s.turn_deg), np.deg2rad(2 * s.turn_deg), self.model.diagonal)
        view = [self.views[frame]]
        return fit_pose(self.model.linkage, expected, self.surface, view, self.scales, prior, s.steps)

    def fitted_with_misfit(self, expected: JointMotion, frame: int) -> tuple[JointMotion, float]:
        """The same, and by what it misses the surface."""
        pose = self.fitted(expected, frame)
        return pose, self.misfit(pose, frame)

    def misfit(self, pose: JointMotion, frame: int) -> float:
        """By what a pose misses a frame's surface."""
        (placed,) = self.surface.posed(body_motion(self.model.linkage, pose))
        return misfit(placed, self.views[frame], self.scales)

    def fitted_together(
        self, pieces: dict[int, JointMotion], paths: MotionPaths | None, first: int, progress: Progress
    ) -> FollowedSequence:
        """Fit the poses of all frames together."""
        frames = len(self.views)
        parts = [pieces[t] for t in range(frames)]
        motion = JointMotion(np.concatenate([p.local for p in parts]), np.concatenate([p.root for p in parts]))
        motion = _fit_all(self.model, self.surface, motion, self.views, self.scales, paths, self.settings)
        bodies = body_motion(self.model.linkage, motion)
        posed = self.surface.posed(bodies)
        pairs = list(zip(posed, self.views, strict=True))
        distance = np.array(map_here(lambda pair: distance_between(*pair), pairs))
        progress(_STAGE, frames + 1, frames + 1)
        return FollowedSequence(bodies, distance, first)


@dataclass(frozen=True)
class _Hypothesis:
    """A motion up to a frame: the pose there, what led to it, and by what all its poses miss their frames."""

    pose: JointMotion
    before: _Hypothesis | None
    cost: float

    @property
    def expected(self) -> JointMotion:
        """Pose that follows at the same pace."""
        return _carried_on(self.pose, None if self.before is None else self.before.pose)


def _through(sequence: _Sequence, pieces: dict[int, JointMotion], order: range, count: int) -> Iterator[int]:
    """Fill in the poses of frames in their order, from that of the frame before, and yield each frame that is done.

    Several hypotheses go side by side, and the one that misses all frames least is taken (beam search; of multiple
    hypotheses in tracking: Reid 1979; of people: Cham, Rehg 1999). A new one begins in each frame with the pose seen
    before that suits the frame best: so a limb that was lost behind another is found again, and what is found for a
    moment only, by mistake, is given up.
    """
    if not len(order):
        return
    start = order[0] - order.step
    earlier = pieces.get(start - order.step)
    beam = [_Hypothesis(pieces[start], None if earlier is None else _Hypothesis(earlier, None, 0.0), 0.0)]
    for t in order:
        starts = [(h, h.expected) for h in beam]
        if count > 1:
            starts.append((beam[0], _seen_pose(sequence, beam[0].expected, t)))
        if count > 1:
            tried = map_here(partial(sequence.fitted_with_misfit, frame=t), [pose for _, pose in starts])
        else:
            tried = [(sequence.fitted(starts[0][1], t), 0.0)]
        found = [_Hypothesis(pose, h, h.cost + miss) for (h, _), (pose, miss) in zip(starts, tried, strict=True)]
        beam = []
        for one in sorted(found, key=lambda h: h.cost):
            if len(beam) < count and all(_differ(one.pose, other.pose) for other in beam):
                beam.append(one)
        yield t
    best: _Hypothesis | None = beam[0]
    for t in reversed(order):
        assert best is not None
        pieces[t], best = best.pose, best.before


def _seen_pose(sequence: _Sequence, expected: JointMotion, frame: int) -> JointMotion:
    """Of the poses that the model was seen in, as the root is turned now, the one that misses a frame least."""
    root = sequence.model.root
    poses = []
    for seen in sequence.model.poses:
        local = seen[None].copy()
        local[:, root] = expected.local[:, root]
        poses.append(JointMotion(local, expected.root))
    return poses[int(np.argmin([sequence.misfit(pose, frame) for pose in poses]))]


def _differ(one: JointMotion, other: JointMotion) -> bool:
    """Whether some body turns differently."""
    return bool(turn_angles(np.swapaxes(one.local[0], 1, 2) @ other.local[0]).max() > _DISTINCT)


def _view(
    points: np.ndarray, colors: np.ndarray | None, frame: int, spacing: float, scales: MatchingScales, count: int
) -> FrameSurface:
    if len(points) < 4:
        raise GeometryError(f"frame {frame}: {len(points)} points; the model can't be fitted to so few")
    return FrameSurface.of_points(points, colors, spacing, scales, count)


def _carried_on(last: JointMotion, before: JointMotion | None) -> JointMotion:
    """Pose that follows at the same pace."""
    if before is None:
        return last
    turn = last.local @ before.local.swapaxes(-1, -2)
    vectors = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec()
    turn = Rotation.from_rotvec(vectors).as_matrix().reshape(turn.shape)
    return JointMotion(turn @ last.local, 2.0 * last.root - before.root)


def _fit_all(
    model: SubjectModel,
    surface: ModelSurface,
    motion: JointMotion,
    views: list[FrameSurface],
    scales: MatchingScales,
    paths: MotionPaths | None,
    settings: FollowingSettings,
) -> JointMotion:
    """Motion of all frames that fits surfaces and paths best, evenly in time."""
    linkage = model.linkage
    count = len(surface.skin)
    reach = _REACH * scales.sigma
    if paths is not None:
        for _ in range(_PATH_ROUNDS):
            bodies = body_motion(linkage, motion)
            skin = attach_paths(model, bodies, paths, reach)
            motion = turned_by_paths(linkage, motion, bodies, skin, paths, FOLLOWED * model.diagonal)
    for _ in range(settings.rounds):
        bodies = body_motion(linkage, motion)
        points = surface.skin
        observations = match_surfaces(surface, surface.posed(bodies), views, scales)
        if paths is not None:
            skin = attach_paths(model, bodies, paths, reach)
            points = SkinPoints(*(np.concatenate([getattr(points, n), getattr(skin, n)]) for n in _SKIN))
            sigma = np.hypot(paths.typical_sigma(), 0.2 * scales.sigma) / np.sqrt(settings.path_independence)
            spread = np.broadcast_to(sigma[:, None], paths.seen.shape)
            observations = observations.joined(Observations.of_paths(paths.positions, spread, count, paths.ray))
        prior = _smoothness(linkage, motion, model.diagonal, settings)
        motion = adjust(linkage, motion, points, observations, smoothness=prior, rounds=3).motion
    return motion


_SKIN = ("rest", "bodies", "fractions")


def _smoothness(linkage: Linkage, motion: JointMotion, diagonal: float, settings: FollowingSettings) -> Smoothness:
    turn, shift = typical_accelerations(linkage, motion)
    least = np.deg2rad(settings.least_turn_deg)
    return Smoothness(np.maximum(turn, least), max(shift, settings.least_shift * diagonal), 3.0)
