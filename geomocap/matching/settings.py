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
