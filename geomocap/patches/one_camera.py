"""Patches that one camera alone sees: the image says how they move across, the volume's surface how deep they lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from geomocap.patches.alignment_kernel import COHERENT
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.surface_patches import PatchAlignment, Patches, align
from geomocap.scheduling import spread

DEPTH_PX = 3.0  # standard deviation of the depth, sample spacings
_TURN = 0.15  # rad; a single view hardly shows turns out of its plane
_NEIGHBOURS = 6  # whose median distance from the surface counts
_REACH_VOXELS = 8.0  # farther away it is another surface
_NOISE = 2.0  # grey levels, of an image that fits perfectly


def align_alone(
    patches: Patches,
    which: np.ndarray,
    start: tuple[np.ndarray, np.ndarray],
    use: np.ndarray,
    view: FrameViews,
    iterations: tuple[int, ...],
    least_correlation: float,
) -> PatchAlignment:
    """Align patches `which` (A,) with the only camera that `use` (N, C) bool names for each.

    Their depth starts where the volume's surface puts them, as deep under it as when their template was taken (median
    over neighbours), and keeps there within three samples' spacings: `sigma` has it, `image_sigma` is that of the image
    alone.
    """
    camera = use.argmax(axis=1)
    positions = start[0].copy()
    positions[which] = _on_surface(patches, positions, camera, which, view)
    found = align(
        patches,
        which,
        positions,
        start[1],
        use,
        view,
        iterations=iterations,
        least_correlation=least_correlation,
        prior_shift_px=DEPTH_PX,
        prior_turn=_TURN,
    )
    image_sigma, sigma = found.image_sigma.copy(), found.sigma.copy()
    across = image_precision(patches, which, camera[which], found.correlation[which])
    image_sigma[which] = across
    sigma[which] = np.sqrt((2 * across**2 + (DEPTH_PX * patches.size[which]) ** 2) / 3)
    return replace(found, sigma=sigma, image_sigma=image_sigma)


def image_precision(patches: Patches, which: np.ndarray, camera: np.ndarray, correlation: np.ndarray) -> np.ndarray:
    """Standard deviation along the surface in the direction that the texture tells least about, (A,) float, metres.

    From the residuals that a correlation leaves, counted as in `patch_kernel`, and the structure tensor of the
    template's slopes along the surface.

    Parameters
    ----------
    patches : Patches
    which, camera : (A,) int
    correlation : (A,) float
        Free of noise.
    """
    result = np.empty(len(which))
    store = patches.store
    arrays = store.templates, store.usable, patches.slots[which, camera], correlation, result
    spread(_image_precision, len(which), *arrays)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _image_precision(begin, end, templates, usable, slots, correlation, result):
    for n in range(begin, end):
        template, has = templates[slots[n], -1], usable[slots[n]]
        count, sums, products = 0, np.zeros(3), np.zeros((3, 3))
        for m in range(len(has)):
            if has[m]:
                count += 1
                for i in range(3):
                    sums[i] += np.float64(template[m, i])
        for i in range(3):
            sums[i] /= max(count, 1)
        for m in range(len(has)):
            if has[m]:
                for i in range(3):
                    for j in range(i + 1):
                        products[i, j] += (template[m, i] - sums[i]) * (template[m, j] - sums[j])
        half, difference = 0.5 * (products[1, 1] + products[2, 2]), 0.5 * (products[1, 1] - products[2, 2])
        weakest = half - np.sqrt(difference * difference + products[2, 1] * products[2, 1])
        r = correlation[n]
        misfit = products[0, 0] / max(count, 1) * max(1.0 - r * abs(r), 0.0)
        result[n] = np.sqrt((misfit * max(COHERENT * count, 1.0) + _NOISE * _NOISE) / max(weakest, 1e-12))


def _on_surface(
    patches: Patches, positions: np.ndarray, camera: np.ndarray, which: np.ndarray, view: FrameViews
) -> np.ndarray:
    """Places of patches `which` moved along the ray to their old depth under the surface."""
    X, c = positions[which], camera[which]
    rows = np.arange(len(which))
    depth, surface = (d[rows, c] for d in view.depths(X))
    away = surface + patches.hidden[which, c] - depth
    known = np.flatnonzero(np.isfinite(away) & (np.abs(away) < _REACH_VOXELS * view.voxel_size) & (depth > 0))
    if len(known) < _NEIGHBOURS:
        return X
    near = cKDTree(X[known]).query(X[known], _NEIGHBOURS)[1]
    fraction = np.zeros(len(which))
    fraction[known] = np.median(away[known][near], axis=1) / depth[known]
    return X + fraction[:, None] * (X - view.centers[c])
