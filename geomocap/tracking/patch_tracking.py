"""Tracking the whole surface: patches placed on it, followed forward and backward in all cameras that see them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items, threads
from geomocap.tracking.frame_views import FrameViews
from geomocap.tracking.patch_motion import carried, extrapolate, image_flow, lift_flow, nearest
from geomocap.tracking.patches import Alignment, Patches, align, facings, visible, with_templates
from geomocap.tracking.seeding import seed_patches, seed_spacing
from geomocap.tracking.track_record import TrackRecord
from geomocap.tracking.tracking_settings import TrackingSettings
from geomocap.tracking.trajectories import (
    APART,
    LAST_FRAME,
    LOW_CORRELATION,
    LOW_PRECISION,
    OUTSIDE,
    UNSEEN,
    Trajectories,
)

_FACING = 0.25  # cosine from which a camera is asked
_NEW_TEMPLATE_FACING = 0.5
_NEW_TEMPLATE_CORRELATION = 0.9
_SURE = 0.9  # correlation from which no second start is tried
_NEIGHBOURS = 8
_AGREEING = 3  # neighbours whose motion a patch must share
_SLACK_VOXELS = 2.0
_SMOOTH = 0.7  # share of the newest motion in the velocity


@dataclass(frozen=True)
class Followed:
    """Patches that are being followed, at one frame.

    Attributes
    ----------
    patches : Patches
    identity : (N,) int
        Row of each in the trajectories.
    velocity, spin : (N, 3) float
        Last shift (m) and turn (rotation vector, world) from frame to frame.
    gap : (N,) int
        Frames since a patch was last measured.
    reason : (N,) int
        Why it was not measured, see `REASONS`.
    """

    patches: Patches
    identity: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    gap: np.ndarray
    reason: np.ndarray

    @classmethod
    def begin(cls, patches: Patches, identity: np.ndarray) -> Followed:
        """Begin with patches at rest."""
        N = len(patches)
        rest = np.zeros((N, 3))
        return cls(patches, identity, rest, rest.copy(), np.zeros(N, int), np.zeros(N, int))

    @property
    def last_reason(self) -> np.ndarray:
        """Why each patch isn't measured now, (N,) int; `LAST_FRAME` (0) where it is."""
        return np.where(self.gap > 0, self.reason, LAST_FRAME)

    def select(self, which: np.ndarray) -> Followed:
        """Return some of them, by a mask or by positions."""
        return Followed(
            self.patches.select(which),
            self.identity[which],
            self.velocity[which],
            self.spin[which],
            self.gap[which],
            self.reason[which],
        )

    def join(self, other: Followed) -> Followed:
        """Return these followed by others, which take over the motion of their nearest neighbours."""
        velocity, spin = other.velocity, other.spin
        if len(self.patches) > _NEIGHBOURS and len(other.patches):
            positions = np.concatenate([self.patches.positions, other.patches.positions])
            old, new = np.arange(len(self.patches)), np.arange(len(self.patches), len(positions))
            near = nearest(positions, new, old, _NEIGHBOURS)
            velocity, spin = np.median(self.velocity[near], axis=1), np.median(self.spin[near], axis=1)
        return Followed(
            self.patches.join(other.patches),
            np.concatenate([self.identity, other.identity]),
            np.concatenate([self.velocity, velocity]),
            np.concatenate([self.spin, spin]),
            np.concatenate([self.gap, other.gap]),
            np.concatenate([self.reason, other.reason]),
        )


def track_surface(
    frames: Callable[[int], FrameViews],
    n_frames: int,
    settings: TrackingSettings | None = None,
    progress: Progress = silent,
    executor: Executor | None = None,
) -> Trajectories:
    """Follow the surface of the subject through all frames.

    Patches are placed on the first frame's surface and, every `seed_every` frames, wherever the surface has none. All
    are followed forward; then those placed later backward to the first frame. Frames come in order and two are held.

    Parameters
    ----------
    frames : callable
        Returns a frame; called twice for each (forward and backward), in other threads.
    n_frames : int
    settings : TrackingSettings, optional
    progress : callable, optional
    executor : concurrent.futures.Executor, optional
        Runs `frames` ahead of the tracking; a thread of its own if not given.

    Returns
    -------
    Trajectories
    """
    settings = settings or TrackingSettings()
    if executor is None:
        with threads(1) as own:
            return track_surface(frames, n_frames, settings, progress, own)
    rng = np.random.default_rng(settings.seed)
    record = TrackRecord(n_frames)
    spacing = 0.0
    state: Followed | None = None
    seeds: dict[int, Followed] = {}
    previous = None
    count = 0
    for k, view in _stream(frames, range(n_frames), executor, "track forward", progress):
        if state is None:
            spacing = seed_spacing(view, settings.n_patches)
        elif previous is not None:
            state = _next(state, previous, view, settings, record, k, forward=True)
        if k % settings.seed_every == 0:
            taken = np.zeros((0, 3)) if state is None else state.patches.positions[state.gap == 0]
            fresh = Followed.begin(seed_patches(view, taken, spacing, settings, rng), np.zeros(0, int))
            fresh = Followed.begin(fresh.patches, np.arange(count, count + len(fresh.patches)))
            count += len(fresh.patches)
            record.placed(k, fresh.identity, fresh.patches)
            state = fresh if state is None else state.join(fresh)
            seeds[k] = _bare(fresh)
        previous = view
    if state is not None:
        record.ended(state.identity, state.last_reason, forward=True)
    if settings.backward and max((k for k, s in seeds.items() if len(s.patches)), default=0) > 0:
        last = max(k for k, s in seeds.items() if len(s.patches))
        state = previous = None
        for k, view in _stream(frames, range(last, -1, -1), executor, "track backward", progress):
            if state is not None and previous is not None:
                state = _next(state, previous, view, settings, record, k, forward=False)
            if k > 0 and k in seeds:
                fresh = _dressed(seeds[k], view)
                state = fresh if state is None else state.join(fresh)
            previous = view
        if state is not None:
            record.ended(state.identity, state.last_reason, forward=False)
    return record.trajectories(count)


def _stream(
    frames: Callable[[int], FrameViews], order: range, executor: Executor, stage: str, progress: Progress
) -> Iterator[tuple[int, FrameViews]]:
    yield from zip(order, map_items(frames, order, executor, stage, progress, ahead=2), strict=True)


def _bare(seeds: Followed) -> Followed:
    """Leave out the templates, which are taken again from the same frame: only who has one is kept."""
    patches = seeds.patches
    N, C, L = patches.templates.shape[:3]
    blank = Patches(
        patches.positions,
        patches.frames,
        patches.shape,
        patches.size,
        np.zeros((N, C, L, 0, 3), np.float32),
        np.zeros((N, C, 0), np.uint8),
        patches.has,
        patches.hidden,
    )
    return Followed.begin(blank, seeds.identity)


def _dressed(seeds: Followed, view: FrameViews) -> Followed:
    """Take the templates of bare patches from the frame in which they were placed."""
    p = seeds.patches
    blank = Patches.without_templates(p.positions, p.frames, p.shape, p.size, view.count, len(view.levels))
    return Followed.begin(with_templates(blank, p.has, view), seeds.identity)


def _next(
    state: Followed,
    previous: FrameViews,
    view: FrameViews,
    settings: TrackingSettings,
    record: TrackRecord,
    frame: int,
    forward: bool,
) -> Followed:
    """Follow patches into the next frame, record what was measured, and let go of those lost for too long."""
    if not len(state.patches):
        return state
    found = _search(state, previous, view, settings)
    reason = _judge(state, found, view, settings)
    good = reason == LAST_FRAME
    found = _carry_lost(state, found, good)
    old = state.patches
    shift = found.positions - old.positions
    turn = Rotation.from_matrix(found.frames @ np.swapaxes(old.frames, 1, 2)).as_rotvec()
    gap = np.where(good, 0, state.gap + 1)
    moved = old.moved(found.positions, found.frames)
    fresh = good & (found.correlation > _NEW_TEMPLATE_CORRELATION) & (found.n_views >= 2)
    moved = _new_views(moved, fresh, view, settings)
    record.measured(frame, state.identity[good], found, np.flatnonzero(good))
    state = Followed(
        moved,
        state.identity,
        _SMOOTH * shift + (1 - _SMOOTH) * state.velocity,
        _SMOOTH * turn + (1 - _SMOOTH) * state.spin,
        gap,
        reason,
    )
    lost = gap > settings.longest_gap
    record.ended(state.identity[lost], reason[lost], forward)
    return state.select(~lost)


def _search(state: Followed, previous: FrameViews, view: FrameViews, settings: TrackingSettings) -> Alignment:
    """Align all patches from the best of several starts; those that fail once more from their neighbours' motions."""
    patches = state.patches
    N = len(patches)
    every = np.arange(N)
    slack = _slack(patches, view, settings.slack_px)
    seen = visible(patches, patches.positions, patches.frames, previous, slack, _FACING) & patches.has
    flow = image_flow(previous, view, patches.positions, seen)
    lifted = patches.positions + lift_flow(previous, patches.positions, flow)
    starts = [
        extrapolate(patches.positions, patches.frames, state.velocity, state.spin),
        (lifted, extrapolate(lifted, patches.frames, state.velocity, state.spin)[1]),
    ]
    start = _best_start(patches, every, starts, view, settings)
    found = _align(patches, every, start, view, settings)
    # those that are doubtful try again with the motion of one of their neighbours
    for _ in range(2):
        sure = np.flatnonzero((found.correlation > _SURE) & (found.n_views >= 2))
        doubtful = np.flatnonzero(found.correlation <= _SURE)
        near = nearest(patches.positions, doubtful, sure, _NEIGHBOURS)
        if not near.shape[1] or not len(doubtful):
            break
        places, turned = carried(patches.positions, patches.frames, near, found.positions, found.frames, doubtful)
        starts = []
        for j in range(0, near.shape[1], 2):
            X, Q = found.positions.copy(), found.frames.copy()
            X[doubtful], Q[doubtful] = places[:, j], turned[:, j]
            starts.append((X, Q))
        again = _align(patches, doubtful, _best_start(patches, doubtful, starts, view, settings), view, settings)
        better = np.zeros(N, bool)
        better[doubtful] = (again.correlation > found.correlation + 1e-3)[doubtful]
        better &= again.n_views >= np.minimum(found.n_views, settings.n_views)
        found = found.replaced(better, again)
    return found


def _best_start(
    patches: Patches,
    which: np.ndarray,
    starts: list[tuple[np.ndarray, np.ndarray]],
    view: FrameViews,
    settings: TrackingSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Compare starts on the coarse level and return the best for each patch."""
    slack = _slack(patches, view, settings.slack_px)
    best = np.full(len(patches), -3.0)
    X, Q = starts[0][0].copy(), starts[0][1].copy()
    for positions, frames in starts:
        use = visible(patches, positions, frames, view, slack, _FACING) & patches.has
        tried = align(patches, which, positions, frames, use, view, iterations=(0, -1), least_correlation=-1.0)
        better = tried.correlation > best + 1e-3
        best[better] = tried.correlation[better]
        X[better], Q[better] = positions[better], frames[better]
    return X, Q


def _align(
    patches: Patches,
    which: np.ndarray,
    start: tuple[np.ndarray, np.ndarray],
    view: FrameViews,
    settings: TrackingSettings,
) -> Alignment:
    """Align patches with the cameras that see them where they start."""
    slack = _slack(patches, view, settings.slack_px)
    use = visible(patches, *start, view, slack, _FACING) & patches.has
    return align(
        patches,
        which,
        *start,
        use,
        view,
        iterations=(6, 10),
        least_correlation=settings.camera_correlation,
    )


def _slack(patches: Patches, view: FrameViews, slack_px: float) -> np.ndarray:
    """Depth by which something must lie before patches to hide them, (N, 1), metres: not a voxel that sticks out."""
    return slack_px * patches.size[:, None] + _SLACK_VOXELS * view.voxel_size


def _judge(state: Followed, found: Alignment, view: FrameViews, settings: TrackingSettings) -> np.ndarray:
    """Return why each patch can't be taken as measured, (N,) int; `LAST_FRAME` (0) where it can."""
    size = state.patches.size
    reason = np.full(len(size), LAST_FRAME)
    reason[found.sigma > settings.sigma_px * size] = LOW_PRECISION
    reason[found.correlation < settings.correlation] = LOW_CORRELATION
    reason[found.n_views < settings.n_views] = UNSEEN
    reason[(reason == LAST_FRAME) & ~view.may_be_subject(found.positions)] = OUTSIDE
    good = np.flatnonzero(reason == LAST_FRAME)
    near = nearest(state.patches.positions, good, good, _NEIGHBOURS)
    if near.shape[1] >= _AGREEING:
        old = state.patches
        places, _ = carried(old.positions, old.frames, near, found.positions, found.frames, good)
        away = np.linalg.norm(places - found.positions[good][:, None], axis=2)
        apart = np.sort(away, axis=1)[:, _AGREEING - 1] > settings.neighbour_px * size[good]
        reason[good[apart]] = APART
    return reason


def _carry_lost(state: Followed, found: Alignment, good: np.ndarray) -> Alignment:
    """Put patches that were not measured where the most typical of their neighbours' motions takes them."""
    lost, sure = np.flatnonzero(~good), np.flatnonzero(good)
    positions, frames = found.positions.copy(), found.frames.copy()
    old = state.patches
    near = nearest(old.positions, lost, sure, 5)
    if near.shape[1]:
        places, turned = carried(old.positions, old.frames, near, found.positions, found.frames, lost)
        typical = np.linalg.norm(places - np.median(places, axis=1, keepdims=True), axis=2).argmin(axis=1)
        rows = np.arange(len(lost))
        positions[lost], frames[lost] = places[rows, typical], turned[rows, typical]
    else:
        moved = extrapolate(old.positions, old.frames, state.velocity, state.spin)
        positions[lost], frames[lost] = moved[0][lost], moved[1][lost]
    return Alignment(positions, frames, found.correlation, found.n_views, found.sigma, found.by_camera)


def _new_views(patches: Patches, sure: np.ndarray, view: FrameViews, settings: TrackingSettings) -> Patches:
    """Take templates in cameras that have come to see a well-measured patch."""
    slack = _slack(patches, view, 0.5 * settings.slack_px)
    cosine = facings(patches.positions, patches.normals, view)
    want = visible(patches, patches.positions, patches.frames, view, slack, _FACING) & ~patches.has
    want &= (cosine > _NEW_TEMPLATE_FACING) & sure[:, None]
    return with_templates(patches, want, view) if want.any() else patches
