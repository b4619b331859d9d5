"""Holes in a silhouette that the other cameras contradict: background colours on the subject, not gaps in it."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from geomocap.carving.carving_settings import ENCLOSING, HullSettings
from geomocap.carving.hull import heard, hull
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.subject_bounds import subject_box
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import GeometryError
from geomocap.model.rig import Rig

RESOLUTION = 96  # of the others' hull; a hole that matters is many such voxels wide
SAMPLES = 200  # rays through a hole, and through its rim
LEAST_OTHERS = ENCLOSING - 1  # two cameras' hull is too bulky to say where the subject is thick
FRACTION = 0.75  # a false hole's rays cross at least this fraction of what its rim's rays cross
ALL_BUT_ONE = HullSettings(tolerance=1, min_views=LEAST_OTHERS + 1)
EMPTY, NOBODY = -2, -1  # voxel outside the hull; voxel on which all cameras agree (else: the camera that doesn't)
MOST_HOLES = 40  # largest first; more of them are noise that the evidence has to settle


def fill_false_holes(rig: Rig, views: PinholeViews, masks: list[np.ndarray]) -> list[np.ndarray]:
    """Fill the enclosed holes of silhouettes where the hull of the other cameras is as thick as around them.

    Through a gap (between arm and trunk, say) some other camera sees, too, or it holds only a phantom that is thinner
    than the parts around it. Behind a hole that is there only because the subject has the background's colour, the
    others find the subject as thick as beside it.

    Parameters
    ----------
    rig : Rig
    views : PinholeViews
        The same silhouettes, undistorted.
    masks : list of C arrays (H, W) uint8
        Silhouettes in the original images, 0 or 255.

    Returns
    -------
    list of C arrays (H, W) uint8
        New arrays where something was filled.
    """
    result = list(masks)
    holes = [enclosed_holes(mask) for mask in masks]
    if np.count_nonzero(~views.blind()) <= LEAST_OTHERS or not any(holes):
        return result
    try:
        box = subject_box(views, ALL_BUT_ONE)
    except GeometryError:  # cameras on one side bound nothing, so they contradict nothing
        return result
    if box is None:
        return result
    grid = Grid.of_box(*box, resolution=RESOLUTION)
    occupied = hull(views, grid, ALL_BUT_ONE).indices()
    dissent = np.full(grid.shape, EMPTY, np.int8)
    heeded, unseen, _ = heard(views, ALL_BUT_ONE)
    _find_dissent(
        views.projections, heeded.masks, heeded.valid, unseen, occupied, grid.origin, grid.voxel_size, dissent
    )
    for c, mask in enumerate(masks):
        filled = mask.copy()
        for inside, rim in holes[c]:
            within = _thickness(rig, c, inside, dissent, grid)
            beside = _thickness(rig, c, rim, dissent, grid)
            if np.quantile(within, 0.1) > 0 and np.median(within) >= FRACTION * np.median(beside):
                filled[inside[:, 1], inside[:, 0]] = 255
        result[c] = filled
    return result


def enclosed_holes(mask: np.ndarray, least: int = 6) -> list[tuple[np.ndarray, np.ndarray]]:
    """List the holes of a silhouette: background that the subject encloses.

    Parameters
    ----------
    mask : (H, W) uint8
    least : int
        Smaller holes are left out (pixels).

    Returns
    -------
    list of pairs (N, 2) int, (M, 2) int
        Pixels (x, y) of each hole, and of the subject along its rim; largest hole first.
    """
    left, top, width, height = cv2.boundingRect(mask)
    left, top = max(left - 1, 0), max(top - 1, 0)
    mask = mask[top : top + height + 2, left : left + width + 2]  # what reaches its border is open, too
    h, w = mask.shape
    count, labels, stats, _ = cv2.connectedComponentsWithStats((mask == 0).view(np.uint8), connectivity=4)
    holes: list[tuple[np.ndarray, np.ndarray]] = []
    for k in np.argsort(-stats[1:count, cv2.CC_STAT_AREA], kind="stable") + 1:
        x, y, dx, dy, area = stats[k]
        if x == 0 or y == 0 or x + dx == w or y + dy == h:
            continue  # open to the border of the image
        if area < least or len(holes) == MOST_HOLES:
            break
        x0, y0 = max(x - 3, 0), max(y - 3, 0)
        window = labels[y0 : y + dy + 3, x0 : x + dx + 3]
        inside = (window == k).view(np.uint8)
        rim = (cv2.dilate(inside, np.ones((7, 7), np.uint8)) == 1) & (mask[y0 : y + dy + 3, x0 : x + dx + 3] != 0)
        v, u = np.nonzero(inside)
        rv, ru = np.nonzero(rim)
        if len(ru):
            x0, y0 = x0 + left, y0 + top
            holes.append((np.column_stack([u + x0, v + y0]), np.column_stack([ru + x0, rv + y0])))
    return holes


def _thickness(rig: Rig, camera: int, pixels: np.ndarray, dissent: np.ndarray, grid: Grid) -> np.ndarray:
    """Lengths that rays through some of the pixels (N, 2) run inside the hull of the other cameras, metres."""
    some = pixels[:: max(1, len(pixels) // SAMPLES)]
    origin, directions = rig.rays(camera, some + 0.5)
    directions = np.ascontiguousarray(directions)
    return _march(np.ascontiguousarray(origin), directions, dissent, camera, grid.origin, grid.voxel_size)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_dissent(P, masks, valid, unseen, occupied, origin, edge, dissent):
    """Write into each voxel of the hull which camera calls it background; NOBODY if none does."""
    C, H, W = masks.shape
    for n in range(len(occupied)):
        i, j, k = occupied[n]
        x, y, z = origin[0] + (i + 0.5) * edge, origin[1] + (j + 0.5) * edge, origin[2] + (k + 0.5) * edge
        dissent[i, j, k] = NOBODY
        for c in range(C):
            w = P[c, 2, 0] * x + P[c, 2, 1] * y + P[c, 2, 2] * z + P[c, 2, 3]
            u = (P[c, 0, 0] * x + P[c, 0, 1] * y + P[c, 0, 2] * z + P[c, 0, 3]) / w
            v = (P[c, 1, 0] * x + P[c, 1, 1] * y + P[c, 1, 2] * z + P[c, 1, 3]) / w
            in_view = w > 0 and 0 <= u < W and 0 <= v < H
            if in_view and masks[c, int(v), int(u)]:
                continue
            if not unseen[c] or (in_view and valid[c, int(v), int(u)]):
                dissent[i, j, k] = c


@njit(cache=True, nogil=True, error_model="numpy")
def _march(origin, directions, dissent, camera, low, edge):
    """Walk along rays in steps of a voxel and sum the steps on which all other cameras agree."""
    X, Y, Z = dissent.shape
    lengths = np.zeros(len(directions))
    for r in range(len(directions)):
        near, far = 0.0, 1e30
        for a in range(3):
            d = directions[r, a]
            first, last = low[a] - origin[a], low[a] + dissent.shape[a] * edge - origin[a]
            if abs(d) < 1e-12:
                if first > 0.0 or last < 0.0:
                    far = -1.0
                continue
            t0, t1 = first / d, last / d
            near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
        t = near + 0.5 * edge
        while t < far:
            i = int((origin[0] + t * directions[r, 0] - low[0]) / edge)
            j = int((origin[1] + t * directions[r, 1] - low[1]) / edge)
            k = int((origin[2] + t * directions[r, 2] - low[2]) / edge)
            if 0 <= i < X and 0 <= j < Y and 0 <= k < Z:
                who = dissent[i, j, k]
                if who == NOBODY or who == camera:
                    lengths[r] += edge
            t += edge
    return lengths
