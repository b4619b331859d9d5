"""The growing front: which cells are matched next, and from which neighbour they start.

Cells are matched in rounds. All cells of a round start from cells of earlier rounds and see nothing of each other, so
that the result does not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np

from geomocap.matching import grow_kernel as gk
from geomocap.matching import patch_kernel as pk
from geomocap.matching.grid import Grid
from geomocap.matching.plane_sweep import SweepImages, tilt_planes
from geomocap.matching.seeds import Seeds
from geomocap.matching.settings import GrowingSettings, KernelSettings, SeedSettings
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
    position, affine, quality : (N, K, 2), (N, K, 4), (N, K, COLUMNS) float
        Matches, array indices.
    planes : (N, PLANE) float
        Planes of matched cells.
    tries : (N,) int
        Rounds in which a cell was tried in vain.
    smooth : SweepImages, optional
        For trying tilted planes.
    focal : float
        Camera constant of the template, pixels.
    """

    grid: Grid
    images: ImageStack
    template: int
    searches: np.ndarray
    transfers: np.ndarray
    limits: np.ndarray
    settings: GrowingSettings
    position: np.ndarray
    affine: np.ndarray
    quality: np.ndarray
    planes: np.ndarray
    tries: np.ndarray
    smooth: SweepImages | None = None
    focal: float = 0.0
    seeds: SeedSettings = field(default_factory=SeedSettings)

    @classmethod
    def over(
        cls,
        grid: Grid,
        images: ImageStack,
        template: int,
        searches: np.ndarray,
        transfers: np.ndarray,
        settings: GrowingSettings,
        kernel: KernelSettings,
        least_images: int = 1,
        smooth: SweepImages | None = None,
        focal: float = 0.0,
    ) -> Front:
        """Begin with no cell matched."""
        n, k = len(grid), len(searches)
        quality = np.zeros((n, k, pk.COLUMNS))
        quality[..., pk.STATUS] = pk.UNTRIED
        limits = limits_of(settings, kernel, least_images)
        transfers = np.ascontiguousarray(transfers, dtype=np.float64)
        state = np.zeros((n, k, 2)), np.zeros((n, k, 4)), quality, np.zeros((n, gk.PLANE)), np.zeros(n, np.int64)
        return cls(grid, images, template, searches, transfers, limits, settings, *state, smooth, focal)

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
        self._attempt(targets, self.planes[sources].copy(), self.grid.pixels[sources] - 0.5)

    def _attempt(self, targets: np.ndarray, planes: np.ndarray, origins: np.ndarray) -> None:
        """Match cells from planes that hold at `origins` (M, 2), adapting where the quality is poor."""
        points = self.grid.pixels[targets] - 0.5
        radius = self.settings.radius
        left = self._match(targets, moved(planes, points - origins), points, radius, first=True)
        # A larger patch where texture is short, a smaller one where the surface is not plane enough
        reason = self.quality[targets, :, pk.STATUS]
        short = ((reason == pk.LOW_TEXTURE) | (reason == pk.PRECISION)).any(axis=1)
        for other, which in (
            (round(radius * self.settings.larger), short),
            (max(round(radius / self.settings.larger), 3), ~short),
        ):
            chosen = left[which[left]]
            if other != radius and len(chosen):
                rest = self._match(targets[chosen], moved(planes, points - origins)[chosen], points[chosen], other)
                done = np.setdiff1d(chosen, chosen[rest], assume_unique=True)
                left = np.setdiff1d(left, done, assume_unique=True)
        # A smaller shift: a point half way hands its own plane on
        left = left[np.abs(points - origins)[left].max(axis=1, initial=0) > 0.5]
        if len(left):
            middle = 0.5 * (points + origins)[left]
            half = moved(planes[left], middle - origins[left])
            found = self._run(middle, half, radius)
            good = found[:, gk.IMAGES] > 0
            left, middle, found = left[good], middle[good], found[good]
            self._match(targets[left], moved(found, points[left] - middle), points[left], radius)
        self.tries[targets] += ~self.matched[targets]

    def _match(
        self, targets: np.ndarray, planes: np.ndarray, points: np.ndarray, radius: int, first: bool = False
    ) -> np.ndarray:
        """Match cells from their planes, keep what passes, and return the numbers of the others."""
        out = self._buffers(len(targets))
        planes = self._run(points, planes, radius, out)
        good = planes[:, gk.IMAGES] > 0
        store = np.ones(len(good), bool) if first else good
        self.quality[targets[store]] = out[2][store]
        self.position[targets[good]], self.affine[targets[good]] = out[0][good], out[1][good]
        self.planes[targets[good]] = planes[good]
        return np.flatnonzero(~good)

    def _buffers(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        k = len(self.searches)
        return np.zeros((count, k, 2)), np.zeros((count, k, 4)), np.zeros((count, k, pk.COLUMNS))

    def _run(self, points: np.ndarray, planes: np.ndarray, radius: int, out: tuple | None = None) -> np.ndarray:
        images = self.images
        out = out or self._buffers(len(points))
        planes = np.ascontiguousarray(planes)
        if len(points) == 0:
            return planes
        # A handful of points is not worth waking the other threads for
        threads = numba.get_num_threads()
        numba.set_num_threads(threads if len(points) > _FEW else 1)
        try:
            gk.match_points(
                images.flat,
                images.masks,
                images.layout,
                images.order,
                self.template,
                self.searches,
                self.transfers,
                self.limits,
                np.ascontiguousarray(points),
                radius,
                planes,
                *out,
            )
        finally:
            numba.set_num_threads(threads)
        return planes

    # --- orders ---

    def best_first(self) -> None:
        """Spread over the image, the neighbours of the better matches first.

        In each round, of all cells that border on matched ones, the half with the better neighbours is tried, each from
        its best neighbour.
        """
        at = self.grid.neighbours[:, :4]
        # What a cell was last tried from; it is not tried from the same again
        last = np.full(len(self.grid), -1, np.int64)
        while True:
            matched = self.matched
            keys = np.where(matched, self.planes[:, gk.KEY], -np.inf)
            open_ = np.flatnonzero(~matched & (self.tries < self.settings.attempts))
            around = at[open_]
            key = np.where(around >= 0, keys[around], -np.inf)
            best = key.argmax(axis=1)
            source = around[np.arange(len(open_)), best]
            key = key[np.arange(len(open_)), best]
            usable = (key > -np.inf) & (source != last[open_])
            if not usable.any():
                return
            targets, source, key = open_[usable], source[usable], key[usable]
            front = key >= np.median(key)
            last[targets[front]] = source[front]
            self.step(source[front], targets[front])

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
        """Try what is left from all directions: from the mean plane of all matched neighbours, then from each."""
        at = self.grid.neighbours
        fresh = self.matched
        for _ in range(passes):
            matched = self.matched
            around = (at >= 0) & matched[at]
            targets = np.flatnonzero(~matched & (around & fresh[at]).any(axis=1))
            if len(targets) == 0:
                return
            self._from_mean(targets, around[targets])
            for direction in range(min(self.settings.attempts, 8)):
                # The neighbours of each cell, best first
                left = targets[~self.matched[targets]]
                key = np.where(around[left], self.planes[at[left], gk.KEY], -np.inf)
                choice = np.argsort(-key, axis=1, kind="stable")[:, direction]
                there = np.take_along_axis(key, choice[:, None], axis=1)[:, 0] > -np.inf
                self.step(at[left, choice][there], left[there])
            if self.settings.tilting and self.smooth is not None:
                left = np.flatnonzero(~self.matched[targets])
                self._tilted(targets[left], around[targets[left]])
            fresh = self.matched & ~matched

    def _tilted(self, targets: np.ndarray, around: np.ndarray) -> None:
        """Turn the plane of the best neighbour to where the images correlate best, as beyond an edge of the surface."""
        if self.smooth is None or len(targets) == 0:
            return
        at = self.grid.neighbours[targets]
        best = np.where(around, self.planes[at, gk.KEY], -np.inf).argmax(axis=1)
        source = at[np.arange(len(at)), best]
        points = self.grid.pixels[targets] - 0.5
        planes = moved(self.planes[source], self.grid.pixels[targets] - self.grid.pixels[source])
        smooth, correlation = self.smooth, np.zeros(len(targets))
        tilt_planes(
            smooth.flat,
            smooth.seen,
            smooth.shapes,
            smooth.starts,
            self.transfers,
            points,
            planes,
            self.focal,
            self.settings.radius,
            1.0,
            self.seeds.tilt,
            self.seeds.tilts,
            correlation,
        )
        good = correlation >= self.seeds.correlation
        self._attempt(targets[good], planes[good], points[good])

    def _from_mean(self, targets: np.ndarray, around: np.ndarray) -> None:
        at = self.grid.neighbours[targets]
        offset = self.grid.pixels[targets, None] - self.grid.pixels[at]
        planes = self.planes[at]
        planes = moved(planes.reshape(-1, gk.PLANE), offset.reshape(-1, 2)).reshape(planes.shape)
        mean = (planes * around[..., None]).sum(axis=1) / around.sum(axis=1)[:, None]
        self._attempt(targets, mean, self.grid.pixels[targets] - 0.5)


def moved(planes: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Carry planes (M, PLANE) along template offsets (M, 2), pixels."""
    result = planes.copy()
    result[:, gk.MU] += np.einsum("mi,mi->m", planes[:, [gk.SLOPE_X, gk.SLOPE_Y]], way)
    return result
