"""Settings of the reading of scans."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from geomocap.settings import Settings


class ScanSettings(Settings):
    """How scans become point sets."""

    samples: int = Field(
        20000,
        ge=16,
        le=10_000_000,
        description="points sampled on each mesh's surface (points)",
        json_schema_extra={"flag": "samples"},
    )
    spacing: float | None = Field(
        None,
        gt=0,
        description="distance of neighbouring points (scan units); measured on the first scan if not given",
        json_schema_extra={"flag": "spacing"},
    )
    scale: float = Field(
        1.0,
        ge=1e-9,
        le=1e9,
        description="metres per unit of the scans, 0.001 for millimetres",
        json_schema_extra={"flag": "scale"},
    )
    up: Literal["x", "y", "z"] = Field(
        "z", description="axis of the scans that points up; y in glTF files", json_schema_extra={"flag": "up"}
    )
    seed: int = Field(0, ge=0, description="seed of the surface sampling")
