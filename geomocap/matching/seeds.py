"""Seeds: interest points of the template and their best match along the epipolar lines of all search images.

A seed's patch is carried along the viewing ray (a sweep of the inverse depth μ) on planes of several tilts; every
image gives a correlation for every μ. The best place is that of the highest mean correlation. It has to lead over all
other places (uniqueness), every image has to correlate there, and each image's own best place has to be near it
(consistency).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from geomocap.matching.foerstner import interest_points
from geomocap.matching.matching_settings import SeedSettings
from geomocap.matching.plane_sweep import SweepImages, sweep

REASONS = ("seed found", "seed without depth range", "seed of low correlation", "seed not unique", "images disagree")


@dataclass(frozen=True)
class Seeds:
    """Where growing begins.

    Attributes
    ----------
    pixels : (S, 2) float
        Template image, COLMAP pixels.
    planes : (S, 3) float
        Inverse depth, 1/m, and its slope in x and y, 1/m per pixel.
    correlation : (S,) float
    reasons : dict
        How many interest points came to which end.
    """

    pixels: np.ndarray
    planes: np.ndarray
    correlation: np.ndarray
    reasons: dict[str, int]

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class DepthRange:
    """Where surface may lie along the template's rays.

    Attributes
    ----------
    near, far : (H, W) float32
        Bounds of the depth along the camera's axis for each template pixel, metres; NaN where there is no surface.
    """

    near: np.ndarray
    far: np.ndarray

    @classmethod
    def constant(cls, shape: tuple[int, int], near: float, far: float) -> DepthRange:
        """Return the same bounds for all pixels of an image of shape (H, W)."""
        return cls(np.full(shape, near, np.float32), np.full(shape, far, np.float32))


def find_seeds(
    image: np.ndarray,
    mask: np.ndarray | None,
    smooth: SweepImages,
    transfers: np.ndarray,
    depth: DepthRange,
    focal: float,
    settings: SeedSettings | None = None,
) -> Seeds:
    """Find interest points and their planes.

    Parameters
    ----------
    image : (H, W) array
        Template, grey, free of distortion, after the Wallis filter.
    mask : (H, W) array, optional
        Non-zero where the subject is seen.
    smooth : SweepImages
        Template and search images, smoothed.
    transfers : (K, 12) float
    depth : DepthRange
    focal : float
        Camera constant of the template, pixels.
    settings : SeedSettings, optional

    Returns
    -------
    seeds : Seeds
        The strongest interest points first.
    """
    settings = settings or SeedSettings()
    points = interest_points(image, mask, settings)
    rows, columns = (points.pixels[:, ::-1].T - 0.5).astype(int)
    bounds = np.column_stack([1 / depth.far[rows, columns], 1 / depth.near[rows, columns]]).astype(np.float64)
    result = np.zeros((len(points.pixels), 5))
    sweep(
        (smooth.flat, smooth.seen, smooth.shapes, smooth.starts),
        transfers,
        points.pixels - 0.5,
        bounds,
        focal,
        settings.radius,
        settings.step,
        settings.tilt,
        settings.tilts,
        (settings.correlation, settings.pair_correlation, settings.uniqueness, settings.agreement),
        result,
    )
    status = result[:, 0].astype(int)
    counts = Counter(status.tolist())
    good = status == 0
    return Seeds(
        points.pixels[good],
        result[good, 1:4],
        result[good, 4],
        {REASONS[code]: counts[code] for code in sorted(counts)},
    )
