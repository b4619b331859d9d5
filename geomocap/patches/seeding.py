"""New patches: spread evenly over the surface, shaped like it, and put where at least two cameras agree on it."""

from __future__ import annotations

import numpy as np
from numba import get_num_threads, njit
from scipy.spatial import cKDTree

from geomocap.patches.frame_views import FrameViews
from geomocap.patches.ghosts import nothing_behind
from geomocap.patches.one_camera import image_precision
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.surface_patches import FACING_OTHERS, Patches, align, as_one_camera, facings, with_templates
from geomocap.scheduling import map_rows

_FIT_VOXELS = 4.5  # radius of the piece of surface that gives a patch its shape, voxels
_FACING_ALONE = 0.5  # of a camera that sees a patch alone
_HULL_SLACK = 3.0  # voxels that a seed may lie behind the drawn surface
_REGULAR = 1e-12
_PACKING = 0.7  # points placed at random at least r apart, as many as fit: 0.7 a square of r
_NOISE_FRACTION = 0.4  # of the standard deviation allowed that a patch has in the very image it comes from
_LEAST_RADIUS_PX = 3  # smaller patches hold too little texture
_COVER = 1.0  # half the width of a patch, as a fraction of the spacing: neighbours overlap
_PEAK_PX = 3.0  # half the width of a peak of correlation along the ray, pixels
_CLEAR = 0.05  # correlation by which it must exceed all others
_SWEEP_PX = 1.0  # step of the search along the viewing ray, pixels


def seed_spacing(view: FrameViews, n_patches: int) -> float:
    """Return the distance of seeds, metres, at which about `n_patches` cover the surface of a frame."""
    area = 0.75 * len(view.surface) * view.voxel_size**2  # a slanted surface has more voxels than squares
    return float(np.sqrt(_PACKING * area / n_patches))


def image_reduction(view: FrameViews, settings: TrackingSettings) -> int:
    """Return by how much images may be reduced: to pixels with which patches of `radius_px` cover the surface twice.

    Finer images have more noise and less texture in a patch, and take longer.
    """
    if not len(view.surface):
        return 1
    pixel = float(np.median(view.pixel_size(view.surface)))
    return max(1, round(_COVER * seed_spacing(view, settings.n_patches) / (settings.radius_px * pixel)))


def patch_radii(view: FrameViews, spacing: float, settings: TrackingSettings) -> tuple[int, int]:
    """Return half the widths of patches `spacing` (m) apart in pixels: of wide ones, and of narrow ones.

    Narrow ones cover the surface twice. Wide ones, twice as wide, hold more texture; they reach round the limbs of a
    subject that is small in the images. Both are between three and `radius_px`.
    """
    pixel = float(np.median(view.pixel_size(view.surface)))
    wide, narrow = (max(_LEAST_RADIUS_PX, round(k * _COVER * spacing / pixel)) for k in (2, 1))
    return min(settings.radius_px, wide), min(settings.radius_px, narrow)


def template_room(view: FrameViews, settings: TrackingSettings) -> tuple[int, int, int]:
    """Return how many samples the widest patches have, and the numbers of cameras and blur levels."""
    return (2 * settings.radius_px + 1) ** 2, view.count, len(view.levels)


def spaced(points: np.ndarray, spacing: float, taken: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Choose points (M, 3), `spacing` from each other and 0.9 of it from those `taken` (K, 3): indices, sorted."""
    free = np.ones(len(points), bool)
    if len(taken):
        free = cKDTree(taken).query(points, workers=get_num_threads())[0] > 0.9 * spacing
    order = rng.permutation(np.flatnonzero(free))
    if not len(order):
        return order
    kept = np.zeros(len(order), np.bool_)
    _keep_apart(points[order], spacing, kept)
    return np.sort(order[kept])


@njit(cache=True, nogil=True, error_model="numpy")
def _keep_apart(points, spacing, kept):
    """Fill `kept` (N,) bool: points (N, 3) from which those kept before are farther than `spacing`.

    Cells as wide as that hold those kept, each as a chain.
    """
    low, size = np.empty(3), np.empty(3, np.int64)
    for i in range(3):
        low[i] = points[:, i].min()
        size[i] = int((points[:, i].max() - low[i]) / spacing) + 3  # a border of empty cells
    last = np.full((size[0], size[1], size[2]), -1, np.int64)
    before = np.empty(len(points), np.int64)
    for n in range(len(points)):
        x, y, z = points[n]
        a, b, c = int((x - low[0]) / spacing) + 1, int((y - low[1]) / spacing) + 1, int((z - low[2]) / spacing) + 1
        free = True
        for step in range(27):
            cell = (13 + step) % 27  # its own first
            other = last[a + cell // 9 - 1, b + cell // 3 % 3 - 1, c + cell % 3 - 1]
            while free and other >= 0:
                dx, dy, dz = points[other, 0] - x, points[other, 1] - y, points[other, 2] - z
                free = dx * dx + dy * dy + dz * dz > spacing * spacing
                other = before[other]
            if not free:
                break
        kept[n] = free
        if free:
            before[n] = last[a, b, c]
            last[a, b, c] = n


def surface_frames(view: FrameViews, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a paraboloid to the surface voxels round points.

    Parameters
    ----------
    view : FrameViews
    points : (N, 3) float, metres, world

    Returns
    -------
    positions : (N, 3) float
        The points moved onto the fitted surface along its normal.
    frames : (N, 3, 3) float
        World from patch frame; third axis: outward normal.
    curvature : (N, 3) float
        a, b, c of z = a s² + b s t + c t², per metre.
    """
    tree, outward = cKDTree(view.surface), _outward(view, points)
    positions, frames, curvature = map_rows(
        lambda rows: _fitted_frames(view, tree, points[rows], outward[rows]), len(points)
    )
    return positions, frames, curvature


def _fitted_frames(
    view: FrameViews, tree: cKDTree, points: np.ndarray, outward: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    radius = _FIT_VOXELS * view.voxel_size
    count = min(round(np.pi * _FIT_VOXELS**2), len(view.surface))
    distance, near = tree.query(points, count)
    away = view.surface[near] - points[:, None]
    inside = (distance <= radius)[:, :, None]
    middle = (away * inside).sum(axis=1) / inside.sum(axis=1)
    spread_out = (away - middle[:, None]) * inside
    normals = np.linalg.eigh(np.swapaxes(spread_out, 1, 2) @ spread_out)[1][:, :, 0]
    normals *= np.where(np.einsum("ni,ni->n", normals, outward) >= 0, 1.0, -1.0)[:, None]
    ridge = np.diag([0.0, 0, 0, 1, 1, 1]) * 0.05 * radius**4
    for _ in range(2):
        frames = _frames_of(normals)
        s, t, z = np.moveaxis(away @ frames, 2, 0)
        used = inside[:, :, 0] & (np.abs(z) < 0.6 * radius)  # not the other side of a thin limb
        design = np.stack([np.ones_like(s), s, t, s * s, s * t, t * t], axis=2)
        weighted = np.swapaxes(design * used[:, :, None], 1, 2)
        regular = ridge * used.sum(axis=1)[:, None, None] + _REGULAR * np.eye(6)
        fit = np.linalg.solve(weighted @ design + regular, weighted @ z[:, :, None])[:, :, 0]
        slopes = np.stack([-fit[:, 1], -fit[:, 2], np.ones(len(fit))], axis=1)
        normals = np.einsum("nij,nj->ni", frames, slopes / np.linalg.norm(slopes, axis=1, keepdims=True))
    positions = points + fit[:, :1] * frames[:, :, 2]
    return positions, frames, np.clip(fit[:, 3:], -0.5 / radius, 0.5 / radius)


def seed_patches(
    view: FrameViews,
    taken: np.ndarray,
    spacing: float,
    settings: TrackingSettings,
    rng: np.random.Generator,
) -> Patches:
    """Place new patches where a frame's surface has none.

    First wide ones; where cameras don't agree on these, narrow ones a little beside, twice.

    Parameters
    ----------
    view : FrameViews
    taken : (K, 3) float
        Positions of patches that are there already, metres, world.
    spacing : float
        Distance of patches, metres.
    settings : TrackingSettings
    rng : numpy.random.Generator
    """
    patches = Patches.empty(template_room(view, settings))
    tree = cKDTree(view.surface)
    tried = np.zeros(len(view.surface), bool)
    wide, narrow = patch_radii(view, spacing, settings)
    for radius in (wide, narrow, narrow):
        candidates = np.flatnonzero(~tried)
        # a hull stands off the true surface: what is there already counts where it shows on the hull
        there = view.surface[tree.query(np.concatenate([taken, patches.positions]), workers=get_num_threads())[1]]
        chosen = candidates[spaced(view.surface[candidates], spacing, there, rng)]
        if not len(chosen):
            break
        tried[chosen] = True
        patches = patches.join(_seed_at(view.surface[chosen], view, settings, radius))
    return patches


def seed_for_one_camera(
    view: FrameViews, taken: np.ndarray, spacing: float, settings: TrackingSettings, rng: np.random.Generator
) -> Patches:
    """Place new patches where a frame's surface has none, each for the camera that sees it best.

    They stay on the surface as it is given, and only where this must be what the camera sees. First narrow ones; where
    these hold too little texture to tell how they move, wide ones. Parameters as for `seed_patches`.
    """
    there = view.surface[cKDTree(view.surface).query(taken)[1]]
    points = view.surface[spaced(view.surface, spacing, there, rng)]
    wide, narrow = patch_radii(view, spacing, settings)
    patches = Patches.empty(template_room(view, settings))
    for radius in dict.fromkeys((narrow, wide)):
        patches = patches.join(_precise_alone(points, view, settings, radius))
        if len(patches):
            points = points[cKDTree(patches.positions).query(points)[0] > 0.9 * spacing]
        if not len(points):
            break
    return patches


def _precise_alone(points: np.ndarray, view: FrameViews, settings: TrackingSettings, radius_px: int) -> Patches:
    """Make patches of single cameras at points of the surface (N, 3), where their texture tells how they move."""
    blank, seen, cosine = _blank(points, view, settings, 1, _FACING_ALONE, radius_px)
    seen &= nothing_behind(view, blank.positions)
    some = seen.any(axis=1)
    patches, reference = _of_best_camera(blank.select(np.flatnonzero(some)), seen[some], cosine[some], view)
    keep = np.flatnonzero(patches.has.any(axis=1))
    noise = image_precision(patches, keep, reference[keep], np.ones(len(keep)))
    fits = noise < _NOISE_FRACTION * settings.sigma_px * patches.size[keep]
    return patches.select(keep[fits])


def _seed_at(points: np.ndarray, view: FrameViews, settings: TrackingSettings, radius_px: int) -> Patches:
    """Make patches at points of the surface (N, 3), as far as two cameras agree on them."""
    blank, seen, cosine = _blank(points, view, settings, settings.n_views, FACING_OTHERS, radius_px)
    # a patch belongs to the camera that faces it best; it needs a second one
    patches, reference = _of_best_camera(blank, seen, cosine, view)
    keep = np.flatnonzero(patches.has.any(axis=1))
    return _lock(patches.select(keep), seen[keep], reference[keep], view, settings)


def _blank(
    points: np.ndarray, view: FrameViews, settings: TrackingSettings, least_views: int, facing: float, radius_px: int
) -> tuple[Patches, np.ndarray, np.ndarray]:
    """Patches without templates where enough cameras see the surface, those cameras, and the cosines to them."""
    positions, frames, curvature = surface_frames(view, points)
    cosine = facings(positions, frames[:, :, 2], view)
    seen = _seen(view, positions) & (cosine > facing)
    good = seen.sum(axis=1) >= least_views
    positions, frames, curvature, cosine, seen = (a[good] for a in (positions, frames, curvature, cosine, seen))
    best = np.where(seen, cosine, -1).argmax(axis=1)
    size = view.pixel_size(positions)[np.arange(len(positions)), best]
    room = template_room(view, settings)
    blank = Patches.without_templates(positions, frames, curvature, size, radius_px, room)
    return blank, seen, cosine


def _of_best_camera(
    blank: Patches, seen: np.ndarray, cosine: np.ndarray, view: FrameViews
) -> tuple[Patches, np.ndarray]:
    """Patches with the template of the camera that faces each best, and that camera, (N,) int."""
    reference = np.where(seen, cosine, -1).argmax(axis=1)
    only = np.zeros(seen.shape, bool)
    only[np.arange(len(blank)), reference] = True
    return with_templates(blank, only, view), reference


def _lock(
    patches: Patches, seen: np.ndarray, reference: np.ndarray, view: FrameViews, settings: TrackingSettings
) -> Patches:
    """Sweep patches along the reference camera's ray, align them there, and take every camera's own template."""
    N = len(seen)
    rows, every = np.arange(N), np.arange(N)
    # all cameras look for what the reference camera saw
    shared = as_one_camera(patches, reference, seen)
    others = seen.copy()
    others[rows, reference] = False
    ray = patches.positions - view.centers[reference]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    step = _SWEEP_PX * float(np.median(patches.size)) if N else 1.0
    diagonal = float(np.linalg.norm(np.ptp(view.surface, axis=0)))
    shifts = np.arange(-settings.search_front * diagonal, settings.search_depth * diagonal + step, step)
    scores = np.empty((N, len(shifts)))
    for j, shift in enumerate(shifts):
        moved = patches.positions + shift * ray
        tried = align(shared, every, moved, patches.frames, others, view, iterations=(-1, 0), least_correlation=0.0)
        scores[:, j] = tried.correlation
    peak = scores.argmax(axis=1)
    start = patches.positions + shifts[peak][:, None] * ray
    # another place that fits nearly as well leaves it open which one is true
    elsewhere = np.abs(np.arange(len(shifts)) - peak[:, None]) > _PEAK_PX / _SWEEP_PX
    clear = scores[rows, peak] - np.where(elsewhere, scores, -1.0).max(axis=1) > _CLEAR
    found = align(
        shared,
        every,
        start,
        patches.frames,
        seen,
        view,
        iterations=(4, 12),
        least_correlation=settings.camera_correlation,
        prior_shift_px=5.0,
        prior_turn=0.2,
    )
    agree = others & (found.by_camera >= settings.camera_correlation)
    mean = np.where(agree, found.by_camera, 0).sum(axis=1) / np.maximum(agree.sum(axis=1), 1)
    keep = (agree.sum(axis=1) >= settings.n_views - 1) & (mean >= settings.seed_correlation)
    keep &= clear & (np.linalg.norm(found.positions - start, axis=1) < _PEAK_PX * patches.size)
    keep &= (found.sigma < settings.sigma_px * patches.size) & view.may_be_subject(found.positions)
    agree[rows, reference] = True
    patches = patches.moved(found.positions, found.frames).select(keep)
    own = with_templates(patches.cleared(template_room(view, settings)), agree[keep], view)
    return own.select(np.flatnonzero(own.has.sum(axis=1) >= settings.n_views))


def _seen(view: FrameViews, points: np.ndarray) -> np.ndarray:
    """Cameras in which nothing lies before points of the surface, (N, C) bool."""
    depth, surface = view.depths(points)
    return depth - surface < _HULL_SLACK * view.voxel_size


def _outward(view: FrameViews, points: np.ndarray) -> np.ndarray:
    """Sum of the directions in which cameras that see points lie: (N, 3) float."""
    ray = view.centers[None] - points[:, None]
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    return (ray * _seen(view, points)[:, :, None]).sum(axis=1)


def _frames_of(normals: np.ndarray) -> np.ndarray:
    """Right-handed axes (N, 3, 3) with the unit normals (N, 3) as third column (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([first, second, normals], axis=2)
