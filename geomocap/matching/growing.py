"""From seeds to a dense set of matched points over one template image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geomocap.matching import patch_kernel as pk
from geomocap.matching.front import Front
from geomocap.matching.lsm import Matches, count_reasons, matches_of
from geomocap.matching.match_grid import MatchGrid
from geomocap.matching.matching_settings import GrowingSettings, KernelSettings
from geomocap.matching.seeds import Seeds
from geomocap.matching.spline import ImageStack

STEP = 1.5  # distance of neighbouring cells if none is asked for, pixels


@dataclass(frozen=True)
class SurfaceMatches:
    """Dense correspondences of one template image.

    Attributes
    ----------
    template : int
    searches : (K,) int
    grid : MatchGrid
        N cells.
    matches : Matches
        Of leading shape (N, K); not matched where an image did not see the point.
    planes : (N, 3) float
        Inverse depth, 1/m, and slopes, 1/m per pixel; NaN where not matched.
    matched : (N,) bool
        Cells that were matched and survived the consistency pass.
    removed : (N,) bool
        Cells that the consistency pass took out.
    region : (N,) int
        Number of the seed in whose Voronoi region the cell lies; -1 without seeds.
    seeds : Seeds
    reasons : dict
        What became of the cells: the words of `lsm.REASONS`, "disagrees with its neighbours"; and of the seeds.
    """

    template: int
    searches: np.ndarray
    grid: MatchGrid
    matches: Matches
    planes: np.ndarray
    matched: np.ndarray
    removed: np.ndarray
    region: np.ndarray
    seeds: Seeds
    reasons: dict[str, int]

    def without_matches(self) -> SurfaceMatches:
        """Return the same with all matches removed."""
        none = np.zeros_like(self.matched)
        removed = self.removed | self.matched
        return replace(self, planes=np.full_like(self.planes, np.nan), matched=none, removed=removed)

    @property
    def seen(self) -> np.ndarray:
        """Which search images saw which cell, (N, K) bool."""
        return self.matches.matched & self.matched[:, None]


def grow(
    images: ImageStack,
    template: int,
    searches: np.ndarray,
    transfers: np.ndarray,
    seeds: Seeds,
    mask: np.ndarray | None = None,
    settings: GrowingSettings | None = None,
    kernel: KernelSettings | None = None,
    least_images: int = 1,
) -> SurfaceMatches:
    """Match the template densely, beginning at the seeds.

    Parameters
    ----------
    images : ImageStack
        Images free of distortion; its masks bound where search images may be met and which template pixels count.
    template : int
    searches : (K,) int
    transfers : (K, 12) float
    seeds : Seeds
    mask : (H, W) array, optional
        Non-zero where the template is to be matched.
    settings : GrowingSettings, optional
    kernel : KernelSettings, optional
        Its radius and greatest shift are not used, `settings` has its own.
    least_images : int
        Search images that have to see a point.

    Returns
    -------
    SurfaceMatches
        The same for any number of threads.
    """
    settings, kernel = settings or GrowingSettings(), kernel or KernelSettings()
    searches = np.asarray(searches, dtype=np.int64)
    height, width = (int(v) for v in images.layout[template, 2:])
    grid = MatchGrid.over((height, width), settings.step or STEP, mask)
    front = Front.over(grid, images, template, searches, transfers, settings, kernel, least_images)

    # Voronoi regions of the seeds; each begins at the cell nearest to its seed
    region, begin = regions(grid, seeds)
    front.begin(begin, seeds)
    if settings.order == "best":
        front.best_first()
    else:
        front.sequential(region, begin[begin >= 0])
    front.fill_holes(settings.hole_passes)

    matches = matches_of(front.position, front.affine, front.quality, front.position + 0.5)
    kept = consistent(grid, matches, front.matched, settings)
    planes = np.where(kept[:, None], front.planes[:, :3], np.nan)
    reasons = _count(matches.status, front.matched, kept) | seeds.reasons
    removed = front.matched & ~kept
    return SurfaceMatches(template, searches, grid, matches, planes, kept, removed, region, seeds, reasons)


def regions(grid: MatchGrid, seeds: Seeds) -> tuple[np.ndarray, np.ndarray]:
    """Voronoi tessellation of the cells.

    Returns
    -------
    region : (N,) int
        The seed nearest to each cell; -1 without seeds.
    begin : (S,) int
        The cell nearest to each seed; -1 where that cell belongs to another seed.
    """
    region = np.full(len(grid), -1, np.int64)
    begin = np.full(len(seeds), -1, np.int64)
    if len(seeds) and len(grid):
        region[:] = cKDTree(seeds.pixels).query(grid.pixels)[1]
        nearest = cKDTree(grid.pixels).query(seeds.pixels)[1]
        own = region[nearest] == np.arange(len(seeds))
        begin[own] = nearest[own]
    return region, begin


def consistent(grid: MatchGrid, matches: Matches, matched: np.ndarray, settings: GrowingSettings) -> np.ndarray:
    """Say which matched cells agree with their neighbours.

    Two neighbours agree if, in every image that saw both, each lies where the other's affine matrix predicts it. A
    cell stays if at least half of its matched neighbours agree with it and it hangs together with enough others; with
    more if one search image alone saw them all.

    Returns
    -------
    (N,) bool
    """
    count = len(grid)
    source = np.repeat(np.arange(count), 8)
    target = grid.neighbours.ravel()
    both = (target >= 0) & matched[source] & matched[target]
    source, target = source[both], target[both]
    offset = grid.pixels[target] - grid.pixels[source]
    predicted = matches.positions[source] + np.einsum("nkij,nj->nki", matches.affine[source], offset)
    miss = np.linalg.norm(predicted - matches.positions[target], axis=-1)
    seen = matches.matched[source] & matches.matched[target]
    limit = settings.agreement * np.linalg.norm(offset, axis=1) / grid.step
    agree = seen.any(axis=1) & (~seen | (miss <= limit[:, None])).all(axis=1)
    # Agreement is mutual
    key = source * count + target
    back = target * count + source
    agree &= np.isin(key, back[agree])

    kept = matched.copy()
    total = np.bincount(source, minlength=count)
    friends = np.bincount(source[agree], minlength=count)
    kept &= 2 * friends >= total
    links = agree & kept[source] & kept[target]
    graph = coo_matrix((np.ones(links.sum(), np.int8), (source[links], target[links])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    number = label.max(initial=0) + 1
    size = np.bincount(label[kept], minlength=number)
    area = size * grid.step**2
    kept &= area[label] >= settings.minimum_patch
    if matches.status.shape[1] > 1:
        # What no second image confirms may be chance, the more so with wrong cameras: only large patches are none
        several = kept & (matches.matched.sum(axis=1) > 1)
        confirmed = np.bincount(label[several], minlength=number) >= np.maximum(settings.confirmed * size, 1)
        kept &= confirmed[label] | (area[label] >= settings.minimum_pair_patch)
    return kept


def _count(status: np.ndarray, matched: np.ndarray, kept: np.ndarray) -> dict[str, int]:
    """Count each cell once: a matched cell as matched or disagreeing, any other by its image's commonest reason."""
    worst = np.where(matched[:, None], pk.MATCHED, np.where(status == pk.MATCHED, pk.CORRELATION, status))
    reasons = count_reasons(worst.max(axis=1, initial=0))
    reasons.pop("matched", None)
    counts = {"matched": int(kept.sum())}
    if (matched & ~kept).any():
        counts["disagrees with its neighbours"] = int((matched & ~kept).sum())
    return counts | reasons
