"""The default method on arrays: tracks or scans in; bodies, joints and skeleton out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from geomocap.bodies.body_evidence import TURN_FRACTION
from geomocap.bodies.motion_bodies import LEAST_SAMPLES, MotionBodies, MotionBodiesSettings
from geomocap.bodies.point_labels import Voters, label_points
from geomocap.bodies.ray_depths import find_bodies_and_depths
from geomocap.bodies.rigid_motions import relative_turn
from geomocap.bodies.track_labels import label_tracks
from geomocap.errors import GeometryError
from geomocap.model.axis_order import seem_swapped
from geomocap.model.motion_paths import LEAST_FRAMES, MotionPaths
from geomocap.model.outlines import Outlines
from geomocap.model.skeleton import Skeleton
from geomocap.nodes.node_settings import NodeTrackingSettings
from geomocap.nodes.node_tracking import track_nodes
from geomocap.nodes.surface_coverage import even_spacing
from geomocap.progress import Progress, silent
from geomocap.settings import Settings, check_fps, check_settings
from geomocap.skeleton.common_points import CommonPoint
from geomocap.skeleton.motion_skeleton import (
    MotionSkeleton,
    MotionSkeletonSettings,
    find_motion_skeleton,
    joined_apart,
)
from geomocap.skeleton.refinement import RefinementSettings, refine_skeleton
from geomocap.trajectories.selection import spread_out

# Motion paths that bodies are found from, were they all over the surface. Of four captures 600, 1,000 and 1,500 found
# 0.67, 0.70 and 0.70 of the joints; with 1,000 a soft trunk's core index from perfect tracks fell below 0.97. Four
# cameras in a real room would take more: 1,000, 1,500 and 2,500 were 137, 119 and 107 mm off.
SAMPLES = 1500
_UNSURE_DEG = 30.0  # 3 to 8 with eight cameras; with four that show the bodies 12, in a cluttered room 29
# Of the least turn of a body, by which two must turn against each other once refined. Two halves of a shield that had
# passed as bodies turned by 1° then. With all of it true pieces of trunks went, which came out 1° below: of a horse's
# paths with 3 mm of noise the core index fell from 0.99 to 0.79. Nothing between was tried.
_ALIKE = 0.5


class MotionSettings(Settings):
    """How motion is found; each part is a table of the settings file."""

    bodies: MotionBodiesSettings = Field(MotionBodiesSettings(), description="bodies from motion paths")
    skeleton: MotionSkeletonSettings = Field(MotionSkeletonSettings(), description="their joints")
    refinement: RefinementSettings = Field(RefinementSettings(), description="refinement of their motion")
    nodes: NodeTrackingSettings = Field(NodeTrackingSettings(), description="following scans without order")


@dataclass(frozen=True)
class Motion:
    """Rigid bodies, how they move, and the skeleton that connects them.

    Attributes
    ----------
    bodies : MotionBodies
        B bodies of S samples over T frames: labels, skin weights, motion.
    connected : MotionSkeleton
        The skeleton and what is known of its joints.
    paths : MotionPaths
        What the samples did.
    labels : (N,) int32
        Body of each track that was given; -1: none. Of scans, of each sample.
    voters : Voters
        Followed points whose bodies are known; they label others.
    warnings : tuple of str
        What makes the result doubtful, in words.
    """

    bodies: MotionBodies
    connected: MotionSkeleton
    paths: MotionPaths
    labels: np.ndarray
    voters: Voters
    warnings: tuple[str, ...] = ()

    @property
    def body_count(self) -> int:
        """Number of bodies B."""
        return self.bodies.body_count

    @property
    def skeleton(self) -> Skeleton:
        """Joints, hierarchy and motion: `joint_positions` (T, J, 3) m, `joint_bodies` (J, 2), `body_rotations` …."""
        return self.connected.skeleton

    @property
    def joints(self) -> tuple[CommonPoint, ...]:
        """What is known of each joint of the skeleton: hinge or ball, axis, standard deviation (m)."""
        return self.connected.joints

    @property
    def joint_is_hinge(self) -> np.ndarray:
        """Joints that turn about one axis only, (J,) bool."""
        return np.array([joint.hinge for joint in self.joints], dtype=bool)

    @property
    def weights(self) -> np.ndarray:
        """Skin weights of the samples, (S, B) float; rows sum to 1."""
        return self.bodies.weights

    def label(self, frame: int, points: np.ndarray) -> np.ndarray:
        """Bodies (M,) int32 of any points (M, 3), metres, of the surface in a frame."""
        return label_points(self.voters, frame, points)

    def with_tracks(self, tracks: np.ndarray) -> Motion:
        """Let further tracks (N, T, 3), metres, NaN where unseen, help to label points: `labels` are theirs then.

        Each gets the body that is near it and moves as it does. Bodies, joints and motion stay.
        """
        tracks = np.where(np.isfinite(tracks).all(axis=2, keepdims=True), tracks, np.nan)
        labels, rest = label_tracks(self.bodies, Voters.of(self.bodies, self.paths), tracks)
        voters = Voters.with_tracks(self.bodies, self.paths, tracks, labels, rest)
        return replace(self, labels=labels, voters=voters)


def unsure_turns(bodies: MotionBodies) -> tuple[str, ...]:
    """Say so if what lies side by side turns too differently for bodies and joints to be trusted."""
    unevenness = float(np.rad2deg(bodies.unevenness))
    if unevenness <= _UNSURE_DEG:
        return ()
    return (
        f"neighbouring samples of the surface turn by {unevenness:.0f}° against each other (median; at most "
        f"{_UNSURE_DEG:.0f}° expected): number of bodies, joints and skeleton are not to be trusted; use more "
        "cameras, more texture or more frames a second",
    )


def other_number(asked: int, found: int) -> tuple[str, ...]:
    """Say so if other than the bodies asked for (0: any number) were found."""
    if asked in (0, found):
        return ()
    why = (
        "what else moved by itself was so small, or so like what is beside it, that samples follow other bodies"
        if found < asked
        else "the others touch none of which they could be a part"
    )
    return (f"{found} bodies were found, {asked} were asked for (motion_bodies.bodies): {why}",)


def find_motion(
    tracks: np.ndarray | MotionPaths | Sequence[np.ndarray],
    *,
    fps: float,
    sigma: np.ndarray | None = None,
    bodies: int = 0,
    settings: MotionSettings | None = None,
    progress: Progress = silent,
    executor: Executor | None = None,
    outlines: Outlines | None = None,
) -> Motion:
    """Find the rigid bodies that move a surface, their joints, and their motion.

    The default method of `geomocap run`, on arrays: bodies by how the surface turns (`bodies`), joints as the points
    that two bodies' motions have in common (`skeleton`), all refined together over all frames. Deterministic.

    Parameters
    ----------
    tracks : (N, T, 3) float, or MotionPaths, or sequence of T arrays (M, 3)
        Metres, world. An array holds tracks: the same surface points in all frames, NaN where unseen. A sequence of
        arrays holds scans: points of the surface in any order and number, anew in each frame.
    fps : float
        Frames per second.
    sigma : (N,) or (N, T) float, optional
        Standard deviation of the tracks' positions, metres.
    bodies : int
        Their number; 0: found.
    settings : MotionSettings, optional
    progress : Progress, optional
        Called with (stage, done, of).
    executor : Executor, optional
        Frames of scans are mapped with it.
    outlines : Outlines, optional
        Silhouettes of the cameras; of what one camera alone sees they tell how deep it lies.

    Returns
    -------
    Motion

    Raises
    ------
    GeometryError
        If the arrays have another shape, or there are too few tracks or frames.
    SettingsError
        If `fps` or `bodies` can't be.

    Examples
    --------
    >>> motion = geomocap.find_motion(tracks, fps=30)  # doctest: +SKIP
    >>> motion.skeleton.joint_positions.shape          # doctest: +SKIP
    (60, 15, 3)
    """
    check_fps(fps)
    settings = settings or MotionSettings()
    if bodies:
        asked = check_settings(MotionBodiesSettings, settings.bodies.model_dump() | {"bodies": bodies})
        settings = settings.model_copy(update={"bodies": asked})
    given: np.ndarray | None = None
    doubts: tuple[str, ...] = ()
    if isinstance(tracks, MotionPaths):
        paths = tracks
    elif isinstance(tracks, np.ndarray):
        given, (paths, samples) = tracks, _sampled(tracks, sigma)
        doubts = swapped_axes(tracks)
    elif not isinstance(tracks, Iterable) or isinstance(tracks, str):
        kind = type(tracks).__name__
        raise GeometryError(f"tracks are {kind}, expected an array (N, T, 3), MotionPaths, or a list of scans (M, 3)")
    else:
        paths = _followed(tracks, settings.nodes, progress, executor)
    found, paths = find_bodies_and_depths(paths, settings.bodies, progress, outlines)
    progress("skeleton", 0, 1)
    connected, found = _connect(found, paths, fps, settings)
    progress("skeleton", 1, 1)
    doubts += (*unsure_turns(found), *other_number(settings.bodies.bodies, found.body_count))
    doubts += joined_apart(connected, found.diagonal, settings.skeleton)
    motion = Motion(found, connected, paths, found.label, Voters.of(found, paths), doubts)
    if given is None:
        return motion
    motion = motion.with_tracks(given)
    motion.labels[samples] = found.label
    return motion


def _connect(
    bodies: MotionBodies, paths: MotionPaths, fps: float, settings: MotionSettings
) -> tuple[MotionSkeleton, MotionBodies]:
    """Skeleton and refined bodies; those that a joint holds together and that turn alike once refined become one.

    Alone, a body of few or bad samples may seem to turn; with its joints and over all frames it is known better.
    Nothing is joined where the number of bodies was given.
    """
    least = _ALIKE * settings.bodies.least_turn(paths.parts is not None)
    while True:
        connected = find_motion_skeleton(bodies, fps, settings.skeleton, depths_found=paths.ray is not None)
        connected, refined = refine_skeleton(connected, bodies, paths, settings.refinement)
        pairs = connected.skeleton.joint_bodies
        if settings.bodies.bodies or settings.refinement.rounds == 0 or not len(pairs):
            return connected, refined
        turns = [relative_turn(refined.rotations[:, a], refined.rotations[:, b], TURN_FRACTION) for a, b in pairs]
        weakest = int(np.argmin(turns))
        if turns[weakest] >= least:
            return connected, refined
        sizes = np.bincount(bodies.label[bodies.label >= 0], minlength=bodies.body_count)
        small, large = sorted(pairs[weakest].tolist(), key=lambda b: (sizes[b], b))
        bodies = bodies.merged(large, small)


def swapped_axes(tracks: np.ndarray) -> tuple[str, ...]:
    """Say so if tracks (N, T, 3) seem to be given as (T, N, 3)."""
    if not seem_swapped(tracks):
        return ()
    return (
        f"the axes of the tracks seem to be swapped: what is taken as {len(tracks)} points in {tracks.shape[1]} frames "
        "doesn't keep its distances as points of a surface do, but with the axes swapped it does; expected (N points, "
        "T frames, 3); try tracks.swapaxes(0, 1)",
    )


def _sampled(tracks: np.ndarray, sigma: np.ndarray | None) -> tuple[MotionPaths, np.ndarray]:
    """Motion paths of long tracks, evenly over the surface, and which tracks these are, (S,) int."""
    if tracks.ndim != 3 or tracks.shape[2] != 3 or tracks.dtype.kind not in "fiu":
        what = f"{tracks.dtype} of shape {tracks.shape}"
        raise GeometryError(f"tracks are {what}, expected numbers of shape (N, T, 3): N points in T frames, metres")
    count, frames = tracks.shape[:2]
    if count < LEAST_SAMPLES or frames < LEAST_FRAMES:
        raise GeometryError(
            f"tracks of shape {tracks.shape} are {count} points in {frames} frames, at least {LEAST_SAMPLES} in "
            f"{LEAST_FRAMES} are needed; expected (N points, T frames, 3)"
            f"{'; the axes seem to be swapped, try tracks.swapaxes(0, 1)' if seem_swapped(tracks) else ''}"
        )
    samples = evenly_over_surface(tracks)
    if sigma is not None:
        sigma = np.asarray(sigma, float)
        if sigma.shape not in (tracks.shape[:1], tracks.shape[:2]):
            raise GeometryError(f"sigma has shape {sigma.shape}, expected {tracks.shape[:1]} or {tracks.shape[:2]}")
        sigma = sigma[samples]
    return MotionPaths(np.asarray(tracks[samples], float), sigma=sigma), samples


def evenly_over_surface(tracks: np.ndarray) -> np.ndarray:
    """Which of tracks (N, T, 3), metres, NaN where unseen, bodies are found from: long ones, evenly, (S,) int."""
    seen = np.isfinite(tracks).all(axis=2)
    fullest = int(seen.sum(axis=0).argmax())
    if not seen[:, fullest].any():
        return np.empty(0, int)
    return spread_out(tracks, even_spacing(tracks[seen[:, fullest], fullest], SAMPLES))


def _followed(
    scans: Sequence[np.ndarray], settings: NodeTrackingSettings, progress: Progress, executor: Executor | None
) -> MotionPaths:
    """Motion paths of nodes that are followed through scans."""
    try:
        points = [np.asarray(scan, float) for scan in scans]
    except (TypeError, ValueError):
        raise GeometryError("scans hold something else than numbers, expected arrays (M, 3), metres") from None
    for frame, scan in enumerate(points):
        if scan.ndim != 2 or scan.shape[1] != 3:
            raise GeometryError(f"scan of frame {frame} has shape {scan.shape}, expected (M, 3), metres")
    points = [scan[np.isfinite(scan).all(axis=1)] for scan in points]
    nodes = track_nodes(points.__getitem__, len(points), settings, progress=progress, executor=executor)
    return nodes.motion_paths()
