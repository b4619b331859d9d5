"""Settings of the skeleton."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class SkeletonSettings(Settings):
    """How bodies are connected and where their joints are."""

    method: Literal["m3"] = Field(default="m3", description="m3: samples growing along the ellipsoids' axes")
    sample_step: float = Field(
        default=0.5, gt=0, description="distance of neighbouring samples on the axes (point spacings)"
    )
    min_touching: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="fraction of the frames in which two bodies must touch to be connected (0..1)",
    )
    fixed_joints: bool = Field(
        default=True,
        description="joints keep their place on both bones, as in the BVH; false: found anew in each frame, they jump",
    )
