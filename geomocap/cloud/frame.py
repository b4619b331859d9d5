"""Surface measurement of one frame: images in, point cloud out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from geomocap.cameras import Rig
from geomocap.cloud.bounds import depth_range, inside_silhouettes
from geomocap.cloud.groups import MatchGroup, MatchGroups
from geomocap.cloud.merging import Layer, merge
from geomocap.cloud.points import MeasuredPoints
from geomocap.cloud.settings import CloudSettings
from geomocap.errors import GeometryError
from geomocap.geometry import Voxels
from geomocap.matching.growing import SurfaceMatches, grow
from geomocap.matching.plane_sweep import SweepImages
from geomocap.matching.seeds import find_seeds
from geomocap.matching.spline import ImageStack
from geomocap.matching.wallis import wallis
from geomocap.triangulation import triangulate


@dataclass(frozen=True)
class TemplateCloud:
    """What one template group measured.

    Attributes
    ----------
    group : MatchGroup
    surface : SurfaceMatches
    points : MeasuredPoints
        Of the cells `cells`, before merging.
    cells : (N,) int
        Cells of `surface.grid`.
    """

    group: MatchGroup
    surface: SurfaceMatches
    points: MeasuredPoints
    cells: np.ndarray


@dataclass(frozen=True)
class CloudFrame:
    """The cloud of one frame and how it came about.

    Attributes
    ----------
    points : MeasuredPoints
        Of all templates, merged.
    templates : tuple of TemplateCloud
    reasons : dict
        What became of all cells and seeds, in words, summed over the templates.
    """

    points: MeasuredPoints
    templates: tuple[TemplateCloud, ...]
    reasons: dict[str, int]

    @property
    def cloud(self) -> o3d.t.geometry.PointCloud:
        """The cloud as Open3D holds it."""
        return self.points.to_open3d()


@dataclass(frozen=True)
class PreparedImages:
    """Images of one frame, free of distortion, ready for matching.

    Attributes
    ----------
    colors : list of (H, W, 3) uint8
    filtered : list of (H, W) float32
        Grey, after the Wallis filter.
    masks : list of (H, W) bool or None
        Where the subject is seen.
    inner : list of (H, W) bool or None
        The same without the margin along the contours.
    stack : ImageStack
    """

    colors: list[np.ndarray]
    filtered: list[np.ndarray]
    masks: list[np.ndarray | None]
    inner: list[np.ndarray | None]
    stack: ImageStack


def undistorted_color(image: np.ndarray, groups: MatchGroups, camera: int) -> np.ndarray:
    """Return the colours (H, W, 3) of one camera's image as the matching sees them, without distortion."""
    maps = groups.maps[camera]
    return image if maps is None else cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR)


def prepare(
    images: Sequence[np.ndarray], masks: Sequence[np.ndarray] | None, groups: MatchGroups, settings: CloudSettings
) -> PreparedImages:
    """Remove distortion, filter, and prefilter the splines.

    Raises
    ------
    GeometryError
        If an image or mask does not have its camera's size.
    """
    if len(images) != len(groups.rig) or (masks is not None and len(masks) != len(images)):
        given = len(images) if masks is None else f"{len(images)} and {len(masks)}"
        raise GeometryError(f"{given} images and masks for {len(groups.rig)} cameras: expected one each a camera")
    colors, filtered, silhouettes, inner = [], [], [], []
    for c, (image, map_) in enumerate(zip(images, groups.maps, strict=True)):
        image = np.asarray(image)
        color = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        mask = None if masks is None else np.asarray(masks[c]) != 0
        camera = groups.rig.cameras[c]
        if (map_ is None and color.shape[:2] != (camera.height, camera.width)) or (
            mask is not None and mask.shape != color.shape[:2]
        ):
            raise GeometryError(
                f"camera {groups.rig.names[c]}: image {color.shape[:2]} and its mask have to be "
                f"{camera.height}×{camera.width} as calibrated"
            )
        grey = color.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
        if map_ is not None:
            x, y = map_
            pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64) + 0.5
            grey = ImageStack.of([grey], settings.kernel.order).sample(0, pixels).reshape(x.shape)
            outside = ~np.isfinite(grey)
            grey = np.where(outside, np.float32(0), grey)
            color = undistorted_color(color, groups, c)
            if mask is not None:
                mask = cv2.remap(mask.astype(np.uint8), x, y, cv2.INTER_NEAREST) != 0
            mask = ~outside if mask is None else mask & ~outside
        filtered.append(wallis(grey, settings.wallis, mask) if settings.wallis.enabled else grey)
        colors.append(color)
        silhouettes.append(mask)
        kernel = np.ones((2 * settings.contour_margin + 1,) * 2, np.uint8)
        inner.append(None if mask is None else cv2.erode(mask.astype(np.uint8), kernel) != 0)
    stack = ImageStack.of(filtered, settings.kernel.order, inner)
    return PreparedImages(colors, filtered, silhouettes, inner, stack)


def cloud_of_frame(
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray] | None,
    hull: Voxels | None,
    rig: Rig,
    groups: MatchGroups,
    settings: CloudSettings | None = None,
) -> CloudFrame:
    """Measure the surface that the images of one frame show.

    Parameters
    ----------
    images : sequence of C arrays (H, W, 3) uint8, RGB (or grey (H, W))
    masks : sequence of C arrays (H, W), optional
        Silhouettes, non-zero on the subject; without them everything in view is measured.
    hull : Voxels, optional
        Visual hull or carved surface of the frame; bounds the search.
    rig : Rig
        The cameras as calibrated.
    groups : MatchGroups
        From `match_groups(rig, settings.groups)`.
    settings : CloudSettings, optional

    Returns
    -------
    CloudFrame
        Empty, with the reasons counted, where nothing can be matched.

    Raises
    ------
    GeometryError
        If images, masks and cameras don't fit together.
    """
    settings = settings or CloudSettings()
    prepared = prepare(images, masks, groups, settings)
    templates = []
    reasons: Counter[str] = Counter()
    for group in groups.groups:
        measured, counts = measure_template(prepared, masks is not None, hull, groups.rig, group, settings)
        templates.append(measured)
        reasons.update(counts)
    layers = [
        Layer(t.points, t.cells, t.surface.grid, t.surface.planes, t.group.template, settings.growing.step)
        for t in templates
    ]
    kept = (
        merge(layers, groups.rig, settings.merge)
        if len(layers) > 1
        else [np.ones(len(t.points), bool) for t in templates]
    )
    for _t, k in zip(templates, kept, strict=True):
        if (~k).any():
            reasons["measured better from another template"] += int((~k).sum())
    points = MeasuredPoints.join([t.points.select(k) for t, k in zip(templates, kept, strict=True)])
    return CloudFrame(points, tuple(templates), dict(reasons))


def measure_template(
    prepared: PreparedImages, has_masks: bool, hull: Voxels | None, rig: Rig, group: MatchGroup, settings: CloudSettings
) -> tuple[TemplateCloud, dict[str, int]]:
    """Match one template group and intersect its rays; also returns what became of its cells."""
    t, searches = group.template, group.searches
    mask = prepared.inner[t]
    depth = depth_range(rig, t, prepared.filtered[t].shape, group.near, group.far, hull, settings.hull_depth)
    if hull is not None:
        # The hull hides nothing of the subject: where it is not, nothing is to be found
        mask = np.isfinite(depth.near) if mask is None else mask & np.isfinite(depth.near)
    focal = rig.cameras[t].mean_focal_length()
    used = [t, *searches.tolist()]
    smooth = SweepImages.of(
        [prepared.filtered[i] for i in used], [prepared.inner[i] for i in used], settings.seeds.blur
    )
    seeds = find_seeds(prepared.filtered[t], mask, smooth, group.transfers, depth, focal, settings.seeds)
    surface = grow(
        prepared.stack,
        t,
        searches,
        group.transfers,
        seeds,
        mask,
        settings.growing,
        settings.kernel,
        min(settings.least_views - 1, len(searches)),
        smooth,
        focal,
    )
    points, cells = intersect(prepared, rig, surface, settings)
    reasons = Counter(surface.reasons)
    if has_masks:
        inside = inside_silhouettes(rig, prepared.masks, points.positions, settings.silhouette_margin)
        reasons["outside another silhouette"] += int((~inside).sum())
        points, cells = points.select(inside), cells[inside]
    reasons["matched"] = len(points)
    if len(searches) > 1:
        # Of the matched: where this is nearly all, one camera is out of focus, blocked or wrongly calibrated
        reasons["matched in one search image only"] = int((points.views == 2).sum())
    return TemplateCloud(group, surface, points, cells), {k: v for k, v in reasons.items() if v}


def intersect(
    prepared: PreparedImages, rig: Rig, surface: SurfaceMatches, settings: CloudSettings
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
    normals = surface_normals(rig, surface, settings.normal_radius)[cells]
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
