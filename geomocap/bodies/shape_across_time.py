"""Where the surface of bodies can be, if the silhouettes of all frames are those of one shape that moves.

Few cameras leave a visual hull that stands off the surface wherever a limb is before or beside another one. But the
limbs move: carried by the motion of its body, a place must be within the silhouettes of every frame. Four cameras and
forty frames are a hundred and sixty views (Cheung, Baker, Kanade, Shape-from-silhouette across time, 2005).
"""

from __future__ import annotations

import numba
import numpy as np

from geomocap.model.outlines import Outlines
from geomocap.scheduling import spread

_HALVINGS = 3  # of a step, where the front is in one
_BLOCK = 128  # lines that are looked up in a silhouette while it is in the processor's cache
# Fraction of the views that a place of the hull may be outside of. Depths of a man seen by four cameras erred by 21 mm
# (90 %) with 0.05, by 27 mm with 0.1, and by 26 mm with 0.02 and silhouettes a pixel wider.
MAY_MISS = 0.05


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _misses(place, m, rotations, translations, frames, projections, empty, most):
    """Number of silhouettes that a place at rest, carried by motion m, is outside of; not counted beyond `most`."""
    K, C, H, W = empty.shape
    count = 0
    at = np.empty(3)
    for k in range(K):
        t = frames[k]
        for r in range(3):
            at[r] = translations[m, t, r]
            for c in range(3):
                at[r] += rotations[m, t, r, c] * place[c]
        for c in range(C):
            P = projections[c]
            w = P[2, 0] * at[0] + P[2, 1] * at[1] + P[2, 2] * at[2] + P[2, 3]
            if w <= 0:
                continue
            x = (P[0, 0] * at[0] + P[0, 1] * at[1] + P[0, 2] * at[2] + P[0, 3]) / w
            y = (P[1, 0] * at[0] + P[1, 1] * at[1] + P[1, 2] * at[2] + P[1, 3]) / w
            if x < -0.5 or y < -0.5 or x >= W - 0.5 or y >= H - 0.5:
                continue
            if empty[k, c, int(np.rint(y)), int(np.rint(x))]:
                count += 1
                if count > most:
                    return count
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _count_lines(begin, end, motion, rest, inward, rotations, translations, frames, views, steps, counts):
    """Number of silhouettes that each place of some lines is outside of, as in `_misses`, into `counts` (n, S).

    A straight line stays one in an image: one projection of it for each view, a division for each place.
    """
    projections, empty, length = views
    K, C, H, W = empty.shape
    counts[:] = 0
    at, step = np.empty(3), np.empty(3)
    start, slope = np.empty(3), np.empty(3)
    for k in range(K):
        t = frames[k]
        for c in range(C):
            P, image = projections[c], empty[k, c]
            for i in range(begin, end):
                m = motion[i]
                for r in range(3):
                    at[r], step[r] = translations[m, t, r], 0.0
                    for d in range(3):
                        at[r] += rotations[m, t, r, d] * rest[i, d]
                        step[r] += rotations[m, t, r, d] * length * inward[i, d]
                for r in range(3):
                    start[r] = P[r, 0] * at[0] + P[r, 1] * at[1] + P[r, 2] * at[2] + P[r, 3]
                    slope[r] = P[r, 0] * step[0] + P[r, 1] * step[1] + P[r, 2] * step[2]
                for n in range(2 * steps + 1):
                    s = n - steps
                    w = start[2] + s * slope[2]
                    if w <= 0:
                        continue
                    x, y = (start[0] + s * slope[0]) / w + 0.5, (start[1] + s * slope[1]) / w + 0.5
                    if x >= 0 and y >= 0 and x < W and y < H:
                        counts[i - begin, n] += image[int(y), int(x)]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fronts(begin, end, motion, rest, inward, rotations, translations, frames, views, steps, may_miss, shift, missed):
    projections, empty, step = views
    allowed = int(may_miss * empty.shape[0] * empty.shape[1])
    place, lines = np.empty(3), np.empty((_BLOCK, 2 * steps + 1), np.int32)
    for i in range(begin, end):
        row = (i - begin) % _BLOCK
        if row == 0:
            last = min(i + _BLOCK, end)
            _count_lines(i, last, motion, rest, inward, rotations, translations, frames, views, steps, lines)
        counts = lines[row]
        least = counts.min()
        missed[i] = least / max(empty.shape[0] * empty.shape[1], 1)
        s = steps
        if counts[s] > least + allowed:  # before the hull
            while s < 2 * steps and counts[s] > least + allowed:
                s += 1
            if counts[s] > least + allowed:
                continue
        else:
            while s > 0 and counts[s - 1] <= least + allowed:
                s -= 1
            if s == 0:
                continue
        inside = (s - steps) * step
        outside = inside - step
        for _ in range(_HALVINGS):
            middle = 0.5 * (inside + outside)
            for c in range(3):
                place[c] = rest[i, c] + middle * inward[i, c]
            most = least + allowed
            if _misses(place, motion[i], rotations, translations, frames, projections, empty, most) <= most:
                inside = middle
            else:
                outside = middle
        shift[i] = inside


def hull_fronts(
    rest: np.ndarray,
    inward: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    outlines: Outlines,
    step: float,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """How far places are from the front of the hull that the silhouettes of all frames leave of their bodies.

    Parameters
    ----------
    rest, inward : (N, 3) float
        Places at rest, metres, and unit vectors away from what sees them.
    rotations, translations : (N or 1, T, 3, 3), (N or 1, T, 3) float
        Motions since rest of each place, or of all; rotations may be blends.
    outlines : Outlines
    step, reach : float, metres
        Of the search along `inward`, to and fro; the front is then found to an eighth of a step.

    Returns
    -------
    shift : (N,) float, metres
        To be gone along `inward`; 0 where no front is within reach.
    missed : (N,) float
        Fraction of the silhouettes that every place of the line is outside of: these are at fault themselves, or the
        motion is. A place of the hull may be outside of a twentieth more.
    """
    shift, missed = np.zeros(len(rest)), np.zeros(len(rest))
    motion = np.arange(len(rest)) if len(rotations) > 1 else np.zeros(len(rest), np.int64)
    views = np.ascontiguousarray(outlines.projections, np.float64), outlines.empty, float(step)
    arrays = motion, np.ascontiguousarray(rest), np.ascontiguousarray(inward), np.ascontiguousarray(rotations)
    frames = np.asarray(outlines.frames, np.int64)
    steps = int(np.ceil(reach / step))
    spread(
        _fronts, len(rest), *arrays, np.ascontiguousarray(translations), frames, views, steps, MAY_MISS, shift, missed
    )
    return shift, missed
