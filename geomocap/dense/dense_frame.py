"""Surface measurement of one frame: images in, point cloud out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d

from geomocap.dense.cloud_merging import CloudLayer, merge
from geomocap.dense.dense_settings import CloudSettings
from geomocap.dense.intersection import intersect
from geomocap.dense.match_evidence import MatchEvidence, evidence_of
from geomocap.dense.match_groups import MatchGroup, MatchGroups, match_groups
from geomocap.dense.matching_images import PreparedImages, prepare
from geomocap.dense.measured_points import MeasuredPoints
from geomocap.dense.search_bounds import Box, depth_range, inside_silhouettes
from geomocap.matching.growing import SurfaceMatches, grow
from geomocap.matching.plane_sweep import SweepImages
from geomocap.matching.seeds import DepthRange, find_seeds
from geomocap.model.frame_geometry import Voxels
from geomocap.model.rig import Rig

DENSE, COARSE = 1.5, 2.0  # distances of neighbouring points where one or several templates see the surface, pixels
SMALL = 320  # edge of images in which neighbouring points are a pixel apart


@dataclass(frozen=True)
class TemplateCloud:
    """What one template group measured.

    Attributes
    ----------
    group : MatchGroup
        With the search cameras that were used in the end.
    surface : SurfaceMatches
    points : MeasuredPoints
        Of the cells `cells`, before merging.
    cells : (N,) int
        Cells of `surface.grid`.
    evidence : MatchEvidence
    misfits : dict
        Residuals, pixels, of the search cameras that were left out because they don't fit the calibration.
    doubt : str
        Why none of the matches was believed; empty if they were.
    reasons : dict
        What became of the cells and seeds, in words.
    """

    group: MatchGroup
    surface: SurfaceMatches
    points: MeasuredPoints
    cells: np.ndarray
    evidence: MatchEvidence
    misfits: dict[int, float]
    doubt: str
    reasons: dict[str, int]


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
    warnings : tuple of str
        What looks wrong with cameras or images.
    """

    points: MeasuredPoints
    templates: tuple[TemplateCloud, ...]
    reasons: dict[str, int]
    warnings: tuple[str, ...] = ()

    @property
    def cloud(self) -> o3d.t.geometry.PointCloud:
        """The cloud as Open3D holds it."""
        return self.points.to_open3d()


def measure_cloud(
    images: Sequence[np.ndarray],
    rig: Rig,
    *,
    masks: Sequence[np.ndarray] | None = None,
    hull: Voxels | None = None,
    settings: CloudSettings | None = None,
    box: Box | None = None,
) -> CloudFrame:
    """Measure the surface that the images of one frame show, by dense least squares matching.

    Parameters and errors are those of `cloud_of_frame`; cameras are grouped by their geometry.

    Returns
    -------
    CloudFrame
        `points.positions` (N, 3) m with normals, colours and quality; `cloud` is the Open3D point cloud.
    """
    settings = settings or CloudSettings()
    groups = match_groups(rig, settings.groups, box)
    return cloud_of_frame(images, masks, hull, rig, groups, settings, box)


def cloud_of_frame(
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray] | None,
    hull: Voxels | None,
    rig: Rig,
    groups: MatchGroups,
    settings: CloudSettings | None = None,
    box: Box | None = None,
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
    box : ((x, y, z), (x, y, z)), optional
        Corners of the region of interest, metres, world; nothing is measured outside.

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
    scene = Scene(prepared, masks is not None, hull, box, groups.rig)
    templates = [
        measure_template(scene, group, grid_step(groups, group, settings), settings) for group in groups.groups
    ]
    for group in groups.spare:
        # The template that was chosen shows nothing: another may
        if any(len(t.points) for t in templates):
            break
        templates.append(measure_template(scene, group, grid_step(groups, group, settings), settings))
    kept = merge(
        [CloudLayer(t.points, t.cells, t.surface.grid, t.surface.planes, t.group.template) for t in templates],
        groups.rig,
        settings.merge,
    )
    reasons: Counter[str] = Counter()
    for t, k in zip(templates, kept, strict=True):
        reasons.update(t.reasons)
        reasons["measured better from another template"] += int((~k).sum())
    points = MeasuredPoints.join([t.points.select(k) for t, k in zip(templates, kept, strict=True)])
    warnings = warnings_of(templates, rig.names, settings)
    return CloudFrame(points, tuple(templates), {r: n for r, n in reasons.items() if n}, warnings)


def grid_step(groups: MatchGroups, group: MatchGroup, settings: CloudSettings) -> float:
    """Distance of neighbouring points in the template image of a group, pixels."""
    if settings.spacing is not None:
        focal = groups.rig.cameras[group.template].mean_focal_length()
        return max(settings.spacing * focal / group.depth, 1.0)
    # Where several templates see a surface it gets more points than one template's
    usual = DENSE if len(groups.groups) == 1 else COARSE
    return settings.growing.step or float(np.clip(groups.rig.sizes[group.template].max() / SMALL, 1.0, usual))


@dataclass(frozen=True)
class Scene:
    """What all templates of a frame share.

    Attributes
    ----------
    images : PreparedImages
    has_masks : bool
        Whether the masks are silhouettes.
    hull : Voxels or None
    box : Box or None
    rig : Rig
        Pinhole cameras.
    """

    images: PreparedImages
    has_masks: bool
    hull: Voxels | None
    box: Box | None
    rig: Rig


def measure_template(scene: Scene, group: MatchGroup, step: float, settings: CloudSettings) -> TemplateCloud:
    """Match one template group at points `step` pixels apart and intersect its rays."""
    prepared, rig, t = scene.images, scene.rig, group.template
    shape = prepared.filtered[t].shape
    depth = depth_range(rig, t, shape, group.near, group.far, scene.hull, settings.hull_depth, scene.box)
    mask = prepared.inner[t]
    if scene.hull is not None or scene.box is not None:
        # Neither hides anything of the subject: where they are not, nothing is to be found
        mask = np.isfinite(depth.near) if mask is None else mask & np.isfinite(depth.near)
    surface, evidence = match_template(prepared, mask, depth, rig, group, step, settings)
    misfits: dict[int, float] = {}
    fits = ~(evidence.residuals > settings.trust.residual)
    if not fits.all() and fits.any():
        # What such an image said of depths is wrong as well: the others once more without it
        misfits = dict(zip(group.searches[~fits].tolist(), evidence.residuals[~fits].tolist(), strict=True))
        group = group.select(fits)
        surface, evidence = match_template(prepared, mask, depth, rig, group, step, settings)
    doubt = evidence.doubt(settings.trust) if surface.matched.any() else ""
    reasons = Counter(surface.reasons)
    if doubt:
        reasons["not believed"] = reasons.pop("matched", 0)
        surface = surface.without_matches()
    points, cells = intersect(prepared, rig, surface, settings.normal_radius)
    if scene.has_masks:
        inside = inside_silhouettes(rig, prepared.masks, points.positions, settings.silhouette_margin)
        reasons["outside another silhouette"] += int((~inside).sum())
        points, cells = points.select(inside), cells[inside]
    reasons["matched"] = len(points)
    if len(group.searches) > 1:
        # Of the matched: where this is nearly all, one camera is out of focus, blocked or wrongly calibrated
        reasons["matched in one search image only"] = int((points.views == 2).sum())
    counts = {reason: number for reason, number in reasons.items() if number}
    return TemplateCloud(group, surface, points, cells, evidence, misfits, doubt, counts)


def match_template(
    prepared: PreparedImages,
    mask: np.ndarray | None,
    depth: DepthRange,
    rig: Rig,
    group: MatchGroup,
    step: float,
    settings: CloudSettings,
) -> tuple[SurfaceMatches, MatchEvidence]:
    """Find seeds, grow from them, and see whether the result can be believed."""
    t, searches, transfers = group.template, group.searches, group.transfers
    used = [t, *searches.tolist()]
    smooth = SweepImages.of(
        [prepared.filtered[i] for i in used], [prepared.inner[i] for i in used], settings.seeds.blur
    )
    focal = rig.cameras[t].mean_focal_length()
    seeds = find_seeds(prepared.filtered[t], mask, smooth, transfers, depth, focal, settings.seeds)
    growing = settings.growing.model_copy(update={"step": step})
    least = min(settings.least_views - 1, len(searches))
    surface = grow(prepared.stack, t, searches, transfers, seeds, mask, growing, settings.kernel, least)
    evidence = evidence_of(prepared.stack, surface, transfers, settings.kernel, growing.radius, settings.seeds.cell)
    return surface, evidence


def warnings_of(templates: Sequence[TemplateCloud], names: Sequence[str], settings: CloudSettings) -> tuple[str, ...]:
    """Say what looks wrong with cameras and images, the same camera once."""
    warnings = []
    took_part, matched = Counter[int](), Counter[int]()
    for t in templates:
        name = names[t.group.template]
        if t.doubt:
            warnings.append(
                f"camera {name} as template: {t.doubt}; none of its points is kept: check calibration and images"
            )
        residuals = t.misfits | dict(zip(t.group.searches.tolist(), t.evidence.residuals.tolist(), strict=True))
        for camera, residual in residuals.items():
            if residual > settings.trust.warning and not t.doubt:
                kept = "not used" if camera in t.misfits else "kept"
                warnings.append(
                    f"cameras {name} and {names[camera]}: matches leave their epipolar lines by {residual:.2f} px "
                    f"({kept}): check the calibration"
                )
        seen = t.surface.seen.sum(axis=0)
        for camera, number in zip(t.group.searches.tolist(), seen.tolist(), strict=True):
            matched[camera] += number
        for camera in (t.group.template, *residuals):
            took_part[camera] += 1
        matched[t.group.template] += int(t.surface.matched.sum())
    nothing = [names[c] for c in sorted(took_part) if matched[c] == 0]
    if len(nothing) == len(took_part) and not warnings:
        warnings.append("nothing matches in any image; are they black, mirrored, mixed up, or the calibration wrong?")
    elif not any(t.doubt for t in templates):
        warnings += [
            f"camera {n}: nothing matches in its images; is it black, blocked, out of focus, or its calibration wrong?"
            for n in nothing
        ]
    return tuple(warnings)
