"""Looking for followed patches in the next frame: where to start, which camera to ask, and what to believe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomocap.model.trajectories import APART, LAST_FRAME, LOW_CORRELATION, LOW_PRECISION, OUTSIDE, UNSEEN
from geomocap.patches.companions import Companions
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.one_camera import align_alone
from geomocap.patches.patch_prediction import carried, extrapolate, image_flow, lift_flow, nearest
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.surface_patches import PatchAlignment, Patches, align, facings, visible, with_templates
from geomocap.patches.swings import LostPiece

_FACING = 0.25  # cosine from which a camera is asked
_NEW_TEMPLATE_FACING = 0.5  # cosine from which a camera's first template of a patch is taken,
_NEW_TEMPLATE_CORRELATION = 0.9  # correlation from which, and below which an updated one is taken again
_SURE = 0.9  # correlation from which no second start is tried
_SURE_START = 0.95  # correlation of the blurred images from which optical flow isn't needed
_BETTER = 1e-2  # by which a start must be better, sum of correlations; no other value was tried
_NEIGHBOURS = 8  # whose motion is tried, and compared
_ALONE = 2.0  # times the standard deviation that is allowed where a single camera sees a patch
_ROUGH = 2 / 3  # part of a difference along a lone camera's ray that doesn't count
_AGREEING = 3  # neighbours whose motion a patch must share
_SLACK_VOXELS = 2.0  # of the hull that hide nothing
_ITERATIONS = (6, 10)  # on the coarse and the fine level
_PATIENCE = 5  # frames for which a lost patch is looked for in each; later in every fourth
_SELDOM = 4  # frames between two looks after that


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
    beside : (N,) int
        Frames in a row in which an older patch was nearer than patches are placed.
    companions : Companions
        Patches beside those that are lost, when these were measured last.
    by_one : bool
        Whether a single camera may follow a patch.
    pieces : tuple of LostPiece
        What is looked for elsewhere.
    """

    patches: Patches
    identity: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    gap: np.ndarray
    reason: np.ndarray
    beside: np.ndarray
    companions: Companions
    by_one: bool
    pieces: tuple[LostPiece, ...] = ()

    @classmethod
    def begin(cls, patches: Patches, identity: np.ndarray, by_one: bool) -> Followed:
        """Begin with patches at rest."""
        N = len(patches)
        rest = np.zeros((N, 3))
        none = np.zeros(N, int)
        return cls(patches, identity, rest, rest.copy(), none, none.copy(), none.copy(), Companions.none(N), by_one)

    @property
    def last_reason(self) -> np.ndarray:
        """Why each patch isn't measured now, (N,) int; `LAST_FRAME` (0) where it is."""
        return np.where(self.gap > 0, self.reason, LAST_FRAME)

    def remembering(self, good: np.ndarray) -> Followed:
        """Return them with companions for those that were measured and are not in the next frame, `good` (N,)."""
        measured = self.gap == 0
        gone, there = np.flatnonzero(measured & ~good), np.flatnonzero(measured)
        place, motion = (self.patches.positions, self.patches.frames), (self.velocity, self.spin)
        return replace(self, companions=self.companions.met(gone, there, self.identity, place, motion))

    def select(self, which: np.ndarray) -> Followed:
        """Return some of them, by a mask or by positions."""
        rows = ("identity", "velocity", "spin", "gap", "reason", "beside")
        parts = {name: getattr(self, name)[which] for name in rows}
        return replace(self, patches=self.patches.select(which), companions=self.companions.select(which), **parts)

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
            np.concatenate([self.beside, other.beside]),
            self.companions.join(other.companions),
            self.by_one,
            self.pieces + other.pieces,
        )


def search(state: Followed, previous: FrameViews, view: FrameViews, settings: TrackingSettings) -> PatchAlignment:
    """Align patches from the best of several starts; those that fail once more from their neighbours' motions.

    Where moving on as before fits the blurred images, it is the start; elsewhere optical flow in all cameras is lifted
    into space and compared with it. Those that had been lost before are where their companions have put them: they
    don't try again, and long after they are looked for in every fourth frame only.
    """
    patches = state.patches
    wanted = np.flatnonzero((state.gap <= _PATIENCE) | (state.gap % _SELDOM == 0))
    onward = extrapolate(patches.positions, patches.frames, state.velocity, state.spin)
    start, fit = _best_start(patches, wanted, [onward], view, settings)
    asked = fit[wanted] > -1
    mean = np.where(asked, fit[wanted], 0.0).sum(axis=1) / np.maximum(asked.sum(axis=1), 1)
    unsure = wanted[mean < _SURE_START]
    if len(unsure):
        some = patches.positions[unsure]
        seen = _asked(patches, unsure, patches.positions, patches.frames, previous, settings)[unsure]
        lifted = onward[0].copy()
        lifted[unsure] = some + lift_flow(previous, some, image_flow(previous, view, some, seen))
        start, _ = _best_start(patches, unsure, [start, (lifted, onward[1])], view, settings, fit)
    found = _align(state, wanted, start, view, settings)
    # those that are doubtful now try again with the motions of their neighbours
    certain = (found.correlation > _SURE) & (found.n_views >= _enough(state, found, settings))
    sure, doubtful = np.flatnonzero(certain), np.flatnonzero(~certain & (state.gap == 0))
    near = nearest(patches.positions, doubtful, sure, _NEIGHBOURS)
    if not near.size:
        return found
    places, turned = carried(patches.positions, patches.frames, near, found.positions, found.frames, doubtful)
    starts = []
    for j in range(0, near.shape[1], 2):
        X, Q = found.positions.copy(), found.frames.copy()
        X[doubtful], Q[doubtful] = places[:, j], turned[:, j]
        starts.append((X, Q))
    again = _align(state, doubtful, _best_start(patches, doubtful, starts, view, settings)[0], view, settings)
    better = ~certain & (again.correlation > found.correlation + 1e-3)
    better &= again.n_views >= np.minimum(found.n_views, settings.n_views)
    return found.replaced(better, again)


def judge(state: Followed, found: PatchAlignment, view: FrameViews, settings: TrackingSettings) -> np.ndarray:
    """Return why each patch can't be taken as measured, (N,) int; `LAST_FRAME` (0) where it can."""
    size = state.patches.size
    reason = np.full(len(size), LAST_FRAME)
    alone = found.n_views == 1
    reason[found.image_sigma > settings.sigma_px * np.where(alone, _ALONE, 1.0) * size] = LOW_PRECISION
    reason[found.correlation < settings.correlation] = LOW_CORRELATION
    reason[found.n_views < _enough(state, found, settings)] = UNSEEN
    # a single camera's patch lies on the hull's front, which is where another silhouette ends
    asked = ~alone[:, None] | (found.by_camera > -1)
    reason[(reason == LAST_FRAME) & ~view.may_be_subject(found.positions, asked)] = OUTSIDE
    good = np.flatnonzero(reason == LAST_FRAME)
    near = nearest(state.patches.positions, good, good, _NEIGHBOURS)
    if near.shape[1] >= _AGREEING:
        old = state.patches
        places, _ = carried(old.positions, old.frames, near, found.positions, found.frames, good)
        away = places - found.positions[good][:, None]
        # where a single camera sees a patch its depth is rough: that counts a third
        ray = view.centers[found.by_camera[good].argmax(axis=1)] - found.positions[good]
        ray *= (alone[good] / np.linalg.norm(ray, axis=1))[:, None]
        away -= _ROUGH * np.einsum("nki,ni->nk", away, ray)[:, :, None] * ray[:, None]
        away = np.linalg.norm(away, axis=2)
        apart = np.sort(away, axis=1)[:, _AGREEING - 1] > settings.neighbour_px * size[good]
        reason[good[apart]] = APART
    return reason


def carry_lost(state: Followed, found: PatchAlignment, good: np.ndarray) -> PatchAlignment:
    """Put patches that were not measured where their companions have them; else where those nearest now go."""
    old = state.patches
    positions, frames, known = state.companions.placed(state.identity, good, found.positions, found.frames)
    lost, sure = np.flatnonzero(~known), np.flatnonzero(good)
    near = nearest(old.positions, lost, sure, 5)
    if near.shape[1]:
        places, turned = carried(old.positions, old.frames, near, found.positions, found.frames, lost)
        typical = np.linalg.norm(places - np.median(places, axis=1, keepdims=True), axis=2).argmin(axis=1)
        rows = np.arange(len(lost))
        positions[lost], frames[lost] = places[rows, typical], turned[rows, typical]
    else:
        moved = extrapolate(old.positions, old.frames, state.velocity, state.spin)
        positions[lost], frames[lost] = moved[0][lost], moved[1][lost]
    return found.at(positions, frames)


def renewed(patches: Patches, found: PatchAlignment, good: np.ndarray, view: FrameViews, templates: str) -> Patches:
    """Take templates of measured patches again: "previous" all, "updated" those that fit badly by now, "first" none."""
    if templates == "first":
        return patches
    stale = patches.has & good[:, None] & (found.by_camera > -1)
    if templates == "updated":
        stale &= found.by_camera < _NEW_TEMPLATE_CORRELATION
    return with_templates(replace(patches, slots=np.where(stale, -1, patches.slots)), stale, view, found.image_sigma)


def new_views(patches: Patches, found: PatchAlignment, good: np.ndarray, view: FrameViews, slack_px: float) -> Patches:
    """Take templates in cameras that have come to see a patch that two others measured well."""
    sure = good & (found.correlation > _NEW_TEMPLATE_CORRELATION) & (found.n_views >= 2)
    slack = hiding_depth(patches, view, 0.5 * slack_px)
    cosine = facings(patches.positions, patches.normals, view)
    want = visible(patches.positions, patches.frames, patches.hidden, view, slack, _FACING) & ~patches.has
    want &= (cosine > _NEW_TEMPLATE_FACING) & sure[:, None]
    return with_templates(patches, want, view, found.image_sigma) if want.any() else patches


def _enough(state: Followed, found: PatchAlignment, settings: TrackingSettings) -> np.ndarray:
    """Cameras that must agree, (N,) int: at least two, or one where no other is asked."""
    alone = state.by_one & ((found.by_camera > -1).sum(axis=1) == 1)
    return np.where(alone, 1, settings.n_views)


def _best_start(
    patches: Patches,
    which: np.ndarray,
    starts: list[tuple[np.ndarray, np.ndarray]],
    view: FrameViews,
    settings: TrackingSettings,
    fit: np.ndarray | None = None,
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Compare starts on the coarse level; return the best for each patch, and its correlations, (N, C) float.

    Each camera's correlation counts, and that it sees the patch there. `fit` is that of the first start, where known.
    """
    best = np.full(patches.has.shape, -1.0) if fit is None else fit.copy()
    X, Q = starts[0][0].copy(), starts[0][1].copy()
    for positions, frames in starts if fit is None else starts[1:]:
        use = _asked(patches, which, positions, frames, view, settings)
        tried = align(patches, which, positions, frames, use, view, iterations=(0, -1), least_correlation=-1.0)
        better = tried.by_camera.sum(axis=1) > best.sum(axis=1) + _BETTER
        best[better] = tried.by_camera[better]
        X[better], Q[better] = positions[better], frames[better]
    return (X, Q), best


def _align(
    state: Followed,
    which: np.ndarray,
    start: tuple[np.ndarray, np.ndarray],
    view: FrameViews,
    settings: TrackingSettings,
) -> PatchAlignment:
    """Align patches with the cameras that see them where they start."""
    patches = state.patches
    use = _asked(patches, which, *start, view, settings)
    alone = (use.sum(axis=1) == 1) & state.by_one
    found = align(
        patches,
        which[~alone[which]],
        *start,
        use,
        view,
        iterations=_ITERATIONS,
        least_correlation=settings.camera_correlation,
    )
    lonely = which[alone[which]]
    if not len(lonely):
        return found
    other = align_alone(patches, lonely, start, use, view, _ITERATIONS, settings.camera_correlation)
    return found.replaced(alone, other)


def _asked(
    patches: Patches,
    which: np.ndarray,
    positions: np.ndarray,
    frames: np.ndarray,
    view: FrameViews,
    settings: TrackingSettings,
) -> np.ndarray:
    """Cameras with a template that see patches `which` at given places, (N, C) bool."""
    slack = hiding_depth(patches, view, settings.slack_px)[which]
    use = np.zeros(patches.has.shape, bool)
    seen = visible(positions[which], frames[which], patches.hidden[which], view, slack, _FACING)
    use[which] = seen & patches.has[which]
    return use


def hiding_depth(patches: Patches, view: FrameViews, slack_px: float) -> np.ndarray:
    """Depth by which something must lie before patches to hide them, (N, 1), metres: not a voxel that sticks out."""
    return slack_px * patches.size[:, None] + _SLACK_VOXELS * view.voxel_size
