"""Settings of least squares matching, seeds and growing."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class KernelSettings(Settings):
    """How one patch is matched."""

    radius: int = Field(10, ge=2, le=40, description="patch radius: 10 makes 21×21 patches (px)")
    order: Literal[3, 5] = Field(3, description="degree of the interpolating spline: 3 cubic, 5 quintic")
    iterations: int = Field(20, ge=1, le=200, description="limit of Gauss–Newton iterations")
    tolerance: float = Field(
        0.01, gt=0, description="step at which the iterations end; they converge tenfold each (px)"
    )
    minimum_contrast: float = Field(1.0, ge=0, description="least standard deviation in a template patch (grey levels)")
    max_shift: float = Field(0.0, ge=0, description="farthest way from the start; 0: no limit (px)")
    sigma_condition: float = Field(
        0.15, ge=0, description="standard deviation of the condition that all rays meet; 0: none (px)"
    )


class SeedSettings(Settings):
    """Where matching begins: interest points and the search along their epipolar lines."""

    window: int = Field(7, ge=3, le=31, description="window of the interest operator, odd (px)")
    minimum_weight: float = Field(0.1, ge=0, description="least w of an interest point, in means of w")
    minimum_roundness: float = Field(0.3, ge=0, le=1, description="least q of an interest point")
    cell: int = Field(14, ge=4, description="edge of the cells that have one interest point each (px)")
    limit: int = Field(1000, ge=1, description="most interest points")
    radius: int = Field(8, ge=3, le=40, description="radius of the patches that are correlated (px)")
    blur: float = Field(1.2, ge=0, description="smoothing before the search, standard deviation (px)")
    step: float = Field(2.0, gt=0.1, description="step along the epipolar line (px)")
    tilt: float = Field(0.7, gt=0, description="step of the tangents of the tilts of the planes that are tried")
    tilts: int = Field(2, ge=0, le=4, description="number of such steps each way, in x and in y")
    correlation: float = Field(0.5, ge=-1, le=1, description="least correlation in every image")
    pair_correlation: float = Field(0.8, ge=-1, le=1, description="the same where one search image alone agrees")
    uniqueness: float = Field(0.08, ge=0, description="least lead in correlation over any other place on the line")
    agreement: float = Field(3.0, gt=0, description="farthest that the images' own best places may lie apart (px)")


class GrowingSettings(Settings):
    """How matching spreads from the seeds over the template image."""

    step: float | None = Field(
        None,
        gt=0.25,
        description="distance of neighbouring points in the template image; if not given 1.5, 2 with several "
        "templates, less in small images (px)",
        json_schema_extra={"flag": "cloud-step"},
    )
    order: Literal["best", "paper"] = Field(
        "best", description="best: best neighbour first; paper: sequential horizontal and vertical shifts"
    )
    radius: int = Field(5, ge=2, le=40, description="patch radius: 5 makes 11×11 patches (px)")
    larger: float = Field(1.5, ge=1, description="growth of the patch where the quality is poor; 1: none")
    minimum_correlation: float = Field(0.8, ge=-1, le=1, description="least correlation after matching")
    pair_correlation: float = Field(0.9, ge=-1, le=1, description="the same if one search image alone saw the point")
    maximum_sigma0: float = Field(30.0, gt=0, description="greatest a-posteriori sigma (grey levels after filtering)")
    maximum_deviation: float = Field(0.2, gt=0, description="greatest standard deviation in x and in y (px)")
    iterations: int = Field(10, ge=1, le=1000, description="limit of iterations, fewer than for single points")
    maximum_shift: float = Field(1.5, gt=0, description="farthest way from the start (px)")
    seed_shift: float = Field(4.0, gt=0, description="the same for seeds, whose start is coarser (px)")
    maximum_epipolar: float = Field(0.7, gt=0, description="greatest distance from the epipolar line (px)")
    attempts: int = Field(3, ge=1, le=8, description="neighbours from which a point is tried")
    hole_passes: int = Field(40, ge=0, le=1000, description="most rounds of filling holes from all directions")
    agreement: float = Field(0.6, gt=0, description="greatest departure from what a neighbour predicts (px)")
    minimum_patch: float = Field(90.0, ge=0, description="least area of points that hang together (px²)")
    minimum_pair_patch: float = Field(
        900.0, ge=0, description="the same where no point was seen by more than one search image of several (px²)"
    )
    confirmed: float = Field(
        0.02,
        ge=0,
        le=1,
        description="fraction of a patch seen by several search images that makes it more than a pair's",
    )


class WallisSettings(Settings):
    """Target values of the Wallis filter."""

    enabled: bool = Field(True, description="whether images are filtered at all")
    window: int = Field(41, ge=3, le=1001, description="edge of the window, odd (px)")
    mean: float = Field(127.0, ge=0, le=255, description="target mean (grey levels)")
    deviation: float = Field(50.0, gt=0, description="target standard deviation (grey levels)")
    brightness: float = Field(1.0, ge=0, le=1, description="b: 1 forces the mean to the target, 0 keeps it")
    contrast: float = Field(0.8, gt=0, le=1, description="c: 1 forces the deviation to the target")
