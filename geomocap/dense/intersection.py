"""From matched cells of one template to points in space, with normals."""

from __future__ import annotations

import cv2
import numpy as np

from geomocap.dense.matching_images import PreparedImages
from geomocap.dense.measured_points import MeasuredPoints
from geomocap.matching.growing import SurfaceMatches
from geomocap.model.rig import Rig
from geomocap.model.triangulation import triangulate


def intersect(
    prepared: PreparedImages, rig: Rig, surface: SurfaceMatches, normal_radius: int
) -> tuple[MeasuredPoints, np.ndarray]:
    """Intersect the rays of all matched cells: points and their cells."""
    t = surface.template
    cells = np.flatnonzero(surface.matched)
    if len(cells) == 0:
        return MeasuredPoints.empty(), cells
    m, seen = surface.matches, surface.seen[cells]
    # Half of the noise that the matches suffer from is the template's
    affine, covariance = m.affine[cells], m.covariance[cells]
    back = np.linalg.inv(np.where(seen[..., None, None], affine, np.eye(2)))
    own = 0.5 * back @ covariance @ np.swapaxes(back, -1, -2) * seen[..., None, None]
    own = own.sum(axis=1) / seen.sum(axis=1)[:, None, None]
    pixels = np.concatenate([surface.grid.pixels[None, cells], m.positions[cells].transpose(1, 0, 2)])
    covariances = np.concatenate([own[None], 0.5 * covariance.transpose(1, 0, 2, 3)])
    everywhere = np.concatenate([np.ones((1, len(cells)), bool), seen.T])
    found = triangulate(rig.select([rig.names[i] for i in (t, *surface.searches)]), pixels, covariances, everywhere)
    normals = surface_normals(rig, surface, normal_radius)[cells]
    correlation = np.where(seen, m.correlation[cells], 0).sum(axis=1) / seen.sum(axis=1)
    row, column = (surface.grid.pixels[cells, ::-1].T).astype(int)
    points = MeasuredPoints(
        found.points,
        normals,
        prepared.colors[t][row, column],
        found.sigma,
        found.views.astype(np.int32),
        correlation,
        np.full(len(cells), t, np.int32),
    )
    good = np.isfinite(found.points).all(axis=1) & np.isfinite(found.sigma)
    return points.select(good), cells[good]


def surface_normals(rig: Rig, surface: SurfaceMatches, radius: int) -> np.ndarray:
    """Normals (N, 3) of all cells, world, towards the template camera; NaN where not matched.

    On a plane n · X = 1 in camera axes the inverse depth is n · x̃, with x̃ the normalized image coordinates: n follows
    from the inverse depth and its slopes, which are averaged over the matched cells within `radius` in the grid.
    """
    camera = rig.cameras[surface.template]
    grid, planes = surface.grid, surface.planes
    known = grid.image(np.where(surface.matched, 1.0, 0.0), 0.0)
    size = (2 * radius + 1,) * 2
    count = cv2.boxFilter(known, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    slopes = []
    for i in (1, 2):
        values = grid.image(np.nan_to_num(planes[:, i]), 0.0) * known
        total = cv2.boxFilter(values, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        slopes.append((total / np.maximum(count, 1))[grid.row, grid.column])
    x = np.asarray(camera.cam_from_img(grid.pixels)).reshape(-1, 2)
    nx = slopes[0] * camera.focal_length_x
    ny = slopes[1] * camera.focal_length_y
    n = -np.column_stack([nx, ny, planes[:, 0] - nx * x[:, 0] - ny * x[:, 1]])
    with np.errstate(invalid="ignore"):
        n /= np.linalg.norm(n, axis=1, keepdims=True)
    return n @ rig.cam_from_world[surface.template, :, :3]
