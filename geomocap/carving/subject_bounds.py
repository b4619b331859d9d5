"""Where the subject can be: a box found from the cameras and the silhouettes of one frame.

Cells are tested as whole boxes, not at their centres: a cell is dropped only if some camera is sure that nothing of the
subject is in it. So nothing is missed, however small the subject is in the space between the cameras. Cells that are
kept are halved until the subject is resolved.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from geomocap.carving.block_kernels import possible_parts, summed
from geomocap.carving.carving_settings import HullSettings
from geomocap.carving.hull import heard, rounding_bounds
from geomocap.carving.silhouette_views import PinholeViews
from geomocap.carving.voxel_grid import Grid
from geomocap.errors import GeometryError

CELLS = 48  # along the longest side of the subject, at least
MAX_CELLS = 200_000  # no finer when there are this many
MAX_LEVEL = 20
SMALLEST_PART = 0.05  # of the cells of the largest connected part: smaller parts are false blobs


def subject_box(views: PinholeViews, settings: HullSettings) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the box round the subject of one frame.

    Returns
    -------
    low, high : (3,) float, metres, world
        Corners of the box; None instead of both if the silhouettes have no common volume.

    Raises
    ------
    GeometryError
        If the volume has no end: the cameras see the subject from one side only.
    """
    cells, origin, edge = subject_cells(views, settings)
    if len(cells) == 0:
        return None
    return origin + cells.min(axis=0) * edge, origin + (cells.max(axis=0) + 1) * edge


def subject_cells(views: PinholeViews, settings: HullSettings) -> tuple[np.ndarray, np.ndarray, float]:
    """Find the cells that may hold the subject, small separate parts left out; errors as of `subject_box`.

    Returns
    -------
    cells : (N, 3) int64
        Cell k reaches from origin + k · edge to origin + (k + 1) · edge.
    origin : (3,) float, metres, world
    edge : float, metres
    """
    tables = _tables(views, settings)
    center, reach = space_seen(views)
    for _ in range(10):
        origin = center - reach
        cells, level = np.zeros((1, 3), np.int64), 0
        while level < MAX_LEVEL and 0 < len(cells) < MAX_CELLS:
            cells, level = halve(views, settings, tables, cells, origin, 2 * reach / 2**level), level + 1
            if len(cells) >= CELLS and np.ptp(cells, axis=0).max() + 1 >= CELLS:
                label = _connected(cells)
                sizes = np.bincount(label)
                if np.ptp(cells[label == sizes.argmax()], axis=0).max() + 1 >= CELLS:
                    cells = cells[(sizes >= SMALLEST_PART * sizes.max())[label]]
                    break
        if len(cells) == 0 or (cells.min() > 0 and cells.max() < 2**level - 1):
            return cells, origin, 2 * reach / 2**level
        reach *= 2  # the subject reaches the border of the space that was searched
    raise GeometryError(
        f"the silhouettes don't bound the subject: the volume common to {', '.join(views.names)} is more than "
        f"{reach:.3g} m long; add a camera from another side or give carving.volume"
    )


def halve(
    views: PinholeViews,
    settings: HullSettings,
    tables: tuple[np.ndarray, np.ndarray, np.ndarray, int],
    cells: np.ndarray,
    origin: np.ndarray,
    edge: float,
) -> np.ndarray:
    """Divide cells of size `edge` into eight each and return those that may hold a point of the hull, (M, 3) int64."""
    subject, seen, unseen, least = tables
    high = origin + (cells.max(axis=0) + 1) * edge
    space = Grid(origin, float((high - origin).max()), (1, 1, 1))
    return possible_parts(
        views.projections,
        rounding_bounds(views, space),
        subject,
        seen,
        unseen,
        settings.tolerance,
        least,
        origin,
        edge / 2,
        cells,
    )


def _tables(views: PinholeViews, settings: HullSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Integral images of the silhouettes and of what is seen, where the outside is unseen, cameras with a say."""
    views, unseen, least = heard(views, settings)
    subject = summed(views.masks)
    return subject, summed(views.valid) if unseen.any() else subject, unseen, least


def _connected(cells: np.ndarray) -> np.ndarray:
    """Number the connected parts (26 neighbours) of different cells (N, 3), all at least 0: labels (N,) int64."""
    side = np.int64(cells.max() + 3)
    keys = ((cells[:, 0] + 1) * side + cells[:, 1] + 1) * side + cells[:, 2] + 1
    order = np.argsort(keys)
    return connected_keys(keys[order], order, side)


@njit(cache=True, nogil=True, error_model="numpy")
def connected_keys(keys, order, side):
    """Number the connected parts of cells by their keys; parts are counted by their first cell.

    Parameters
    ----------
    keys : (N,) int64
        x · side² + y · side + z of each cell, ascending; no coordinate is 0 or side - 1.
    order : (N,) int64
        Number of each of these cells.
    side : int

    Returns
    -------
    (N,) int64
        Label of each cell, by its number.
    """
    first = np.arange(len(keys))  # of each cell, one of its part with a lower number or itself: a forest
    for a in range(-1, 2):
        for b in range(-1, 2):
            for c in range(-1, 2):
                step, at = (a * side + b) * side + c, 0
                if step <= 0:
                    continue
                for n in range(len(keys)):
                    while at < len(keys) and keys[at] < keys[n] + step:
                        at += 1
                    if at < len(keys) and keys[at] == keys[n] + step:
                        i, j = _root(first, order[n]), _root(first, order[at])
                        first[max(i, j)] = min(i, j)
    labels, count = np.empty(len(keys), np.int64), 0
    for n in range(len(keys)):
        if first[n] == n:
            labels[n], count = count, count + 1
        else:
            labels[n] = labels[first[n]]
    return labels


@njit(cache=True, nogil=True, error_model="numpy")
def _root(first, n):
    """Find the first cell of a part, halving the way to it."""
    while first[n] != n:
        first[n] = first[first[n]]
        n = first[n]
    return n


def space_seen(views: PinholeViews) -> tuple[np.ndarray, float]:
    """Return `focus`; raises GeometryError if the cameras stand in one place, so that no depth can come from them."""
    center, reach = focus(views)
    if not reach > 0:
        raise GeometryError(f"cameras {', '.join(views.names)} stand in one place; check the poses in the calibration")
    return center, reach


def focus(views: PinholeViews) -> tuple[np.ndarray, float]:
    """Find where the cameras look: the point nearest to all rays through the middles of the silhouettes.

    Distances count linearly (iteratively reweighted least squares), so that one wrong camera doesn't matter.

    Returns
    -------
    center : (3,) float, metres, world
    reach : float
        Distance of the farthest camera from it, metres.
    """
    centers, rays = [], []
    for P, mask in zip(views.projections, views.masks, strict=True):
        # how much of the silhouette each column and each row has
        columns, rows = (cv2.reduce(mask, k, cv2.REDUCE_SUM, dtype=cv2.CV_32S).ravel() for k in (0, 1))
        area = columns.sum()
        u, v = (n @ np.arange(len(n)) / area if area else len(n) / 2 for n in (columns, rows))
        inverse = np.linalg.inv(P[:, :3])
        ray = inverse @ [u + 0.5, v + 0.5, 1.0]
        centers.append(-inverse @ P[:, 3])
        rays.append(ray / np.linalg.norm(ray))
    C, D = np.array(centers), np.array(rays)
    across = np.eye(3) - D[:, :, None] * D[:, None, :]
    middle, scale = C.mean(axis=0), max(float(np.abs(C - C.mean(axis=0)).max()), 1e-6)
    weights = np.ones(len(C))
    point = middle
    for _ in range(20):
        A = np.einsum("c,cij->ij", weights, across) + 1e-9 * weights.sum() * np.eye(3)
        b = np.einsum("c,cij,cj->i", weights, across, C - middle)
        point = middle + np.linalg.solve(A, b)
        distance = np.linalg.norm(np.einsum("cij,cj->ci", across, point - C), axis=1)
        weights = 1.0 / np.maximum(distance, 1e-3 * scale)
    return point, float(np.linalg.norm(C - point, axis=1).max())
