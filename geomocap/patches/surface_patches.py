"""Patches of the surface: small curved pieces with a place, a shape and a template in each camera that saw them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numba import njit

from geomocap.patches.alignment_kernel import align_patches
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.patch_templates import take_templates
from geomocap.patches.template_store import TemplateStore
from geomocap.scheduling import spread

_FEW = 32  # patches that are not worth waking other threads for
_COARSE_STRIDE = 2  # of the samples, on blurred levels
_OWN = ("positions", "frames", "curvature", "size", "radius", "slots", "hidden", "doubt")
FACING_OTHERS = 0.35  # cosine from which a camera looks for what another one has seen
SAME_SIDE = 0.5  # cosine between normals of patches on the same side of a limb


@dataclass(frozen=True)
class PatchAlignment:
    """What aligning patches with a frame found; leading axis N patches.

    Attributes
    ----------
    positions : (N, 3) float, metres, world
    frames : (N, 3, 3) float
        World from patch frame, rotations.
    correlation : (N,) float
        Mean over the cameras used, −1 without any.
    n_views : (N,) int
        Cameras whose correlation is good enough.
    sigma : (N,) float
        Standard deviation of a coordinate, metres: root mean square of the three axes; inf without solution.
    image_sigma : (N,) float
        The same without the depth where a single camera sees the patch.
    by_camera : (N, C) float
        Correlation in each camera, free of the images' noise, −1 where it has no part.
    """

    positions: np.ndarray
    frames: np.ndarray
    correlation: np.ndarray
    n_views: np.ndarray
    sigma: np.ndarray
    image_sigma: np.ndarray
    by_camera: np.ndarray

    def replaced(self, where: np.ndarray, other: PatchAlignment) -> PatchAlignment:
        """Return this alignment with that of `other` at some patches, (N,) bool."""
        parts = {}
        for field in fields(self):
            mine, new = getattr(self, field.name), getattr(other, field.name)
            parts[field.name] = np.where(where.reshape((-1,) + (1,) * (mine.ndim - 1)), new, mine)
        return PatchAlignment(**parts)

    def at(self, positions: np.ndarray, frames: np.ndarray) -> PatchAlignment:
        """Return it at other places."""
        return replace(self, positions=positions, frames=frames)

    def spread(self, which: np.ndarray, positions: np.ndarray, frames: np.ndarray) -> PatchAlignment:
        """Return it as rows `which` of an alignment of more patches at given places, the others not found."""
        N, C = len(positions), self.by_camera.shape[1]
        rest = PatchAlignment(
            positions.copy(),
            frames.copy(),
            np.full(N, -1.0),
            np.zeros(N, int),
            np.full(N, np.inf),
            np.full(N, np.inf),
            np.full((N, C), -1.0),
        )
        for field in fields(self):
            getattr(rest, field.name)[which] = getattr(self, field.name)
        return rest


@dataclass(frozen=True)
class Patches:
    """N patches with M samples each, ready to be looked for by C cameras.

    Attributes
    ----------
    positions : (N, 3) float, metres, world
        Where they are now.
    frames : (N, 3, 3) float
        World from patch frame, rotations; third axis: outward normal.
    curvature : (N, 3) float
        a, b, c of the surface z = a s² + b s t + c t² in the patch's frame, per metre.
    size : (N,) float
        Spacing of the samples: about a pixel, metres.
    radius : (N,) int
        Half the width in samples; narrow patches have fewer than M.
    slots : (N, C) int
        Where each camera's template is in the store; −1: it has none.
    store : TemplateStore
        Shared with patches that these were selected from.
    hidden : (N, C) float
        Depth of the patch beyond the (hull's) surface when its template was taken, metres; NaN where there is none.
    doubt : (N, C) float
        Standard deviation that the patch's place had when its template was taken, metres.
    """

    positions: np.ndarray
    frames: np.ndarray
    curvature: np.ndarray
    size: np.ndarray
    radius: np.ndarray
    slots: np.ndarray
    store: TemplateStore
    hidden: np.ndarray
    doubt: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def empty(cls, room: tuple[int, int, int]) -> Patches:
        """Return no patches, for samples M, cameras C and levels L."""
        none = np.zeros((0, 3))
        return cls.without_templates(none, none.reshape(0, 3, 3), none, np.zeros(0), 0, room)

    @classmethod
    def without_templates(
        cls,
        positions: np.ndarray,
        frames: np.ndarray,
        curvature: np.ndarray,
        size: np.ndarray,
        radius: np.ndarray | int,
        room: tuple[int, int, int],
    ) -> Patches:
        """Return patches that no camera has a template of yet; `room` for samples M, cameras C and levels L."""
        N, (M, C, L) = len(positions), room
        return cls(
            np.array(positions, np.float64),
            np.array(frames, np.float64),
            curvature,
            size,
            np.full(N, radius),
            np.full((N, C), -1),
            TemplateStore.empty(L, M),
            np.full((N, C), np.nan),
            np.zeros((N, C)),
        )

    def cleared(self, room: tuple[int, int, int]) -> Patches:
        """Return them without the templates, with `room` for others, see `without_templates`."""
        return self.without_templates(self.positions, self.frames, self.curvature, self.size, self.radius, room)

    def select(self, which: np.ndarray) -> Patches:
        """Return some of them, by a mask or by positions."""
        return replace(self, **{name: getattr(self, name)[which] for name in _OWN})

    def join(self, other: Patches) -> Patches:
        """Return these followed by others; these share their store with the new ones from then on."""
        parts = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _OWN}
        store, mine, others = self.store.join(self.slots, other.store, other.slots)
        parts["slots"] = np.concatenate([mine, others])
        return Patches(**parts, store=store)

    def moved(self, positions: np.ndarray, frames: np.ndarray) -> Patches:
        """Return them at other places."""
        return replace(self, positions=positions, frames=frames)

    @property
    def has(self) -> np.ndarray:
        """Cameras with a template, (N, C) bool."""
        return self.slots >= 0

    @property
    def normals(self) -> np.ndarray:
        """Outward normals, (N, 3) float, world."""
        return self.frames[:, :, 2]


def visible(
    positions: np.ndarray, frames: np.ndarray, hidden: np.ndarray, view: FrameViews, slack: np.ndarray, facing: float
) -> np.ndarray:
    """Find which cameras see patches at given places: (N, C) bool.

    A camera sees a patch that is turned to it if the subject's surface doesn't lie nearer by more than `slack` than it
    did when the template was taken: a hull stands off the true surface.

    Parameters
    ----------
    positions, frames : (N, 3), (N, 3, 3) float
    hidden : (N, C) float
        How far behind the surface they were then, see `Patches`.
    view : FrameViews
    slack : (N, 1) float, metres
    facing : float
        Least cosine between normal and direction to the camera.
    """
    seen = np.empty(hidden.shape, np.bool_)
    spread(
        _see,
        len(seen),
        np.ascontiguousarray(positions, np.float64),
        np.ascontiguousarray(frames[:, :, 2], np.float64),
        (view.projections, view.centers, view.depth),
        hidden,
        np.broadcast_to(slack, (len(seen), 1)).copy(),
        facing,
        seen,
        few=_FEW,
    )
    return seen


@njit(cache=True, nogil=True, error_model="numpy")
def _see(begin, end, positions, normals, views, hidden, slack, facing, seen):
    """Fill `seen` (N, C), see `visible`; views: projections (C, 3, 4), centers (C, 3), depth of surfaces (C, H, W)."""
    P, centers, surface = views
    C, H, W = surface.shape
    for n in range(begin, end):
        x, y, z = positions[n]
        for c in range(C):
            seen[n, c] = False
            a, b, d = centers[c, 0] - x, centers[c, 1] - y, centers[c, 2] - z
            cosine = a * normals[n, 0] + b * normals[n, 1] + d * normals[n, 2]
            if not cosine / np.sqrt(a * a + b * b + d * d) > facing:
                continue
            w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
            u = (P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 2] * z + P[c, 0, 3]) / w
            v = (P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 2] * z + P[c, 1, 3]) / w
            if w > 0 and u >= -0.5 and v >= -0.5 and u <= W and v <= H:
                column, row = int(np.rint(u)), int(np.rint(v))
                if column < W and row < H and np.isfinite(surface[c, row, column]):
                    behind = hidden[n, c] if hidden[n, c] > 0 else 0.0
                    seen[n, c] = w - surface[c, row, column] - behind < slack[n, 0]


def facings(positions: np.ndarray, normals: np.ndarray, view: FrameViews) -> np.ndarray:
    """Return the cosines between normals and the directions to the cameras: (N, C) float."""
    ray = view.centers[None] - positions[:, None]
    return np.einsum("nci,ni->nc", ray, normals) / np.linalg.norm(ray, axis=2)


def with_templates(patches: Patches, want: np.ndarray, view: FrameViews, sigma: np.ndarray | None = None) -> Patches:
    """Take templates in the cameras `want` (N, C) bool that have none; where too little is seen there is none.

    The new patches share their store with those given as long as it has room, see `TemplateStore`.
    `sigma` (N,): standard deviation of their places, metres; 0 if not given, as where patches begin.
    """
    took = np.ascontiguousarray(want & ~patches.has, np.uint8)
    asked = int(np.count_nonzero(took))
    store, slots = patches.store.with_room(patches.slots, asked)
    slots = slots.copy()
    slots[took != 0] = np.arange(store.used, store.used + asked)
    store.used += asked
    spread(
        take_templates,
        len(took),
        patches.positions,
        patches.frames,
        (patches.curvature, patches.size, patches.radius),
        slots,
        took,
        view.levels,
        view.masks,
        view.projections,
        store.templates,
        store.usable,
    )
    got = took != 0
    slots[want & ~patches.has & ~got] = -1
    depth, surface = view.depths(patches.positions)
    hidden = np.where(got, depth - surface, patches.hidden)
    doubt = np.where(got, 0.0 if sigma is None else sigma[:, None], patches.doubt)
    return replace(patches, slots=slots, store=store, hidden=hidden, doubt=doubt)


def one_template(patches: Patches, view: FrameViews) -> tuple[Patches, np.ndarray]:
    """Give all cameras the template of the camera (N,) that faces each patch best, of those that have one."""
    best = np.where(patches.has, facings(patches.positions, patches.normals, view), -2).argmax(axis=1)
    shared = as_one_camera(patches, best, np.ones_like(patches.has))
    return replace(shared, doubt=np.zeros_like(patches.doubt)), best  # it is the same for all cameras


def as_one_camera(patches: Patches, camera: np.ndarray, has: np.ndarray) -> Patches:
    """Let the cameras `has` (N, C) look for what one camera, (N,) int, has seen of each patch."""
    own = patches.slots[np.arange(len(patches)), camera]
    return replace(patches, slots=np.where(has, own[:, None], -1))


def doubted(patches: Patches, found: PatchAlignment) -> PatchAlignment:
    """Add to standard deviations how well the places were known at which templates were taken: drift adds up.

    The templates of a patch err together, as they were taken where others had put it; each counts as it weighs.
    """
    part = found.by_camera > -1
    own = (found.image_sigma**2 * np.maximum(part.sum(axis=1), 1))[:, None]
    weight = np.where(part & np.isfinite(own), 1.0 / (own + patches.doubt**2), 0.0)
    together = (weight * patches.doubt).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-30)
    return replace(found, sigma=np.hypot(found.sigma, together), image_sigma=np.hypot(found.image_sigma, together))


def align(
    patches: Patches,
    which: np.ndarray,
    positions: np.ndarray,
    frames: np.ndarray,
    use: np.ndarray,
    view: FrameViews,
    *,
    iterations: tuple[int, ...],
    least_correlation: float,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
    prior_shift_px: float = 30.0,
    prior_turn: float = 0.4,
) -> PatchAlignment:
    """Align patches with a frame, from the coarsest level to the finest.

    Parameters
    ----------
    patches : Patches
    which : (A,) int
        Patches to align; the others keep the given places.
    positions, frames : (N, 3), (N, 3, 3) float
        Places to start from.
    use : (N, C) bool
        Cameras to use.
    view : FrameViews
    iterations : tuple of int
        Most iterations on each level, from the coarsest; a level with −1 is left out, 0 compares only.
    least_correlation : float
        A camera counts from here on.
    prior : pair of (N, 3), (N, 3, 3) float, optional
        Where the patches are expected; the start if not given.
    prior_shift_px, prior_turn : float
        Standard deviation of that, in units of the patches' sample spacing, and radians.
    """
    X, Q = np.array(positions, np.float64), np.array(frames, np.float64)
    N, C = use.shape
    correlation = np.full((N, C), -1.0)
    covariance = np.full((N, 6), np.nan)
    expected = (X.copy(), Q.copy()) if prior is None else prior
    form = patches.curvature, patches.size, patches.radius
    for level, count in enumerate(iterations):
        if count < 0:
            continue
        spread(
            align_patches,
            len(which),
            which,
            X,
            Q,
            (*form, patches.slots, patches.store.templates, patches.store.usable, patches.doubt),
            np.ascontiguousarray(use, np.uint8),
            (view.levels[level], view.masks, view.projections, view.centers, view.noise[level]),
            level,
            1 if level == len(view.levels) - 1 else _COARSE_STRIDE,
            level == len(view.levels) - 1,
            (*expected, prior_shift_px * patches.size, np.full(N, prior_turn)),
            count,
            least_correlation,
            correlation,
            covariance,
            few=_FEW,
        )
    score, n_views, sigma = np.full(N, -1.0), np.zeros(N, int), np.full(N, np.inf)
    asked = correlation[which]
    part = asked > -1
    counted = part & (asked >= least_correlation)
    mean = np.where(part, asked, 0).sum(axis=1) / np.maximum(part.sum(axis=1), 1)
    best = np.where(counted, asked, 0).sum(axis=1) / np.maximum(counted.sum(axis=1), 1)
    score[which] = np.where(part.any(axis=1), np.where(counted.any(axis=1), best, mean), -1.0)
    n_views[which] = counted.sum(axis=1)
    found = np.sqrt(covariance[which, :3].mean(axis=1))
    sigma[which] = np.where(np.isfinite(found), found, np.inf)
    return PatchAlignment(X, Q, score, n_views, sigma, sigma, correlation)
