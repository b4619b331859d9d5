"""Settings of the reference-bar calibration."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class TargetSettings(Settings):
    """Settings of the target measurement."""

    contrast: float = Field(
        25.0, gt=0, description="smallest brightness of a target over its surroundings (grey levels)"
    )
    relative_contrast: float = Field(
        0.35, ge=0, le=1, description="smallest brightness relative to that of the camera's typical target"
    )
    min_radius: float = Field(0.7, gt=0, description="smallest radius of a target in the image (px)")
    max_radius: float = Field(
        0.06, gt=0, lt=0.5, description="largest radius of a target (fraction of the longer side)"
    )
    max_elongation: float = Field(2.0, gt=1, description="largest ratio of a target's axes; beyond it is motion blur")
    shape: Literal["sphere", "flat"] = Field(
        "sphere", description="targets: a sphere's image centre is corrected for its eccentricity, a flat mark's is not"
    )
    max_candidates: int = Field(6, ge=2, le=32, description="candidates kept per image")
    background_frames: int = Field(15, ge=3, description="frames from which still lights are learnt")
    min_sigma: float = Field(0.001, gt=0, description="floor of a target's standard deviation (px)")


class BarSettings(Settings):
    """Settings of the reference-bar calibration."""

    targets: TargetSettings = Field(default_factory=TargetSettings, description="target measurement")
    model: Literal["auto", "OPENCV", "FULL_OPENCV"] = Field(
        "auto", description="camera model; auto: OPENCV, and k3 as well if the observations ask for it"
    )
    length_sigma: float = Field(5e-5, gt=0, description="standard deviation of the bar's length (m)")
    focal_candidates: tuple[float, ...] = Field(
        (0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.1, 2.8),
        min_length=1,
        description="camera constants tried at the start (fractions of the image's longer side)",
    )
    focal_sigma: float = Field(0.5, gt=0, description="a-priori standard deviation of the camera constant (fraction)")
    aspect_sigma: float = Field(0.01, gt=0, description="a-priori standard deviation of fx − fy (fraction of fx)")
    principal_point_sigma: float = Field(
        0.03, gt=0, description="a-priori standard deviation of the principal point (fraction of the longer side)"
    )
    radial_sigma: float = Field(0.3, gt=0, description="a-priori standard deviation of radial coefficients")
    tangential_sigma: float = Field(0.003, gt=0, description="a-priori standard deviation of decentering coefficients")
    pairing_threshold: float = Field(
        0.015,
        gt=0,
        lt=0.2,
        description="largest distance from the epipolar line at the start (fraction of longer side)",
    )
    pairing_samples: int = Field(200, ge=10, description="random samples for a pair of cameras")
    start_sigma: float = Field(
        0.003, gt=0, description="standard deviation of image points at the start (fraction of the longer side)"
    )
    outlier_threshold: float = Field(4.0, gt=2, description="residuals beyond are outliers (standard deviations)")
    folds: int = Field(5, ge=2, description="parts into which the bars are cut for the held-out length error")
    seed: int = Field(1, ge=0, description="seed of the random samples")
