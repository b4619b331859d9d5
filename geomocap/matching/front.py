"""The growing front: which cells are matched next, and from which neighbour they start.

Cells are matched in rounds. All cells of a round start from cells of earlier rounds and see nothing of each other, so
that the result does not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from geomocap.matching import grow_kernel as gk
from geomocap.matching import patch_kernel as pk
from geomocap.matching.match_grid import MatchGrid
from geomocap.matching.matching_settings import GrowingSettings, KernelSettings
from geomocap.matching.seeds import Seeds
from geomocap.matching.spline import ImageStack

_LEFT, _RIGHT, _ABOVE, _BELOW = range(4)
_GAP = 3
_FEW = 96


def limits_of(settings: GrowingSettings, kernel: KernelSettings, least_images: int = 1) -> np.ndarray:
    """Pack thresholds as the kernel wants them."""
    limits = np.zeros(gk.LIMITS)
    limits[gk.ITERATIONS] = min(settings.iterations, kernel.iterations)
    limits[gk.TOLERANCE] = kernel.tolerance
    limits[gk.CONTRAST] = kernel.minimum_contrast
    limits[gk.MAX_SHIFT] = settings.maximum_shift
    limits[gk.SIGMA_CONDITION] = kernel.sigma_condition
    limits[gk.MIN_CORRELATION] = settings.minimum_correlation
    limits[gk.PAIR_CORRELATION] = settings.pair_correlation
    limits[gk.MAX_SIGMA0] = settings.maximum_sigma0
    limits[gk.MAX_DEVIATION] = settings.maximum_deviation
    limits[gk.MAX_EPIPOLAR] = settings.maximum_epipolar
    limits[gk.MIN_IMAGES] = least_images
    return limits


@dataclass
class Front:
    """State of all cells while growing.

    Attributes
    ----------
    points : (N, 2) float
        Cells in the template image, array indices.
    position, affine, quality : (N, K, 2), (N, K, 4), (N, K, COLUMNS) float
        Matches, array indices.
    planes : (N, PLANE) float
        Planes of matched cells.
    tries : (N,) int
        Rounds in which a cell was tried in vain.
    """

    grid: MatchGrid
    images: ImageStack
    template: int
    searches: np.ndarray
    transfers: np.ndarray
    limits: np.ndarray
    settings: GrowingSettings
    points: np.ndarray
    position: np.ndarray
    affine: np.ndarray
    quality: np.ndarray
    planes: np.ndarray
    tries: np.ndarray

    @classmethod
    def over(
        cls,
        grid: MatchGrid,
        images: ImageStack,
        template: int,
        searches: np.ndarray,
        transfers: np.ndarray,
        settings: GrowingSettings,
        kernel: KernelSettings,
        least_images: int = 1,
    ) -> Front:
        """Begin with no cell matched."""
        n, k = len(grid), len(searches)
        quality = np.zeros((n, k, pk.COLUMNS))
        quality[..., pk.STATUS] = pk.UNTRIED
        limits = limits_of(settings, kernel, least_images)
        transfers = np.ascontiguousarray(transfers, dtype=np.float64)
        points = np.ascontiguousarray(grid.pixels - 0.5)
        state = (
            points,
            np.zeros((n, k, 2)),
            np.zeros((n, k, 4)),
            quality,
            np.zeros((n, gk.PLANE)),
            np.zeros(n, np.int64),
        )
        return cls(grid, images, template, searches, transfers, limits, settings, *state)

    @property
    def matched(self) -> np.ndarray:
        """Which cells are matched, (N,) bool."""
        return self.planes[:, gk.IMAGES] > 0

    # --- one round ---

    def begin(self, cells: np.ndarray, seeds: Seeds) -> None:
        """Match the cells at which the regions begin, (S,) int, -1 for none, from the seeds' planes."""
        which = np.flatnonzero(cells >= 0)
        planes = np.zeros((len(which), gk.PLANE))
        planes[:, :3] = seeds.planes[which]
        # The search along the line is coarser than what a neighbour hands on
        usual = self.limits[gk.MAX_SHIFT]
        self.limits[gk.MAX_SHIFT] = max(usual, self.settings.seed_shift)
        self._attempt(cells[which], planes, seeds.pixels[which] - 0.5)
        self.limits[gk.MAX_SHIFT] = usual
        self.tries[:] = 0

    def step(self, sources: np.ndarray, targets: np.ndarray) -> None:
        """Match cells `targets` (M,), each once, from the planes of cells `sources` (M,)."""
        self._attempt(targets, self.planes[sources], self.points[sources])

    def _attempt(self, targets: np.ndarray, planes: np.ndarray, origins: np.ndarray, hole: bool = False) -> None:
        """Match cells from planes that hold at `origins` (M, 2), adapting where the quality is poor.

        Holes are where the surface bends: they are tried with the smaller patch, and without shifts half way.
        """
        if len(targets) == 0:
            return
        settings = self.settings
        larger, smaller = round(settings.radius * settings.larger), max(round(settings.radius / settings.larger), 3)
        # A handful of points is not worth waking the other threads for
        threads = numba.get_num_threads()
        numba.set_num_threads(threads if len(targets) > _FEW else 1)
        try:
            gk.match_cells(
                self.images.arrays,
                self.template,
                self.searches,
                self.transfers,
                self.limits,
                self.points,
                targets,
                np.ascontiguousarray(origins),
                np.ascontiguousarray(planes),
                np.array([smaller if hole else settings.radius, larger, smaller]),
                not hole,
                self.planes,
                (self.position, self.affine, self.quality),
            )
        finally:
            numba.set_num_threads(threads)
        self.tries[targets] += self.planes[targets, gk.IMAGES] == 0

    # --- orders ---

    def best_first(self) -> None:
        """Spread over the image, the neighbours of the better matches first.

        In each round, of all cells that border on matched ones, the half with the better neighbours is tried, each from
        its best neighbour.
        """
        # What a cell was last tried from; it is not tried from the same again
        last = np.full(len(self.grid), -1, np.int64)
        source, key = np.full(len(self.grid), -1, np.int64), np.zeros(len(self.grid))
        while True:
            gk.best_neighbours(self.grid.neighbours, self.planes, self.tries, self.settings.attempts, last, source, key)
            targets = np.flatnonzero(source >= 0)
            if len(targets) == 0:
                return
            targets = targets[key[targets] >= np.median(key[targets])]
            last[targets] = source[targets]
            self.step(source[targets], targets)

    def sequential(self, region: np.ndarray, begin: np.ndarray) -> None:
        """Cover each region as the paper does: horizontal shifts from the seed, vertical ones from each of that row."""
        begin = begin[self.matched[begin]]
        for direction in (_LEFT, _RIGHT):
            self._shift(region, begin, direction)
        row = np.flatnonzero(self.matched)
        for direction in (_ABOVE, _BELOW):
            self._shift(region, row, direction)

    def _shift(self, region: np.ndarray, start: np.ndarray, direction: int) -> None:
        """Go on from matched cells in one direction within their regions, over gaps of up to two cells."""
        neighbours = self.grid.neighbours
        sources, ahead, gap = start, neighbours[start, direction], np.zeros(len(start), np.int64)
        while True:
            go = (ahead >= 0) & (gap < _GAP)
            go[go] &= region[ahead[go]] == region[sources[go]]
            sources, ahead, gap = sources[go], ahead[go], gap[go]
            if len(sources) == 0:
                return
            todo = ~self.matched[ahead]
            self.step(sources[todo], ahead[todo])
            # Another neighbour, where the one behind did not do
            for other in range(4):
                around = neighbours[ahead, other]
                again = ~self.matched[ahead] & (around >= 0) & (around != sources)
                again[again] &= self.matched[around[again]] & (region[around[again]] == region[ahead[again]])
                if again.any():
                    self.step(around[again], ahead[again])
            done = self.matched[ahead]
            sources = np.where(done, ahead, sources)
            gap = np.where(done, 0, gap + 1)
            ahead = neighbours[ahead, direction]

    def fill_holes(self, passes: int) -> None:
        """Try what is left from all directions: from the mean plane of all matched neighbours."""
        at = self.grid.neighbours
        fresh = self.matched
        for _ in range(passes):
            matched = self.matched
            around = (at >= 0) & matched[at]
            targets = np.flatnonzero(~matched & (around & fresh[at]).any(axis=1))
            if len(targets) == 0:
                return
            self._from_mean(targets, around[targets])
            fresh = self.matched & ~matched

    def _from_mean(self, targets: np.ndarray, around: np.ndarray) -> None:
        at = self.grid.neighbours[targets]
        offset = self.grid.pixels[targets, None] - self.grid.pixels[at]
        planes = self.planes[at]
        planes = moved(planes.reshape(-1, gk.PLANE), offset.reshape(-1, 2)).reshape(planes.shape)
        mean = (planes * around[..., None]).sum(axis=1) / around.sum(axis=1)[:, None]
        self._attempt(targets, mean, self.points[targets], hole=True)


def moved(planes: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Carry planes (M, PLANE) along template offsets (M, 2), pixels."""
    result = planes.copy()
    result[:, gk.MU] += np.einsum("mi,mi->m", planes[:, [gk.SLOPE_X, gk.SLOPE_Y]], way)
    return result
