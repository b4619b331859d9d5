"""Where a rigid piece of the surface is now, which may be anywhere and turned any way: by the texture of its patches.

A place on the surface whose texture, turned in its plane, is that of one patch of the piece says where all the others
must be, as a patch has all six degrees of freedom. Of thousands of such motions the most promising are those that put
the other patches on the surface too, next to places that look like them. These are drawn to the places that fit best,
then compared with the images, patch by patch, with one template for all cameras, as the piece may have turned towards
others; the best are aligned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from geomocap.model.rotations import rigid_motion
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.piece_textures import ANGLES, best_matches, likenesses, patch_radius, textures_of
from geomocap.patches.seeding import spaced, surface_frames
from geomocap.patches.surface_patches import (
    FACING_OTHERS,
    SAME_SIDE,
    PatchAlignment,
    Patches,
    align,
    facings,
    one_template,
    visible,
    with_templates,
)
from geomocap.scheduling import spread

_FREE = 1.5  # spacings from the nearest patch
_DENSE = 0.7  # distance of the places looked at, spacings,
_MOST_PLACES = 10_000  # if there are not more than about so many
_HULL_VOXELS = 2.0  # a place may lie so far behind the drawn surface
_MATCHED, _TRIED = 128, 32  # patches of a piece whose textures are looked for; that stand for it
_PART = 0.6  # fraction of them that must fit: the piece may have been two
_INSIDE = 0.6  # fraction of the patches that must lie in the silhouettes
_BESIDE = 1.5  # spacings; a patch is compared with places so near to it
_CELL = 0.5  # edge of the cells in which these are looked up, spacings
_LOOKED_AT = 4000  # motions for which all patches are looked at
_LIKELY, _BEST_OF = 300, 6  # motions that are drawn to the best of so many places
_COMPARED, _ALIGNED = 100, 12  # motions that are compared with the images, and aligned
_SHIFT_PX, _TURN = 5.0, 0.2  # how far patches may be from where the piece has them; radians
_KNOWN = 0.7  # correlation from which a patch says where the piece is,
_ALIKE = 0.8  # and from which it has been found
_FITTING, _FITTING_FRACTION = 7, 0.3  # patches that must have been; fraction of those that are seen
_ARM = 0.2  # spacings: how much a place's frame counts where pieces are drawn to places


def free_places(taken: np.ndarray, patches: Patches, view: FrameViews, spacing: float) -> Patches:
    """Cover the surface that has no patches near, with templates of the camera that faces each place best.

    Parameters
    ----------
    taken : (K, 3) float, metres
        Where patches are.
    patches : Patches
        Patches that will be looked for there, for their size.
    view : FrameViews
    spacing : float
        Distance of patches, metres.
    """
    free = view.surface
    if len(taken):
        free = free[cKDTree(taken).query(free)[0] > _FREE * spacing]
    C, (L, M) = view.count, patches.store.templates.shape[1:3]
    room = M, C, L
    if not len(free):
        return Patches.empty(room)
    distance = max(_DENSE * spacing, view.voxel_size * float(np.sqrt(len(free) / _MOST_PLACES)))
    points = free[spaced(free, distance, np.zeros((0, 3)), np.random.default_rng(0))]
    positions, frames, curvature = surface_frames(view, points)
    size = np.full(len(positions), np.median(patches.size))
    blank = Patches.without_templates(positions, frames, curvature, size, patch_radius(M), room)
    slack = np.full((len(points), 1), _HULL_VOXELS * view.voxel_size)
    seen = visible(positions, frames, blank.hidden, view, slack, FACING_OTHERS)
    best = np.where(seen, facings(positions, blank.normals, view), -2).argmax(axis=1)
    covered = with_templates(blank, seen & (np.arange(C) == best[:, None]), view)
    return covered.select(np.flatnonzero(covered.has.any(axis=1)))


def motion_of_piece(
    piece: Patches, places: Patches, view: FrameViews, slack: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the turn (3, 3) and shift (3,), metres, of a piece to where it is now; None: it isn't found.

    Parameters
    ----------
    piece : Patches
        n patches where they were before.
    places : Patches
        The surface on which the piece may be, see `free_places`.
    view : FrameViews
    slack : (n, 1) float, metres
        Depth by which something must lie before a patch to hide it.
    spacing : float
        Distance of patches, metres.
    """
    kept = _some(np.flatnonzero(piece.has.any(axis=1)), _MATCHED)
    if not len(kept) or not len(places):
        return None
    piece, slack = piece.select(kept), slack[kept]
    some = _some(np.arange(len(kept)), _TRIED)
    X, Q = piece.positions[some], piece.frames[some]
    turns, shifts = _promising(piece, some, places, view, spacing)
    shared, _ = one_template(piece.select(some), view)
    for iterations, count in (((2, -1), _ALIGNED), ((8, -1), _ALIGNED), ((4, 8), _ALIGNED), ((0, 0), 1)):
        if not len(turns):
            return None
        value, at = _compare(shared, turns, shifts, view, slack[some], iterations)
        best = np.argsort(-np.maximum(2 * value - 1, 0.0).mean(axis=1), kind="stable")[:count]
        turns, shifts, value = turns[best], shifts[best], value[best]
        if iterations[0] > 2:
            sure = np.maximum(value - _KNOWN, 0.0) + 1e-3
            turns, shifts = rigid_motions(X, Q, at.positions[best], at.frames[best], sure, spacing)
    fits = (value[0] > _ALIKE).sum()
    return (turns[0], shifts[0]) if fits >= max(_FITTING, _FITTING_FRACTION * (value[0] > 0).sum()) else None


def _some(rows: np.ndarray, most: int) -> np.ndarray:
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]


@dataclass(frozen=True)
class _FoundPlaces:
    """Where m patches of a piece were found from K motions: (K, m, 3) and (K, m, 3, 3)."""

    positions: np.ndarray
    frames: np.ndarray


def _compare(
    piece: Patches,
    turns: np.ndarray,
    shifts: np.ndarray,
    view: FrameViews,
    slack: np.ndarray,
    iterations: tuple[int, int],
) -> tuple[np.ndarray, _FoundPlaces]:
    """Align the m patches of a piece from K motions: correlations (K, m), 0 where not seen, and where they are."""
    K, m = len(turns), len(piece)
    rows = np.tile(np.arange(m), K)
    many = piece.select(rows)
    X = (piece.positions @ turns.swapaxes(1, 2) + shifts[:, None]).reshape(-1, 3)
    Q = (turns[:, None] @ piece.frames).reshape(-1, 3, 3)
    use = visible(X, Q, many.hidden, view, slack[rows], FACING_OTHERS)
    at: PatchAlignment = align(
        many,
        np.flatnonzero(use.any(axis=1)),
        X,
        Q,
        use,
        view,
        iterations=iterations,
        least_correlation=0.0,
        prior_shift_px=_SHIFT_PX,
        prior_turn=_TURN,
    )
    value = np.maximum(at.correlation, 0.0).reshape(K, m)
    return value, _FoundPlaces(at.positions.reshape(K, m, 3), at.frames.reshape(K, m, 3, 3))


def _promising(
    piece: Patches, some: np.ndarray, places: Patches, view: FrameViews, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Turns (K, 3, 3) and shifts (K, 3) that put the patches `some` (m,) next to places that look like them."""
    alike = likenesses(textures_of(piece), textures_of(places))
    k, i, j = best_matches(alike)
    angle = 2 * np.pi * k / ANGLES
    c, s, o, e = np.cos(angle), np.sin(angle), np.zeros(len(k)), np.ones(len(k))
    in_plane = np.stack([c, -s, o, s, c, o, o, o, e], axis=1).reshape(-1, 3, 3)
    turns = places.frames[j] @ in_plane @ piece.frames[i].swapaxes(1, 2)
    shifts = places.positions[j] - (turns @ piece.positions[i][:, :, None])[:, :, 0]
    X, Q = piece.positions[some], piece.frames[some]
    low, cells = _nearest_places(places.positions, spacing)
    for who, count in ((some, _LOOKED_AT), (np.arange(len(piece)), 2 * _LIKELY)):
        value = np.empty(len(turns), np.float32)
        own = piece.positions[who], piece.frames[who]
        grid = low, _CELL * spacing, cells
        spread(together, len(turns), turns, shifts, *own, who, places.frames, alike, *grid, value)
        likely = np.argsort(-value, kind="stable")[:count]
        turns, shifts = turns[likely], shifts[likely]
    inside = view.may_be_subject((X @ turns.swapaxes(1, 2) + shifts[:, None]).reshape(-1, 3))
    likely = inside.reshape(len(turns), -1).mean(axis=1) >= _INSIDE
    turns, shifts = turns[likely], shifts[likely]
    tree = cKDTree(np.hstack([places.positions, spacing * places.normals]))
    for count in (_LIKELY, _COMPARED):
        value, near = _beside(X, Q, turns, shifts, places, tree, alike[:, some], _BEST_OF, spacing)
        typical = np.sort(value, axis=1)[:, -round(_PART * len(some)) :].mean(axis=1)
        best = np.argsort(-typical, kind="stable")[:count]
        turns, shifts, value, near = turns[best], shifts[best], value[best], near[best]
        if len(turns):
            carried = X @ turns.swapaxes(1, 2) + shifts[:, None]
            goal = np.where((value > 0.5)[:, :, None], places.positions[near], carried)
            weight = np.maximum(2 * value - 1, 0.0) + 0.01
            turns, shifts = rigid_motions(X, Q, goal, turns[:, None] @ Q, weight, _ARM * spacing)
    return turns, shifts


def _nearest_places(positions: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells of space that know the nearest of places (P, 3): their lower corner (3,), and the places, −1 for none."""
    low = positions.min(axis=0) - (_BESIDE + _CELL) * spacing
    shape = np.ceil((positions.max(axis=0) + _BESIDE * spacing - low) / (_CELL * spacing)).astype(int) + 1
    cells = np.full(shape, -1, np.int32)
    fill_cells(positions, low, _CELL * spacing, _BESIDE * spacing, cells, np.full(shape, np.inf, np.float32))
    return low, cells


@njit(cache=True, nogil=True, error_model="numpy")
def fill_cells(positions, low, edge, reach, cells, squared):
    """Let each cell know the nearest place whose distance from the cell's middle is below `reach`."""
    n = int(np.ceil(reach / edge))
    for p in range(len(positions)):
        x, y, z = positions[p]
        a, b, c = int((x - low[0]) / edge), int((y - low[1]) / edge), int((z - low[2]) / edge)
        for i in range(max(a - n, 0), min(a + n + 1, cells.shape[0])):
            for j in range(max(b - n, 0), min(b + n + 1, cells.shape[1])):
                for k in range(max(c - n, 0), min(c + n + 1, cells.shape[2])):
                    d = (low[0] + (i + 0.5) * edge - x) ** 2
                    d += (low[1] + (j + 0.5) * edge - y) ** 2 + (low[2] + (k + 0.5) * edge - z) ** 2
                    if d < squared[i, j, k] and d < reach * reach:
                        squared[i, j, k] = d
                        cells[i, j, k] = p


@njit(cache=True, nogil=True, error_model="numpy")
def together(begin, end, turns, shifts, X, Q, who, frames, alike, low, edge, cells, value):
    """How much m patches look like the places next to which K motions put them, on average: into `value` (K,).

    Parameters
    ----------
    turns, shifts : (K, 3, 3), (K, 3) float
    X, Q : (m, 3), (m, 3, 3) float
        Patches before the motion.
    who : (m,) int
        Which they are among those compared.
    frames : (P, 3, 3) float
        Of the places.
    alike : (A, n, P) float32
        How much n patches look like places, turned by A angles.
    low, edge, cells : (3,) float, float, (…) int32
        See `_nearest_places`.
    """
    A, m = len(alike), len(X)
    y, turned = np.empty(3), np.empty((3, 3))
    for n in range(begin, end):
        total = 0.0
        for p in range(m):
            inside = True
            for r in range(3):
                y[r] = shifts[n, r]
                for c in range(3):
                    y[r] += turns[n, r, c] * X[p, c]
                y[r] = (y[r] - low[r]) / edge
                inside &= 0 <= y[r] < cells.shape[r]
            if not inside:
                continue
            place = cells[int(y[0]), int(y[1]), int(y[2])]
            if place < 0:
                continue
            for r in range(3):
                for c in range(3):
                    turned[r, c] = (
                        turns[n, r, 0] * Q[p, 0, c] + turns[n, r, 1] * Q[p, 1, c] + turns[n, r, 2] * Q[p, 2, c]
                    )
            F = frames[place]
            normal = F[0, 2] * turned[0, 2] + F[1, 2] * turned[1, 2] + F[2, 2] * turned[2, 2]
            if normal < SAME_SIDE:
                continue
            ss = F[0, 0] * turned[0, 0] + F[1, 0] * turned[1, 0] + F[2, 0] * turned[2, 0]
            st = F[0, 0] * turned[0, 1] + F[1, 0] * turned[1, 1] + F[2, 0] * turned[2, 1]
            ts = F[0, 1] * turned[0, 0] + F[1, 1] * turned[1, 0] + F[2, 1] * turned[2, 0]
            tt = F[0, 1] * turned[0, 1] + F[1, 1] * turned[1, 1] + F[2, 1] * turned[2, 1]
            k = int(np.rint(np.arctan2(ts - st, ss + tt) * A / (2 * np.pi))) % A
            total += max(alike[k, who[p], place], 0.0)
        value[n] = total / m


def _beside(
    X: np.ndarray,
    Q: np.ndarray,
    turns: np.ndarray,
    shifts: np.ndarray,
    places: Patches,
    tree: cKDTree,
    alike: np.ndarray,
    count: int,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray]:
    """How much patches are like the best of the `count` places next to which K motions put them, and which: (K, m).

    `alike` (A, m, P): how much they are like each place, turned by each angle.
    """
    K, m = len(turns), len(X)
    turned = turns[:, None] @ Q
    where = np.concatenate([X @ turns.swapaxes(1, 2) + shifts[:, None], spacing * turned[:, :, :, 2]], axis=2)
    near = tree.query(where.reshape(-1, 6), count, distance_upper_bound=_BESIDE * spacing)[1].reshape(K, m, count)
    there = near < len(places)
    near = np.where(there, near, 0)
    between = places.frames[near].swapaxes(3, 4) @ turned[:, :, None]
    angle = np.arctan2(between[..., 1, 0] - between[..., 0, 1], between[..., 0, 0] + between[..., 1, 1])
    k = np.rint(angle * ANGLES / (2 * np.pi)).astype(int) % ANGLES
    value = np.where(there, np.maximum(alike[k, np.arange(m)[:, None], near], 0.0), 0.0)
    best = value.argmax(axis=2)[:, :, None]
    return np.take_along_axis(value, best, 2)[:, :, 0], np.take_along_axis(near, best, 2)[:, :, 0]


def rigid_motions(
    X: np.ndarray, Q: np.ndarray, Y: np.ndarray, S: np.ndarray, weight: np.ndarray, arm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit K turns (K, 3, 3) and shifts (K, 3) to m places that have frames, robustly (Kabsch's method).

    Parameters
    ----------
    X, Q : (m, 3), (m, 3, 3) float
        Places and frames before.
    Y, S : (K, m, 3), (K, m, 3, 3) float
        And now.
    weight : (K, m) float
    arm : float, metres
        A frame counts as three points so far from its place.
    """
    a = np.concatenate([X[:, None], X[:, None] + arm * Q.swapaxes(1, 2)], axis=1).reshape(-1, 3)
    b = np.concatenate([Y[:, :, None], Y[:, :, None] + arm * S.swapaxes(2, 3)], axis=2).reshape(len(Y), -1, 3)
    robust = np.ones_like(weight)
    for _ in range(4):
        turns, shifts = rigid_motion(a, b, np.repeat(weight * robust, 4, axis=1))
        off = np.linalg.norm(a @ turns.swapaxes(1, 2) + shifts[:, None] - b, axis=2)
        off = off.reshape(*weight.shape, 4).mean(axis=2)
        typical = np.maximum(np.median(off, axis=1, keepdims=True), 0.1 * arm)
        robust = 1 / (1 + (off / (2 * typical)) ** 2) ** 2
    return turns, shifts
