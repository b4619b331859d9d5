"""Whether the images fit the calibration, from what they matched: no points are better than wrong ones.

Growing keeps its matches near the epipolar lines, so a wrong orientation shows in few of them. A sample of the matches
is therefore repeated without the geometric condition: with a right calibration they stay on their lines within their
precision, with a wrong one they leave them, or, being matches of chance, come to rest anywhere. Matches of chance also
hardly spread from their seeds, disagree with their neighbours, and are not confirmed by a third image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.dense.dense_settings import TrustSettings
from geomocap.matching.growing import SurfaceMatches
from geomocap.matching.lsm import match_multi
from geomocap.matching.matching_settings import KernelSettings
from geomocap.matching.spline import ImageStack
from geomocap.model.even_choice import evenly_chosen

_LEAST = 30  # matches by which an image is judged


@dataclass(frozen=True)
class MatchEvidence:
    """What the matches of one template say of its images and calibration.

    Attributes
    ----------
    residuals : (K,) float
        For each search image, the median distance from the epipolar lines of matches left free, pixels; infinite where
        most are lost, NaN where there are too few to judge.
    growth : float
        Matched area over the area that the seeds stand for.
    removed : float
        Fraction of the matches that disagree with their neighbours.
    confirmed : float
        Fraction of the matches seen in several search images; NaN if there is but one.
    """

    residuals: np.ndarray
    growth: float
    removed: float
    confirmed: float

    def doubt(self, trust: TrustSettings) -> str:
        """Say why none of the matches is to be trusted; empty if they are."""
        known = self.residuals[~np.isnan(self.residuals)]
        worst = float(known.max(initial=0.0))
        if self.growth < trust.growth:
            return "matches do not spread from their seeds"
        if worst > trust.residual:
            return f"matches leave their epipolar lines by {worst:.2f} px"
        # A pair has nothing to contradict it: it has to look right in every other way
        if not self.confirmed >= trust.confirmed:
            if self.removed > trust.removed:
                return (
                    f"{self.removed:.0%} of the matches disagree with their neighbours and no third image confirms them"
                )
            if np.isfinite(self.confirmed) and worst > trust.pair_residual:
                return f"matches leave their epipolar lines by {worst:.2f} px and no third image confirms them"
        return ""


def evidence_of(
    images: ImageStack,
    surface: SurfaceMatches,
    transfers: np.ndarray,
    kernel: KernelSettings,
    radius: int,
    cell: float,
) -> MatchEvidence:
    """Gather the evidence of one template's matches; `cell` is the distance of its seeds, pixels."""
    free = epipolar_residuals(images, surface, transfers, kernel, radius)
    known = [d[~np.isnan(d)] for d in free.T]
    residuals = np.array([np.median(d) if len(d) >= _LEAST else np.nan for d in known])
    matched, removed, seeds = int(surface.matched.sum()), int(surface.removed.sum()), len(surface.seeds)
    several = float((surface.seen.sum(axis=1) > 1).sum() / max(matched, 1)) if len(transfers) > 1 else np.nan
    growth = matched * surface.grid.step**2 / max(seeds * cell**2, 1.0)
    return MatchEvidence(residuals, growth, removed / max(matched + removed, 1), several)


def epipolar_residuals(
    images: ImageStack,
    surface: SurfaceMatches,
    transfers: np.ndarray,
    kernel: KernelSettings,
    radius: int,
    sample: int = 150,
) -> np.ndarray:
    """Distances from the epipolar lines of matches made anew without the geometric condition.

    Parameters
    ----------
    images : ImageStack
    surface : SurfaceMatches
    transfers : (K, 12) float
    kernel : KernelSettings
    radius : int
        Of the patches, pixels.
    sample : int
        Most matches in each search image that are made anew, evenly spread over the template.

    Returns
    -------
    (S, K) float, pixels; NaN where a search image did not see the point, infinite where the match was lost
    """
    chosen = [np.zeros(0, np.int64)]
    for seen in surface.seen.T:
        cells = np.flatnonzero(seen)
        chosen.append(cells[evenly_chosen(len(cells), sample)])
    cells = np.unique(np.concatenate(chosen))
    m = surface.matches
    start = np.concatenate([m.positions[cells], m.affine[cells].reshape(len(cells), len(transfers), 4)], axis=2)
    free = kernel.model_copy(update={"radius": radius, "sigma_condition": 0.0, "max_shift": 0.0})
    again = match_multi(images, surface.template, surface.searches, surface.grid.pixels[cells], start, transfers, free)
    # One inverse depth for all images would mix them: each image against its own line
    distance = _from_line(transfers, surface.grid.pixels[cells], again.positions)
    return np.where(surface.seen[cells], np.where(again.matched, distance, np.inf), np.nan)


def _from_line(transfers: np.ndarray, pixels: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Distances (N, K) of search positions (N, K, 2) from the epipolar lines of template pixels (N, 2)."""
    x = np.column_stack([pixels - 0.5, np.ones(len(pixels))])
    infinite = np.einsum("kij,nj->nki", transfers[:, :9].reshape(-1, 3, 3), x)
    line = np.cross(infinite, transfers[None, :, 9:])
    seen = np.concatenate([positions - 0.5, np.ones((*positions.shape[:2], 1))], axis=2)
    length = np.maximum(np.linalg.norm(line[..., :2], axis=2), 1e-12)
    return np.abs(np.einsum("nki,nki->nk", line, seen)) / length
