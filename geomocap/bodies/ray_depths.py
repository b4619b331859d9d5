"""Depths of what a single camera sees, from the motions of the bodies.

The image of one camera shows how a sample moves across its ray; how deep it lies is only known from the
volume, whose hull may stand off the surface by more than a limb is thick, in each frame by another length. So a trunk
comes in pieces. But a sample keeps its place in a body: where the body turns, its path across the rays tells
its depth, as in structure from motion (Tomasi, Kanade, Shape and motion from image streams under orthography, 1992),
here body by body, and with the depths that the volume shows as a weak prior. Where there are silhouettes, the volume is
that which those of all frames leave of the body (`shape_across_time`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from scipy.spatial import cKDTree

from geomocap.bodies.body_settings import FOLLOWED, MotionBodiesSettings
from geomocap.bodies.motion_bodies import MotionBodies, find_motion_bodies
from geomocap.bodies.rigid_motions import fit_rigid_motion
from geomocap.bodies.shape_across_time import MAY_MISS, hull_fronts
from geomocap.model.motion_paths import MotionPaths
from geomocap.model.outlines import Outlines
from geomocap.model.small_systems import solve_symmetric
from geomocap.progress import Progress, silent
from geomocap.scheduling import spread

_DEPTH_FRACTION = 0.05  # of what is missed along a ray, counts for a sample's place;
_FRONT_FRACTION = 0.3  # of the hull of all frames: paths drift by 1 to 3 mm where that is about 10 mm wrong
_ROUNDS = 2  # in which samples choose bodies and these move anew
_EXPLAINED = 2.0  # median misses by which a body may miss a sample that it explains,
_NEARLY_BEST = 1.5  # or so many times those of the body that explains it best
_LARGEST = 0.015  # diagonals; larger misses count as this
_LOCAL = 0.06  # diagonals between a sample and the nearest one of a body that may explain it
_BEFORE = 0.01  # diagonals by which it may come before the hull
_CORE = 0.85  # fraction of one body that makes a sample tell its motion
_LEAST = 6  # samples of a body
_REGULAR = 1e-9
_REACH = 0.15  # diagonals; fronts are looked for so far: hulls of four cameras stood off a trunk by 0.1 (90 %)
_STEP = 0.004  # diagonals; in steps, thinner than what any body is wide
_STAGE = "bodies"


@dataclass(frozen=True)
class _RestPlaces:
    """Where samples lie at rest, if given motions carry them.

    Attributes
    ----------
    rest : (N, 3) float, metres
    miss : (N,) float, metres
        Root mean square distance across the rays.
    depth : (N, T) float, metres
        Along the rays, from the given positions; 0 where these are sure or missing.
    outside : (N,) float
        Fraction of the silhouettes that motions carry samples out of, however deep these lie.
    """

    rest: np.ndarray
    miss: np.ndarray
    depth: np.ndarray
    outside: np.ndarray


def find_bodies_and_depths(
    paths: MotionPaths,
    settings: MotionBodiesSettings | None = None,
    progress: Progress = silent,
    outlines: Outlines | None = None,
) -> tuple[MotionBodies, MotionPaths]:
    """Find bodies, from their motions the depths of what single cameras see, and bodies from these; again and again.

    Wrong depths make a surface that no rigid bodies move, so `depth_rounds` further rounds come nearer and nearer. With
    `outlines`, the silhouettes of these cameras, depths are those of the hull that all frames leave. Other parameters
    and errors are those of `find_motion_bodies`. Also returns the paths that the bodies are of.
    """
    settings = settings or MotionBodiesSettings()
    if outlines is not None:
        outlines.check_frames(paths.frames)
    rounds = settings.depth_rounds if paths.ray is not None and paths.ray.any() else 0
    progress(_STAGE, 0, 1 + rounds)
    bodies = find_motion_bodies(paths, settings)
    for k in range(1, 1 + rounds):
        progress(_STAGE, k, 1 + rounds)
        paths = settle_depths(paths, bodies, outlines)
        bodies = find_motion_bodies(paths, settings)
    progress(_STAGE, 1 + rounds, 1 + rounds)
    return bodies, paths


def settle_depths(paths: MotionPaths, bodies: MotionBodies, outlines: Outlines | None = None) -> MotionPaths:
    """Move positions along their rays to where the motion of a body carries them.

    Samples that mostly a single camera sees choose a body anew, for which hulls that are no surface may have lain in
    between: of those whose motion explains their path across the rays about as well as any, with a depth not
    before the hull, the one with the most samples. A piece of the hull that moves unlike the body behind it only
    because of its depth so comes to that body.

    Parameters
    ----------
    paths : MotionPaths
        Without `ray` they are returned as they are.
    bodies : MotionBodies
        Found from these paths, or from these at other depths.
    outlines : Outlines, optional
        Silhouettes of the cameras that see them.

    Returns
    -------
    MotionPaths
        Find bodies from them again: more of what moves as one looks so.
    """
    if paths.ray is None or not paths.ray.any():
        return paths
    label, weights, rest = bodies.label.astype(int), bodies.weights, bodies.rest
    rotations, translations = bodies.rotations.swapaxes(0, 1), bodies.translations.swapaxes(0, 1)
    lone = (paths.ray.any(axis=2) & paths.seen).sum(axis=1) > 0.5 * paths.seen.sum(axis=1)
    own = _blended(paths, weights, rotations, translations, outlines)
    for k in range(_ROUNDS):
        chosen = _choose(paths, lone, own, label, rest, rotations, translations, outlines)
        changed = chosen != label
        label = chosen
        weights = np.where(changed[:, None], np.eye(len(rotations))[label], weights)
        own = _blended(paths, weights, rotations, translations, outlines)
        if k < _ROUNDS - 1:
            rest = own.rest
            label, weights, rotations, translations = _refit(paths, own, label, weights, rotations, translations)
    return replace(paths, positions=_moved(paths, own))


def _moved(paths: MotionPaths, places: _RestPlaces) -> np.ndarray:
    assert paths.ray is not None
    return paths.positions + places.depth[..., None] * paths.ray


def _blended(
    paths: MotionPaths,
    weights: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    outlines: Outlines | None,
) -> _RestPlaces:
    """Places of samples that follow their bodies with given weights (N, B)."""
    turns = np.einsum("nb,btij->ntij", weights, rotations)
    return _place(paths, turns, np.einsum("nb,bti->nti", weights, translations), outlines)[1]


def _choose(
    paths: MotionPaths,
    asked: np.ndarray,
    own: _RestPlaces,
    label: np.ndarray,
    rest: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    outlines: Outlines | None,
) -> np.ndarray:
    """Largest of the bodies that explain each sample, (N,) int; that which it has if there is none nearby.

    Only samples `asked` (N,) bool may choose.
    """
    assert paths.ray is not None
    count = len(rotations)
    misses, outside = np.full((len(label), count), np.inf), np.ones((len(label), count))
    alone = np.maximum((paths.ray.any(axis=2) & paths.seen).sum(axis=1), 1)
    for b in range(count):
        body = cKDTree(rest[label == b])
        some, found = _place(paths, rotations[b : b + 1], translations[b : b + 1], outlines, asked, body)
        near = body.query(found.rest)[0] < _LOCAL * paths.diagonal
        before = found.depth.sum(axis=1) / alone[some] < -_BEFORE * paths.diagonal
        misses[some, b], outside[some, b] = np.where(near & ~before, found.miss, np.inf), found.outside
    # a motion that carries a sample out of silhouettes in which another one keeps it is not its own
    misses[outside > outside.min(axis=1, keepdims=True) + MAY_MISS] = np.inf
    best = misses.min(axis=1)
    limit = np.maximum(_NEARLY_BEST * best, _EXPLAINED * float(np.median(own.miss)))
    sizes = np.bincount(label, minlength=count)
    largest = np.where(misses <= limit[:, None], sizes, -1).argmax(axis=1)
    return np.where(np.isfinite(best), largest, label)


def _refit(
    paths: MotionPaths,
    places: _RestPlaces,
    label: np.ndarray,
    weights: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Motions of the bodies that still have samples, from these at their new depths: labels, weights, motions."""
    assert paths.ray is not None
    seen, positions = paths.seen, _moved(paths, places)
    rotations, translations = rotations.copy(), translations.copy()
    kept = np.unique(label)
    for b in kept:
        some = np.flatnonzero((label == b) & (weights[:, b] > _CORE))
        if len(some) < _LEAST:
            continue
        carried = np.einsum("tij,nj->nti", rotations[b], places.rest[some]) + translations[b]
        there = np.where(seen[some, :, None], positions[some], carried)
        sure = np.where(seen[some], 1.0, 1e-3)
        rotations[b], translations[b], _ = fit_rigid_motion(
            there, places.rest[some], sure, FOLLOWED * paths.diagonal, ray=paths.ray[some]
        )
    weights = weights[:, kept]
    weights /= weights.sum(axis=1, keepdims=True)
    return np.searchsorted(kept, label), weights, rotations[kept], translations[kept]


def _place(
    paths: MotionPaths,
    rotations: np.ndarray,
    translations: np.ndarray,
    outlines: Outlines | None,
    asked: np.ndarray | None = None,
    body: cKDTree | None = None,
) -> tuple[np.ndarray, _RestPlaces]:
    """Find where samples lie at rest, if motions (N or 1, T, 3, 3), (N or 1, T, 3) carry them.

    With silhouettes their depths are not those of each frame's hull, but of the hull of all frames. Of `asked`
    samples, (N,) bool, those are left out that can't come near a `body` at any depth. Returns which are left, too.
    """
    assert paths.ray is not None
    diagonal, some = paths.diagonal, np.arange(paths.count) if asked is None else np.flatnonzero(asked)
    motions = np.ascontiguousarray(rotations), np.ascontiguousarray(translations)
    largest = _LARGEST * diagonal

    def places(moved: np.ndarray, depth_fraction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return place_samples(moved, paths.seen[some], ray, *motions, depth_fraction, largest)

    positions, ray = np.nan_to_num(paths.positions[some]), np.ascontiguousarray(paths.ray[some], np.float64)
    rest, miss, depth = places(positions, _DEPTH_FRACTION)
    if outlines is None:
        return some, _RestPlaces(rest, miss, depth, np.zeros(len(some)))
    seen_along = np.where(paths.seen[some][..., None], ray, 0.0)
    inward = np.einsum("ntji,ntj->ni", np.broadcast_to(rotations, (*ray.shape, 3)), seen_along)
    length = np.linalg.norm(inward, axis=1, keepdims=True)
    inward /= np.where(length > 0, length, 1.0)
    if body is not None:
        close = _comes_near(rest, inward, body, diagonal)
        some, positions, ray, rest, inward = (a[close] for a in (some, positions, ray, rest, inward))
    shift, outside = hull_fronts(rest, inward, *motions, outlines, _STEP * diagonal, _REACH * diagonal)
    front = rest + shift[:, None] * inward
    carried = np.einsum("ntij,nj->nti", np.broadcast_to(rotations, (*ray.shape, 3)), front) + translations
    deeper = np.where(paths.seen[some], ((carried - positions) * ray).sum(axis=2), 0.0)
    rest, miss, depth = places(positions + deeper[..., None] * ray, _FRONT_FRACTION)
    return some, _RestPlaces(rest, miss, deeper + depth, outside)


def _comes_near(rest: np.ndarray, inward: np.ndarray, body: cKDTree, diagonal: float) -> np.ndarray:
    """Whether lines of sight (N, 3), looked along for fronts, come near a body, (N,) bool.

    Each is looked at in places so far apart that none of it is farther than half of that from one of them.
    """
    along = np.arange(-_REACH, _REACH + _LOCAL, _LOCAL) * diagonal
    nearest = body.query(rest[:, None] + along[:, None] * inward[:, None])[0].min(axis=1)
    return nearest < (_LOCAL + 0.5 * _LOCAL) * diagonal


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place_sample(i, m, positions, seen, ray, rotations, translations, depth_fraction, largest, rest, miss, depth):
    """Place sample i with motion m; parameters as of `place_samples`, its results filled."""
    part = 1.0 - depth_fraction**2
    away, direction, place = np.empty(3), np.empty(3), np.empty(3)
    normal, right = _REGULAR * np.eye(3), np.zeros(3)
    for t in range(seen.shape[1]):
        if not seen[i, t]:
            continue
        along = 0.0
        for c in range(3):
            away[c] = positions[i, t, c] - translations[m, t, c]
            along += away[c] * ray[i, t, c]
            direction[c] = 0.0
            for d in range(3):
                direction[c] += rotations[m, t, d, c] * ray[i, t, d]
        for c in range(3):
            away[c] -= part * along * ray[i, t, c]
        for c in range(3):
            for d in range(3):
                right[c] += rotations[m, t, d, c] * away[d]
                for e in range(3):  # of rotations this is 1 or 0, of blends not
                    normal[c, d] += rotations[m, t, e, c] * rotations[m, t, e, d]
                normal[c, d] -= part * direction[c] * direction[d]
    solve_symmetric(normal, right, place)
    square, number = 0.0, 0
    for t in range(seen.shape[1]):
        if not seen[i, t]:
            continue
        along = 0.0
        for c in range(3):
            away[c] = translations[m, t, c] - positions[i, t, c]
            for d in range(3):
                away[c] += rotations[m, t, c, d] * place[d]
            along += away[c] * ray[i, t, c]
        across = 0.0
        for c in range(3):
            across += (away[c] - along * ray[i, t, c]) ** 2
        depth[i, t] = along
        square += min(across, largest**2)
        number += 1
    for c in range(3):
        rest[i, c] = place[c]
    miss[i] = np.sqrt(square / max(number, 1))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place_all(
    begin, end, motion, positions, seen, ray, rotations, translations, depth_fraction, largest, rest, miss, depth
):
    for i in range(begin, end):
        _place_sample(
            i,
            motion[i],
            positions,
            seen,
            ray,
            rotations,
            translations,
            depth_fraction,
            largest,
            rest,
            miss,
            depth,
        )


def place_samples(
    positions: np.ndarray,
    seen: np.ndarray,
    ray: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    depth_fraction: float,
    largest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places at rest from which given motions come nearest to the positions, mostly across their rays.

    Parameters
    ----------
    positions : (N, T, 3) float, metres
    seen : (N, T) bool
    ray : (N, T, 3) float
        Directions along which misses count little; 0: all count.
    rotations, translations : (N or 1, T, 3, 3), (N or 1, T, 3) float
        Motions since rest of each sample, or of all; rotations may be blends.
    depth_fraction : float
        Of what is missed along a ray, counts.
    largest : float, metres
        Larger misses count as this in their mean.

    Returns
    -------
    rest : (N, 3) float, metres
    miss : (N,) float, metres
        Root mean square across the rays.
    depth : (N, T) float, metres
        From the positions to the places carried, along the rays; 0 where there are none.
    """
    count, frames = seen.shape
    rest, miss, depth = np.zeros((count, 3)), np.zeros(count), np.zeros((count, frames))
    motion = np.arange(count) if len(rotations) > 1 else np.zeros(count, np.int64)
    arrays = motion, positions, seen, ray, rotations, translations
    spread(_place_all, count, *arrays, depth_fraction, largest, rest, miss, depth)
    return rest, miss, depth
