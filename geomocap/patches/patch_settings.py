"""Settings of surface tracking."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class TrackingSettings(Settings):
    """How patches of the surface are placed and followed.

    Templates of a camera's first view slide least, but are lost sooner. Version 0.1.0, a walking man, eight cameras
    640×480, 2,000 patches: drift median / 95 %, and length as a fraction of the frames in which two cameras see it:

        ========  =====================  ======  =====================  ======
        template  20 frames: drift (mm)  length  60 frames: drift (mm)  length
        ========  =====================  ======  =====================  ======
        first     0.65 / 4.4             0.82    0.70 / 5.0             0.72
        updated   0.72 / 5.0             0.86    0.92 / 6.2             0.77
        previous  0.79 / 5.0             0.90
        ========  =====================  ======  =====================  ======

    Bodies come out better from the longer tracks of "updated".
    """

    n_patches: int = Field(
        4000,
        ge=10,
        le=100_000,
        description="Patches placed on a frame's whole surface",
        json_schema_extra={"flag": "patches"},
    )
    radius_px: int = Field(
        5,
        ge=2,
        le=20,
        description="Half the width of a patch, at most; of few cameras, see one_camera_up_to, twice that (pixels)",
    )
    reduction: int | None = Field(
        None,
        ge=1,
        le=16,
        description="Reduction of the images; so that patches cover the surface twice if not given",
        json_schema_extra={"flag": "reduction"},
    )
    blurs_px: tuple[float, float] = Field((2.5, 0.8), description="Blur of the coarse and the fine level (pixels)")
    templates: Literal["first", "updated", "previous"] = Field(
        "updated",
        description="Template: the first view of a camera, a new one where it fits badly, or the last frame's",
    )
    seed_every: int | None = Field(
        None,
        ge=1,
        description="Frames between two looks for surface without patches, the last frame is looked at too; "
        "3 if not given, 10 where single cameras follow the surface",
    )
    seed_correlation: float = Field(
        0.85, gt=0, lt=1, description="Least correlation between cameras for a new patch, free of noise"
    )
    search_front: float = Field(
        0.0075,
        ge=0,
        lt=1,
        description="How far before the surface a new patch is looked for (fraction of the diagonal)",
    )
    search_depth: float = Field(
        0.03, ge=0, lt=1, description="How far behind the surface a new patch is looked for (fraction of the diagonal)"
    )
    # How precise a position is tells more than the correlation. While noise still lowered it, with 0.75 instead
    # of 0.85 patches of a person before four real cameras lasted for 26 frames instead of 20 (median); those of a man
    # in plain clothes before eight drifted by 2.15 mm instead of 2.11 (median), and by 9.3 instead of 9.4 (95 %).
    correlation: float = Field(0.75, gt=0, lt=1, description="Least mean correlation of a tracked patch, free of noise")
    camera_correlation: float = Field(
        0.6, gt=0, lt=1, description="Least correlation for a camera to count, free of noise"
    )
    n_views: int = Field(2, ge=2, description="Least number of cameras that agree on a new patch")
    one_camera_below: float = Field(
        0.5, ge=0, le=1, description="Fraction of the surface on which two cameras agree, below which one alone may do"
    )
    one_camera_up_to: int = Field(
        5, ge=0, description="Most cameras of such captures: many cameras that disagree look at what isn't there"
    )
    sigma_px: float = Field(0.5, gt=0, description="Largest standard deviation of a position (pixels on the patch)")
    slack_px: float = Field(8.0, gt=0, description="Depth, beyond two voxels, of what hides a patch (pixels on it)")
    neighbour_px: float = Field(3.0, gt=0, description="Largest distance from where neighbours' motion puts it (px)")
    longest_gap: int = Field(60, ge=0, description="Frames that a lost patch is carried along by its neighbours")
    backward: bool = Field(True, description="Follow patches placed in later frames backward as well")
    seed: int = Field(0, ge=0, description="Start of the random numbers")
