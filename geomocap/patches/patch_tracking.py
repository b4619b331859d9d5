"""Tracking the whole surface: patches placed on it, followed forward and backward in all cameras that see them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomocap.model.trajectories import DOUBLE, LAST_FRAME, Trajectories
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.lone_depths import adjust_depths
from geomocap.patches.patch_prediction import orthonormal
from geomocap.patches.patch_search import Followed, carry_lost, hiding_depth, judge, new_views, renewed, search
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.reacquisition import reacquire
from geomocap.patches.seeding import patch_radii, seed_for_one_camera, seed_patches, seed_spacing, template_room
from geomocap.patches.surface_patches import SAME_SIDE, PatchAlignment, doubted, with_templates
from geomocap.patches.swings import find_pieces, lost_pieces
from geomocap.patches.template_store import TemplateStore
from geomocap.patches.track_record import TrackRecord
from geomocap.progress import Progress, silent
from geomocap.scheduling import map_items, threads
from geomocap.trajectories.joining import join_broken
from geomocap.trajectories.neighbour_precision import clear_unsure, with_observed_precision

# Frames between two looks for surface without patches. Limbs of a galloping stag keep them for 5 to 9 frames (median).
# Bodies from tracks with 10 and with 3, means of three or four choices of nine tenths of them: joints within 5 % of the
# height 0.27 and 0.46 (stag), 0.62 and 0.67 (walking horse), 0.87 and 0.93 (a distant man); rotations 14.7° and 12.0°,
# 7.0° and 6.7°, 3.8° and 3.5°. Of a bird's joints fewer were some: 0.64 and 0.25. Tracking takes twice as long.
_LOOK = 3
# Where single cameras follow the surface nothing was won: a man before four had 0.93 of his joints with 10, 0.87 with 3
# (one run each).
_LOOK_ALONE = 10
_SMOOTH = 0.7  # fraction of the newest motion in the velocity
_DOUBLE = 0.5  # of the spacing: patches nearer than that follow the same surface
# Times the width of patches that few cameras may have: one image tells less than two. A man in plain clothes, four
# cameras, was covered to 0.76 instead of 0.67, and 0.80 instead of 0.60 of his joints were found.
_WIDER = 2
_LONG_BESIDE = 4  # frames after which the younger one is given up
_LOOK_EVERY = 3  # frames between looks for lost patches in all cameras
_UNSURE = 2.0  # times the standard deviation allowed in a frame that one may have since a patch was placed
_SURE = 0.9  # correlation from which such a patch is found,
_SURE_IN_PIECE = 0.8  # and one of a piece, of which others were found


def track_surface(
    frames: Callable[[int], FrameViews],
    n_frames: int,
    settings: TrackingSettings | None = None,
    progress: Progress = silent,
    executor: Executor | None = None,
) -> Trajectories:
    """Follow the surface of the subject through all frames.

    Patches are placed on the first frame's surface and, every few frames and in the last one, wherever the
    surface has none. All are followed forward; then those placed later backward to the first frame, until they have
    run for some frames beside an older one, with which they are joined. Frames come in order and two are held.
    Where the cameras are so few that two of them agree on less than a part (`one_camera_below`) of the first frame's
    surface, the rest gets patches of single cameras. Their depth is that of the volume, adjusted to the motion of what
    is around them. Standard deviations are those that neighbours bear out; what
    has too large ones is left out.

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
    record = TrackRecord(n_frames)
    placed = _forward(_stream(frames, range(n_frames), executor, "track forward", progress), n_frames, settings, record)
    last = max((k for k, s in placed.seeds.items() if len(s.patches)), default=0)
    if settings.backward and last > 0:
        back = range(last, -1, -1)
        _backward(_stream(frames, back, executor, "track backward", progress), placed, record)
    found = record.trajectories(placed.count)
    if placed.by_one:
        found = adjust_depths(found)
    found = with_observed_precision(join_broken(found))
    clear_unsure(found, _UNSURE * settings.sigma_px * placed.pixel)
    return found


@dataclass(frozen=True)
class _Placed:
    """What was placed on the way forward.

    Attributes
    ----------
    settings : TrackingSettings
        With half the width that the widest patches have.
    spacing, pixel : float, metres
        Distance of patches, and what a pixel covers.
    by_one : bool
        Whether a single camera may follow a patch.
    seeds : dict
        New patches of frames, without templates.
    count : int
        Of all patches.
    """

    settings: TrackingSettings
    spacing: float
    pixel: float
    by_one: bool
    seeds: dict[int, Followed]
    count: int


def _forward(
    views: Iterator[tuple[int, FrameViews]], n_frames: int, settings: TrackingSettings, record: TrackRecord
) -> _Placed:
    """Place patches where the surface has none, and follow all to the last frame."""
    rng = np.random.default_rng(settings.seed)
    spacing = pixel = 0.0
    state: Followed | None = None
    seeds: dict[int, Followed] = {}
    previous = None
    by_one, every = False, 1
    count = 0
    for k, view in views:
        if state is None:
            spacing = seed_spacing(view, settings.n_patches)
            pixel = float(np.median(view.pixel_size(view.surface)))
            if view.count <= settings.one_camera_up_to:
                settings = settings.model_copy(update={"radius_px": _WIDER * settings.radius_px})
            settings = settings.model_copy(update={"radius_px": patch_radii(view, spacing, settings)[0]})
        elif previous is not None:
            state = _next(state, previous, view, settings, record, k, spacing, forward=True)
        if k % every == 0 or k == n_frames - 1:
            several, one = _taken(state)
            patches = seed_patches(view, several, spacing, settings, rng)
            if state is None:
                few = view.count <= settings.one_camera_up_to
                by_one = few and len(patches) < settings.one_camera_below * settings.n_patches
                if len(patches) > settings.n_patches:
                    spacing *= float(np.sqrt(len(patches) / settings.n_patches))
                    patches = patches.select(np.sort(rng.choice(len(patches), settings.n_patches, replace=False)))
                every = settings.seed_every or (_LOOK_ALONE if by_one else _LOOK)
            if by_one:
                taken = np.concatenate([several, one, patches.positions])
                patches = patches.join(seed_for_one_camera(view, taken, spacing, settings, rng))
            fresh = Followed.begin(patches, np.arange(count, count + len(patches)), by_one)
            count += len(fresh.patches)
            record.placed(k, fresh.identity, fresh.patches, view.centers)
            state = fresh if state is None else state.join(fresh)
            seeds[k] = _bare(fresh)
        previous = view
    if state is not None:
        record.ended(state.identity, state.last_reason, forward=True)
    return _Placed(settings, spacing, pixel, by_one, seeds, count)


def _backward(views: Iterator[tuple[int, FrameViews]], placed: _Placed, record: TrackRecord) -> None:
    """Follow patches of later frames back to the first one, or until older ones have long been beside them."""
    settings = placed.settings
    state = previous = None
    for k, view in views:
        if state is not None and previous is not None:
            state = _next(state, previous, view, settings, record, k, placed.spacing, forward=False)
        if k > 0 and k in placed.seeds:
            fresh = _dressed(placed.seeds[k], view, template_room(view, settings))
            state = fresh if state is None else state.join(fresh)
        previous = view
    if state is not None:
        record.ended(state.identity, state.last_reason, forward=False)


def _stream(
    frames: Callable[[int], FrameViews], order: range, executor: Executor, stage: str, progress: Progress
) -> Iterator[tuple[int, FrameViews]]:
    yield from zip(order, map_items(frames, order, executor, stage, progress, ahead=2), strict=True)


def _taken(state: Followed | None) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the patches that are measured now: by templates of several cameras, and of a single one."""
    if state is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    several = state.patches.has.sum(axis=1) > 1
    return state.patches.positions[several & (state.gap == 0)], state.patches.positions[~several & (state.gap == 0)]


def _bare(seeds: Followed) -> Followed:
    """Leave out the templates, which are taken again from the same frame: only who has one is kept."""
    patches = seeds.patches
    bare = replace(patches, store=TemplateStore.empty(patches.store.templates.shape[1], 0))
    return Followed.begin(bare, seeds.identity, seeds.by_one)


def _dressed(seeds: Followed, view: FrameViews, room: tuple[int, int, int]) -> Followed:
    """Take the templates of bare patches from the frame in which they were placed."""
    blank = seeds.patches.cleared(room)
    return Followed.begin(with_templates(blank, seeds.patches.has, view), seeds.identity, seeds.by_one)


def _next(
    state: Followed,
    previous: FrameViews,
    view: FrameViews,
    settings: TrackingSettings,
    record: TrackRecord,
    frame: int,
    spacing: float,
    forward: bool,
) -> Followed:
    """Follow patches into the next frame, record what was measured, and let go of those lost for too long."""
    if not len(state.patches):
        return state
    found = search(state, previous, view, settings)
    reason = judge(state, found, view, settings)
    good = reason == LAST_FRAME
    new = lost_pieces(state.patches, state.identity, state.gap == 0, good, spacing)
    state = replace(state.remembering(good), pieces=state.pieces + new)
    found = carry_lost(state, doubted(state.patches, found), good)
    state, found, regained = _regain(state, found, good, view, settings, frame, spacing)
    found = found.at(found.positions, orthonormal(found.frames))
    old = state.patches
    shift = found.positions - old.positions
    turn = Rotation.from_matrix(found.frames @ np.swapaxes(old.frames, 1, 2)).as_rotvec()
    # where a patch was carried to is put right, which is no motion: that of the nearest measured one is
    followed = good | (regained & (state.gap == 0))
    led, sure = np.flatnonzero(~followed), np.flatnonzero(good)
    if len(led) and len(sure):
        leader = sure[cKDTree(found.positions[sure]).query(found.positions[led])[1]]
        shift[led], turn[led] = shift[leader], turn[leader]
    good |= regained
    gap = np.where(good, 0, state.gap + 1)
    moved = renewed(old.moved(found.positions, found.frames), found, good, view, settings.templates)
    moved = new_views(moved, found, good, view, settings.slack_px)
    record.measured(frame, state.identity[good], found, np.flatnonzero(good), view.centers)
    double = good & np.isin(state.identity, _beside_older(*record.at(frame), _DOUBLE * spacing))
    beside = np.where(double, state.beside + 1, 0)
    reason = np.where(beside >= _LONG_BESIDE, DOUBLE, reason)
    state = Followed(
        moved,
        state.identity,
        _SMOOTH * shift + (1 - _SMOOTH) * state.velocity,
        _SMOOTH * turn + (1 - _SMOOTH) * state.spin,
        gap,
        reason,
        beside,
        state.companions,
        state.by_one,
        state.pieces,
    )
    lost = (gap > settings.longest_gap) | (reason == DOUBLE)
    record.ended(state.identity[lost], reason[lost], forward)
    return state.select(~lost) if lost.any() else state


def _regain(
    state: Followed,
    found: PatchAlignment,
    good: np.ndarray,
    view: FrameViews,
    settings: TrackingSettings,
    frame: int,
    spacing: float,
) -> tuple[Followed, PatchAlignment, np.ndarray]:
    """Look for lost patches: for those of pieces anywhere, and now and then for all where their companions have them.

    Returns
    -------
    state : Followed
        With the templates of what was found, and the pieces that are still to be looked for.
    found : PatchAlignment
    regained : (N,) bool
        Patches that were found.
    """
    slack = hiding_depth(state.patches, view, settings.slack_px)
    old, regained = state.patches, np.zeros(len(good), bool)
    found, swung, pieces = find_pieces(state.pieces, old, state.identity, good, found, view, slack, spacing)
    looks = [(swung, _SURE_IN_PIECE)] if swung.any() else []
    if frame % _LOOK_EVERY == 0:
        looks.append((~good & ~swung, _SURE))
    for lost, least in looks:
        carried = old.moved(found.positions, found.frames)
        again, seen, cameras = reacquire(carried, lost, view, slack, settings, least)
        again = found.replaced(seen, again)
        places = again.positions, again.frames
        tolerance = settings.neighbour_px * old.size
        back = state.companions.agreed(state.identity, good | regained, seen, *places, tolerance)
        found = found.replaced(back, again)
        regained |= back
        there = old.moved(found.positions, found.frames)
        there = with_templates(there, cameras & back[:, None], view, found.image_sigma)
        old = there.moved(old.positions, old.frames)
    return replace(state, patches=old, pieces=pieces), found, regained


def _beside_older(identity: np.ndarray, positions: np.ndarray, normals: np.ndarray, distance: float) -> np.ndarray:
    """Return which of the patches measured in a frame lie beside an older one on the same side of the surface."""
    if len(identity) < 2:
        return np.zeros(0, int)
    first, second = cKDTree(positions).query_pairs(distance, output_type="ndarray").T
    same = np.einsum("ni,ni->n", normals[first], normals[second]) > SAME_SIDE
    return np.unique(np.maximum(identity[first[same]], identity[second[same]]))
