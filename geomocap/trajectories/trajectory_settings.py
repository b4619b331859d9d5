"""Settings of trajectories: filters, velocities and accelerations."""

from __future__ import annotations

from pydantic import Field

from geomocap.settings import Settings


class FilterSettings(Settings):
    """Which trajectories are cut or removed."""

    on: bool = Field(
        True, description="Cut and remove trajectories that can't be true", json_schema_extra={"flag": "filters"}
    )
    fastest: float | None = Field(
        None, gt=0, description="Highest speed (m/s); from the data if not given", json_schema_extra={"flag": "fastest"}
    )
    acceleration: float | None = Field(
        None, gt=0, description="Highest acceleration (m/s²); from the data if not given"
    )
    beyond_data: float = Field(
        2.5, gt=1, description="Limits from the data: so many times what all but a few points don't exceed"
    )
    window: int = Field(4, ge=1, description="Frames over which the motion is compared with that around it")
    unlike: float | None = Field(
        None, gt=0, description="Largest distance from where the motion around it leads (m); from the data if not given"
    )
    least_frames: int = Field(3, ge=1, description="Frames that a trajectory needs")


class SmoothingSettings(Settings):
    """How velocities and accelerations are estimated."""

    half_width: int = Field(
        3,
        ge=1,
        description="Frames on each side that a velocity is estimated from",
        json_schema_extra={"flag": "half-width"},
    )
    degree: int = Field(
        3,
        ge=1,
        le=4,
        description="Degree of the polynomial in time",
        json_schema_extra={
            "evidence": "patches of a walking man, noisy by tenths of a millimetre: velocities wrong by 0.026 m/s RMS "
            "with 3, by 0.045 with 2, which flattens quick motion (a kicking horse: 0.13 and 0.32)"
        },
    )
